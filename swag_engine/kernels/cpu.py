"""The backend of compiled kernels, for float32 tensors on the CPU.

Every result is the same to the bit for any number of threads (torch.get_num_threads() are used).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from ..base.timing import part
from .cpu_library import Argument, CpuLibrary, load_library
from .elementwise import ElementwiseKernels
from .protocol import Blended, Gradients, Projection, check_pairs

RANK_CHUNKS = 8
"""Parts of the depth order that are binned in parallel; at most as many threads share that work."""
FEW = 4096
"""Numbers that are updated sooner than other threads could start."""
SUM_PARTS = 32
"""Ranges whose sums are added in their order: the result does not depend on the number of threads."""


class CpuKernels(ElementwiseKernels):
    """The backend "cpu".

    Args:
        load: Loads the compiled kernels when they are first needed; None where there are none.
    """

    viewmat_dtype = torch.float32

    def __init__(self, load: Callable[[], CpuLibrary | None] = load_library) -> None:
        self._load = load

    @cached_property
    def _library_if_any(self) -> CpuLibrary | None:
        return self._load()

    @property
    def library(self) -> CpuLibrary:
        """The compiled kernels, where they can run."""
        library = self._library_if_any
        assert library is not None
        return library

    def unavailable_reason(self) -> str | None:
        """Say why the kernels cannot run on this machine, None where they can."""
        return None if self._library_if_any else "its compiled kernels could not be loaded (see the warning)."

    def can_run(self, *tensors: Tensor) -> bool:
        """Return whether the kernels could be loaded and all tensors are float32 on the CPU."""
        fits = all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)
        return fits and self._library_if_any is not None

    def device(self) -> torch.device:
        """Return the CPU."""
        return torch.device("cpu")

    def details(self) -> dict[str, Any]:
        """Return the number of threads and the file name of the kernels, None where there are none."""
        library = self._library_if_any
        return {"threads": torch.get_num_threads(), "kernels": library.path.name if library else None}

    def blend(
        self, projected: Projection, opacities: Tensor, channels: Tensor, background: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """See `Kernels.blend`."""
        p = projected
        geometry = p.means2d, p.conics, opacities, channels, background, p.depths, p.radii
        return _Blend.apply(*geometry, width, height, self.library)

    def contributions(
        self,
        projected: Projection,
        opacities: Tensor,
        channels: Tensor,
        background: Tensor,
        width: int,
        height: int,
        weights: Tensor,
        image_gradient: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `Kernels.contributions`."""
        library = self.library
        channels, background = channels.contiguous(), background.contiguous()
        b = blend(library, projected, opacities, channels, background, width, height)
        n, channel_count = channels.shape
        size = 2 + weights.shape[2]
        results = channels.new_empty(len(b.ids), size)
        tiles = len(b.tile_starts) - 1
        sizes = width, height, channel_count, weights.shape[2]
        lists = b.splats, channels, b.ids, b.tile_starts, background, b.transmittance, b.endings
        images = weights.contiguous(), image_gradient.contiguous()
        library.run("contributions", tiles, *sizes, *lists, *images, results)
        sums = channels.new_zeros(n, size)
        library.run("gather_sums", len(b.rank_starts) - 1, size, b.order, b.rank_starts, b.places, results, sums)
        return sums[:, 2:], sums[:, 0], sums[:, 1]

    def l1_ssim(self, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """See `Kernels.l1_ssim`."""
        return _L1Ssim.apply(image, target, self.library)

    def adam_step(
        self,
        parameter: Tensor,
        gradient: Tensor,
        exp_avg: Tensor,
        exp_avg_sq: Tensor,
        rate: float,
        beta1: float,
        beta2: float,
        eps: float,
        step: int,
    ) -> None:
        """See `Kernels.adam_step`."""
        corrected = rate / (1 - beta1**step), 1 / math.sqrt(1 - beta2**step)
        weights = beta1, 1 - beta1, beta2, 1 - beta2
        tensors = parameter, gradient.contiguous(), exp_avg, exp_avg_sq
        count, arguments = parameter.numel(), (*tensors, *corrected, *weights, eps)
        if count < FEW:
            self.library.call("adam_step", 0, count, *arguments)
        else:
            self.library.run("adam_step", count, *arguments)

    def items_of_image(self, height: int, width: int) -> int:
        """Return the number of rows, which kernels of images take one by one."""
        return height

    def run_each(self, kernel: str, count: int, *arguments: Argument) -> None:
        """See `NativeKernels.run_each`."""
        self.library.run(kernel, count, *arguments)

    def run_by_channel(self, kernel: str, count: int, *arguments: Argument) -> None:
        """See `NativeKernels.run_by_channel`; kernels take all channels of a color at once."""
        self.library.run(kernel, count, *arguments)

    def sum_each(self, kernel: str, count: int, size: int, *arguments: Argument) -> Tensor:
        """See `NativeKernels.sum_each`."""
        sums = torch.empty(SUM_PARTS, size, dtype=torch.float64)
        self.library.run_parts(kernel, count, list(arguments), sums)
        return sums.sum(0)

    def blended(
        self, projected: Projection, opacities: Tensor, channels: Tensor, background: Tensor, width: int, height: int
    ) -> Blended:
        """See `NativeKernels.blended`."""
        image = blend(self.library, projected, opacities, channels, background, width, height)
        backward = partial(blend_backward, self.library, image.saved(channels, background))
        return Blended(image.out, image.transmittance, backward)

    def similarity(self, image: Tensor, target: Tensor) -> tuple[Tensor, Callable[[float], Tensor]]:
        """See `NativeKernels.similarity`."""
        sums, derivatives = _l1_ssim(self.library, image, target)
        return sums[1:], lambda factor: _l1_ssim_backward(self.library, image, target, derivatives, 0.0, factor)


@dataclass
class BlendedTiles:
    """A blended image, and what another pass over its tiles needs."""

    out: Tensor
    transmittance: Tensor
    endings: Tensor
    splats: Tensor
    order: Tensor
    rank_starts: Tensor
    ids: Tensor
    places: Tensor
    tile_starts: Tensor

    def saved(self, channels: Tensor, background: Tensor) -> tuple[Tensor, ...]:
        """Return what `blend_backward` needs, for channels and background as they were blended."""
        return (
            self.splats, channels, self.order, self.rank_starts, self.ids, self.places, self.tile_starts, background,
            self.transmittance, self.endings,
        )  # fmt: skip


def blend(
    library: CpuLibrary,
    projected: Projection,
    opacities: Tensor,
    channels: Tensor,
    background: Tensor,
    width: int,
    height: int,
) -> BlendedTiles:
    """Blend as `Kernels.blend` does; channels (N, C) and background (C,) are contiguous."""
    n, channel_count = channels.shape
    splats = torch.empty(n, library.call("splat_bytes"), dtype=torch.uint8)
    keys = torch.empty(n, dtype=torch.int32)
    p = projected
    geometry = [tensor.contiguous() for tensor in (p.means2d, p.conics, opacities, p.depths, p.radii)]
    library.run("pack", n, *geometry, width, height, splats, keys)
    order, rank_starts, tile_starts, ids, places = _bin(library, splats, keys, width, height)
    out = channels.new_empty(height, width, channel_count)
    transmittance = channels.new_empty(height, width)
    endings = torch.empty(height, width, dtype=torch.int32)
    inputs = width, height, channel_count, splats, channels, ids, tile_starts, background
    library.run("blend_forward", len(tile_starts) - 1, *inputs, out, transmittance, endings)
    return BlendedTiles(out, transmittance, endings, splats, order, rank_starts, ids, places, tile_starts)


def blend_backward(
    library: CpuLibrary, saved: Sequence[Tensor], out_gradient: Tensor, alpha_gradient: Tensor | None
) -> Gradients:
    """Go back through `blend`.

    Args:
        library: The compiled kernels.
        saved: What `Blended.saved` returned.
        out_gradient: (H, W, C) gradient by the image.
        alpha_gradient: (H, W) gradient by alpha, None for zeros.

    Returns:
        Gradients by means2d (N, 2), conics (N, 3), opacities (N,), channels (N, C) and background (C,).
    """
    splats, channels, order, rank_starts, ids, places, tile_starts, background, transmittance, endings = saved
    n, channel_count = channels.shape
    height, width = transmittance.shape
    tiles = len(tile_starts) - 1
    gradients = channels.new_empty(len(ids), library.call("moment_count") + channel_count)
    per_tile = channels.new_empty(tiles, channel_count)
    inputs = splats, channels, ids, tile_starts, background, transmittance, endings
    incoming = out_gradient.contiguous(), 0 if alpha_gradient is None else alpha_gradient.contiguous()
    library.run("blend_backward", tiles, width, height, channel_count, *inputs, *incoming, gradients, per_tile)
    means2d, conics, opacities, by_channel = (channels.new_empty(n, size) for size in (2, 3, 1, channel_count))
    lists, outputs = (splats, order, rank_starts, places, gradients), (means2d, conics, opacities, by_channel)
    library.run("gather", n, len(rank_starts) - 1, channel_count, *lists, *outputs)
    by_background = per_tile.double().sum(0).float()
    return means2d, conics, opacities[:, 0], by_channel, by_background


class _Blend(torch.autograd.Function):
    @staticmethod
    @part("rasterise")
    def forward(
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        channels: Tensor,
        background: Tensor,
        depths: Tensor,
        radii: Tensor,
        width: int,
        height: int,
        library: CpuLibrary,
    ) -> tuple[Tensor, Tensor]:
        channels, background = channels.contiguous(), background.contiguous()
        projected = Projection(means2d, conics, depths, radii)
        b = blend(library, projected, opacities, channels, background, width, height)
        ctx.save_for_backward(*b.saved(channels, background))
        ctx.library = library
        ctx.set_materialize_grads(False)
        return b.out, 1 - b.transmittance

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("rasterise backward")
    def backward(ctx: Any, out_gradient: Tensor | None, alpha_gradient: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        if out_gradient is None:
            channels, transmittance = saved[1], saved[8]
            out_gradient = channels.new_zeros(*transmittance.shape, channels.shape[1])
        gradients = blend_backward(ctx.library, saved, out_gradient, alpha_gradient)
        return *gradients, None, None, None, None, None


def _bin(
    library: CpuLibrary, splats: Tensor, keys: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """List the Gaussians of each tile in depth order, without sorting (Gaussian, tile) pairs.

    The depth order is cut into RANK_CHUNKS parts; each counts its pairs by tile, and the counts become the places where
    each part writes. Returns order (V,) the V drawable Gaussians by depth, rank_starts (V + 1,) the first of each
    one's pairs, tile_starts (tiles + 1,) the first of each tile's pairs, and of the pairs by tile ids (P,) the Gaussian
    and by Gaussian places (P,) the pair's place in the tile lists.
    """
    n = len(keys)
    spare = torch.empty(n, dtype=torch.int32)
    order = torch.empty(n, dtype=torch.int32)
    spare_keys = torch.empty(2 * n, dtype=torch.int32)
    drawable = library.call("sort_by_depth", n, keys, order, spare, spare_keys)

    tiles = -(-width // library.call("tile_width")) * -(-height // library.call("tile_height"))
    rank_starts = torch.empty(drawable + 1, dtype=torch.int64)
    counts = torch.zeros(RANK_CHUNKS, tiles, dtype=torch.int64)
    library.run_parts("count_tiles", drawable, [splats, order, width, height, rank_starts[1:]], counts)
    tile_starts = torch.empty(tiles + 1, dtype=torch.int64)
    pairs = library.call("start_lists", drawable, tiles, RANK_CHUNKS, rank_starts, counts, tile_starts)
    check_pairs(pairs)
    ids = torch.empty(pairs, dtype=torch.int32)
    places = torch.empty(pairs, dtype=torch.int32)
    library.run_parts("fill_tiles", drawable, [splats, order, width, height, rank_starts, ids, places], counts)
    return order, rank_starts, tile_starts, ids, places


def _l1_ssim(library: CpuLibrary, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sums of |image - target| and of SSIM, (2,) float64, and what `_l1_ssim_backward` takes."""
    height, width, _ = image.shape
    sums = torch.empty(height, 2, dtype=torch.float64)
    derivatives = image.new_empty(3, *image.shape)
    library.run("l1_ssim_forward", height, height, width, image, target, sums, derivatives)
    return sums.sum(0), derivatives


def _l1_ssim_backward(
    library: CpuLibrary, image: Tensor, target: Tensor, derivatives: Tensor, by_l1: float, by_ssim: float
) -> Tensor:
    """Return the gradient by the image, from those by the two sums."""
    height, width, _ = image.shape
    gradient = torch.empty_like(image)
    library.run("l1_ssim_backward", height, height, width, image, target, derivatives, by_l1, by_ssim, gradient)
    return gradient


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    @part("loss L1 and SSIM")
    def forward(ctx: Any, image: Tensor, target: Tensor, library: CpuLibrary) -> tuple[Tensor, Tensor]:
        image, target = image.contiguous(), target.contiguous()
        sums, derivatives = _l1_ssim(library, image, target)
        ctx.library = library
        ctx.save_for_backward(image, target, derivatives)
        l1, similarity = (sums / image.numel()).float()
        return l1, similarity

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("loss L1 and SSIM backward")
    def backward(ctx: Any, by_l1: Tensor, by_ssim: Tensor) -> tuple[Tensor, None, None]:
        image, target, derivatives = ctx.saved_tensors
        factors = float(by_l1) / image.numel(), float(by_ssim) / image.numel()
        return _l1_ssim_backward(ctx.library, image, target, derivatives, *factors), None, None
