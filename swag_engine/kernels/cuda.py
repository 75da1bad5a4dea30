"""The backend of CUDA kernels, for float32 tensors on an NVIDIA card.

There are no atomic sums: every result is the same to the bit each time.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import torch
from torch import Tensor

from ..base.timing import part
from .cuda_driver import Argument, CudaUnavailable, Driver, Launcher
from .elementwise import ElementwiseKernels
from .protocol import Blended, Gradients, Projection, check_pairs

THREADS = 256
"""Threads of every block; as in common.cuh."""
WARP = 32
"""Threads of a warp; as in common.cuh."""
TILE = 16
"""Width and height of a tile, pixels; as in splat.cuh and ssim.cu."""
SPLAT_FLOATS = 10
"""Size of a packed Gaussian, floats; as in splat.cuh."""
MOMENTS = 6
"""Sums that the gradients by the geometry are made of; as in blend.cu."""
WEIGHTS = 6
"""Weight images that one pass over the tiles takes; as in blend.cu."""
GROUP = 8
"""Channels that a kernel takes at most; as in blend.cu."""


@dataclass
class TilePairs:
    """P pairs of a Gaussian and a tile it meets.

    Attributes:
        splats: (N, SPLAT_FLOATS) Gaussians as they are blended.
        order: (N,) Gaussians by depth, equal depths by index.
        rank_starts: (N + 1,) where the slots of each rank's pairs begin.
        ids: (P,) the Gaussian of each pair, by tile, in a tile by depth.
        slots: (P,) where the pair's gradients go, in the same order.
        tile_starts: (tiles + 1,) where each tile's pairs begin.
    """

    splats: Tensor
    order: Tensor
    rank_starts: Tensor
    ids: Tensor
    slots: Tensor
    tile_starts: Tensor


class CudaKernels(ElementwiseKernels):
    """The backend "cuda".

    Args:
        make_launcher: Makes what launches kernels when it is first needed; raises CudaUnavailable where that is
            impossible.
    """

    viewmat_dtype = torch.float64

    def __init__(self, make_launcher: Callable[[], Launcher] = Driver) -> None:
        self._make_launcher = make_launcher

    @cached_property
    def _launcher_or_reason(self) -> Launcher | str:
        try:
            return self._make_launcher()
        except CudaUnavailable as reason:
            return str(reason)

    @property
    def _launcher(self) -> Launcher:
        launcher = self._launcher_or_reason
        assert not isinstance(launcher, str)
        return launcher

    def unavailable_reason(self) -> str | None:
        """Say why the kernels cannot run on this machine, None where they can."""
        launcher = self._launcher_or_reason
        return launcher if isinstance(launcher, str) else None

    def can_run(self, *tensors: Tensor) -> bool:
        """Return whether the kernels could be loaded and all tensors are float32 on a card."""
        launcher = self._launcher_or_reason
        return not isinstance(launcher, str) and all(
            tensor.device.type == launcher.device_type and tensor.dtype == torch.float32 for tensor in tensors
        )

    def device(self) -> torch.device:
        """Return the current card."""
        return torch.device(self._launcher.device_type)

    def details(self) -> dict[str, Any]:
        """Return name, memory (GB) and architecture of the current card, nothing where the kernels cannot run."""
        if self.unavailable_reason():
            return {}
        properties = torch.cuda.get_device_properties(torch.cuda.current_device())
        return {
            "device": properties.name,
            "memory_gb": round(properties.total_memory / 1e9, 1),
            "architecture": f"sm_{properties.major}{properties.minor}",
        }

    def run(self, kernel: str, threads: int, *arguments: Argument) -> None:
        """Run a kernel.

        Args:
            kernel: Name of the kernel.
            threads: Number of threads; rounded up to whole blocks.
            *arguments: What the kernel takes.
        """
        self._launcher.launch(kernel, -(-threads // THREADS), THREADS, list(arguments))

    def run_each(self, kernel: str, count: int, *arguments: Argument) -> None:
        """Run a kernel with a thread for each of `count` items; the kernel takes `count` first."""
        self.run(kernel, count, count, *arguments)

    def run_by_channel(self, kernel: str, count: int, *arguments: Argument) -> None:
        """Run a kernel with a thread for each channel of `count` colors; the kernel takes `count` first."""
        self.run(kernel, 3 * count, count, *arguments)

    def items_of_image(self, height: int, width: int) -> int:
        """Return the number of pixels, which kernels of images take one by one."""
        return height * width

    def sum_each(self, kernel: str, count: int, size: int, *arguments: Argument) -> Tensor:
        """See `NativeKernels.sum_each`."""
        device = next(argument for argument in arguments if isinstance(argument, Tensor)).device
        sums = torch.empty(-(-count // THREADS), size, device=device)
        self.run_each(kernel, count, *arguments, sums)
        return sums.sum(0, dtype=torch.float64)

    def tile_pairs(self, projected: Projection, opacities: Tensor, width: int, height: int) -> TilePairs:
        """List the Gaussians of each tile in depth order.

        Args:
            projected: The N Gaussians.
            opacities: (N,) in 0..1.
            width: Width of the image, pixels.
            height: Height of the image, pixels.

        Returns:
            The pairs of a Gaussian and a tile.

        Raises:
            TooManyPairs: There are too many.
        """
        p = projected
        n = len(p.means2d)
        splats, keys = p.means2d.new_empty(n, SPLAT_FLOATS), p.means2d.new_empty(n)
        geometry = [tensor.contiguous() for tensor in (p.means2d, p.conics, opacities, p.depths, p.radii)]
        self.run_each("pack", n, *geometry, width, height, splats, keys)
        keys, order = keys.sort(stable=True)
        rank_starts = torch.zeros(n + 1, dtype=torch.int64, device=order.device)
        self.run_each("count_tiles", n, splats, keys, order, width, height, rank_starts[1:])
        rank_starts.cumsum_(0)
        pairs = int(rank_starts[-1])
        check_pairs(pairs)

        tiles = -(-width // TILE) * -(-height // TILE)
        dtype = torch.int16 if tiles < 2**15 else torch.int32  # half the bytes to sort
        tile_of, ids = order.new_empty(pairs, dtype=dtype), order.new_empty(pairs, dtype=torch.int32)
        kernel = f"fill_tiles_{str(dtype).removeprefix('torch.')}"
        self.run_each(kernel, n, splats, order, width, height, rank_starts, tile_of, ids)
        tile_of, slots = tile_of.sort(stable=True)
        tile_starts = torch.searchsorted(tile_of, torch.arange(tiles + 1, dtype=dtype, device=order.device))
        return TilePairs(splats, order, rank_starts, ids[slots], slots, tile_starts)

    def blend_pairs(
        self, pairs: TilePairs, channels: Tensor, background: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Blend the Gaussians of each tile.

        Args:
            pairs: The pairs of a Gaussian and a tile.
            channels: (N, C) values to blend, contiguous.
            background: (C,) values behind all Gaussians, contiguous.
            width: Width of the image, pixels.
            height: Height of the image, pixels.

        Returns:
            The image (height, width, C), the transmittance (height, width) behind all Gaussians, and the rank
            (height, width) in its tile's list at which each pixel ended.
        """
        channel_count = channels.shape[1]
        out = channels.new_empty(height, width, channel_count)
        transmittance = channels.new_empty(height, width)
        endings = torch.empty(height, width, dtype=torch.int32, device=channels.device)
        threads = (len(pairs.tile_starts) - 1) * THREADS
        lists = pairs.splats, channels, pairs.ids, pairs.tile_starts, background
        for first in range(0, channel_count, GROUP):
            kernel = f"blend_forward_{min(GROUP, channel_count - first)}"
            self.run(kernel, threads, width, height, channel_count, first, *lists, out, transmittance, endings)
        return out, transmittance, endings

    def blend(
        self, projected: Projection, opacities: Tensor, channels: Tensor, background: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """See `Kernels.blend`."""
        p = projected
        geometry = p.means2d, p.conics, opacities, channels, background, p.depths, p.radii
        return _Blend.apply(*geometry, width, height, self)

    def blended(
        self, projected: Projection, opacities: Tensor, channels: Tensor, background: Tensor, width: int, height: int
    ) -> Blended:
        """See `NativeKernels.blended`."""
        pairs = self.tile_pairs(projected, opacities, width, height)
        out, transmittance, endings = self.blend_pairs(pairs, channels, background, width, height)
        saved = pairs, channels, background, transmittance, endings
        return Blended(out, transmittance, partial(self.blend_backward, *saved))

    def blend_backward(
        self,
        pairs: TilePairs,
        channels: Tensor,
        background: Tensor,
        transmittance: Tensor,
        endings: Tensor,
        by_out: Tensor,
        by_alpha: Tensor,
    ) -> Gradients:
        """Go back through `blend_pairs`.

        Args:
            pairs: What was blended.
            channels: (N, C) values that were blended.
            background: (C,) behind all Gaussians.
            transmittance: (H, W) as `blend_pairs` returned it.
            endings: (H, W) as `blend_pairs` returned them.
            by_out: (H, W, C) gradient by the image.
            by_alpha: (H, W) gradient by alpha.

        Returns:
            The gradients.
        """
        n, channel_count = channels.shape
        height, width = transmittance.shape
        by_out, by_alpha = by_out.contiguous(), by_alpha.contiguous()
        gradients = channels.new_empty(len(pairs.ids), MOMENTS + channel_count)
        threads = (len(pairs.tile_starts) - 1) * THREADS
        lists = pairs.splats, channels, pairs.ids, pairs.tile_starts, background, transmittance, endings, pairs.slots
        for first in range(0, channel_count, GROUP):
            kernel = f"blend_backward_{min(GROUP, channel_count - first)}"
            self.run(kernel, threads, width, height, channel_count, first, *lists, by_out, by_alpha, gradients)
        outputs = [channels.new_empty(n, *shape) for shape in ((2,), (3,), (), (channel_count,))]
        gathered = pairs.splats, pairs.order, pairs.rank_starts, gradients
        self.run("gather_gradients", n * WARP, n, channel_count, *gathered, *outputs)
        by_background = (transmittance[..., None] * by_out).sum((0, 1))
        means2d, conics, opacities, by_channels = outputs
        return means2d, conics, opacities, by_channels, by_background

    def similarity(self, image: Tensor, target: Tensor) -> tuple[Tensor, Callable[[float], Tensor]]:
        """See `NativeKernels.similarity`."""
        sums, derivatives = self._l1_ssim(image, target)

        def backward(factor: float) -> Tensor:
            return self._l1_ssim_backward(image, target, derivatives, _ssim_alone(image.device), factor)

        return sums[1:], backward

    def _l1_ssim(self, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return the sums of |image - target| and of SSIM, (2,) float64, and what `_l1_ssim_backward` takes."""
        height, width, _ = image.shape
        squares = -(-height // TILE) * -(-width // TILE)
        sums, derivatives = image.new_empty(squares, 2), image.new_empty(3, *image.shape)
        self.run("l1_ssim_forward", squares * THREADS, height, width, image, target, sums, derivatives)
        return sums.sum(0, dtype=torch.float64), derivatives

    def _l1_ssim_backward(
        self, image: Tensor, target: Tensor, derivatives: Tensor, factors: Tensor, scale: float
    ) -> Tensor:
        """Return the gradient by the image, from those by the two sums: `factors` (2,) times `scale`."""
        height, width, _ = image.shape
        squares = -(-height // TILE) * -(-width // TILE)
        gradient = torch.empty_like(image)
        inputs = image, target, derivatives, factors, scale
        self.run("l1_ssim_backward", squares * THREADS, height, width, *inputs, gradient)
        return gradient

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
        images = weights.contiguous(), image_gradient.contiguous()
        channels, background = channels.contiguous(), background.contiguous()
        n, channel_count = channels.shape
        p = self.tile_pairs(projected, opacities, width, height)
        _, transmittance, endings = self.blend_pairs(p, channels, background, width, height)
        weight_count = weights.shape[2]
        size = 2 + weight_count
        results, sums = channels.new_empty(len(p.ids), size), channels.new_empty(n, size)
        threads = (len(p.tile_starts) - 1) * THREADS
        lists = p.splats, channels, p.ids, p.tile_starts, background, transmittance, endings, p.slots
        for first in range(0, max(weight_count, 1), WEIGHTS):
            kernel = f"contributions_{channel_count}"
            self.run(kernel, threads, width, height, weight_count, first, *lists, *images, results)
        self.run("gather_sums", n * WARP, n, size, p.order, p.rank_starts, results, sums)
        return sums[:, 2:], sums[:, 0], sums[:, 1]

    def l1_ssim(self, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """See `Kernels.l1_ssim`."""
        return _L1Ssim.apply(image, target, self)

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
        count = parameter.numel()
        corrected = rate / (1 - beta1**step), math.sqrt(1 - beta2**step)
        tensors = parameter, gradient.contiguous(), exp_avg, exp_avg_sq
        self.run_each("adam_step", count, *tensors, *corrected, 1.0 - beta1, 1.0 - beta2, float(eps))


@cache
def _ssim_alone(device: torch.device) -> Tensor:
    """Return the gradients by the sums of L1 and SSIM of a loss that is SSIM; sent to the card once."""
    return torch.tensor([0.0, 1.0], device=device)


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
        kernels: CudaKernels,
    ) -> tuple[Tensor, Tensor]:
        channels, background = channels.contiguous(), background.contiguous()
        p = kernels.tile_pairs(Projection(means2d, conics, depths, radii), opacities, width, height)
        out, transmittance, endings = kernels.blend_pairs(p, channels, background, width, height)
        lists = p.splats, p.order, p.rank_starts, p.ids, p.slots, p.tile_starts
        ctx.save_for_backward(*lists, channels, background, transmittance, endings)
        ctx.kernels = kernels
        return out, 1 - transmittance

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("rasterise backward")
    def backward(ctx: Any, by_out: Tensor, by_alpha: Tensor) -> tuple[Tensor | None, ...]:
        *lists, channels, background, transmittance, endings = ctx.saved_tensors
        saved = TilePairs(*lists), channels, background, transmittance, endings
        return *ctx.kernels.blend_backward(*saved, by_out, by_alpha), None, None, None, None, None


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    @part("loss L1 and SSIM")
    def forward(ctx: Any, image: Tensor, target: Tensor, kernels: CudaKernels) -> tuple[Tensor, Tensor]:
        image, target = image.contiguous(), target.contiguous()
        sums, derivatives = kernels._l1_ssim(image, target)
        ctx.kernels = kernels
        ctx.save_for_backward(image, target, derivatives)
        l1, similarity = (sums / image.numel()).float()
        return l1, similarity

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("loss L1 and SSIM backward")
    def backward(ctx: Any, by_l1: Tensor, by_ssim: Tensor) -> tuple[Tensor, None, None]:
        image, target, derivatives = ctx.saved_tensors
        factors = torch.stack([by_l1, by_ssim])  # stay on the card: reading them would wait for it
        gradient = ctx.kernels._l1_ssim_backward(image, target, derivatives, factors, 1 / image.numel())
        return gradient, None, None
