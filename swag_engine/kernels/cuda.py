"""The backend of CUDA kernels, for float32 tensors on an NVIDIA card.

There are no atomic sums: every result is the same to the bit each time.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

from ..base.timing import part
from .cuda_driver import Argument, CudaUnavailable, Driver
from .elementwise import Colors, Project, Relit
from .protocol import Projection, check_pairs

# As in kernels/common.cuh, splat.cuh, blend.cu and ssim.cu.
THREADS, WARP = 256, 32
TILE = 16
SPLAT_FLOATS = 10
MOMENTS = 6
WEIGHTS = 6
GROUP = 8  # channels that a kernel takes at most


@cache
def driver() -> Driver | str:
    """What launches the kernels, or why nothing does."""
    try:
        return Driver()
    except CudaUnavailable as reason:
        return str(reason)


def can_run(*tensors: Tensor) -> bool:
    """Whether the kernels take these tensors: float32 on the card, and the kernels could be loaded."""
    launcher = driver()
    return not isinstance(launcher, str) and all(
        tensor.device.type == launcher.device_type and tensor.dtype == torch.float32 for tensor in tensors
    )


def reason() -> str | None:
    """Why the kernels cannot run on this machine, None where they can."""
    launcher = driver()
    return launcher if isinstance(launcher, str) else None


def _run(kernel: str, threads: int, *arguments: Argument) -> None:
    """Run a kernel with at least as many threads."""
    launcher = driver()
    assert not isinstance(launcher, str)
    launcher.launch(kernel, -(-threads // THREADS), THREADS, list(arguments))


def _run_each(kernel: str, count: int, *arguments: Argument) -> None:
    """Run a kernel with a thread for each of `count` things."""
    _run(kernel, count, count, *arguments)


def _run_by_channel(kernel: str, count: int, *arguments: Argument) -> None:
    """Run a kernel with a thread for each channel of `count` colours."""
    _run(kernel, 3 * count, count, *arguments)


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    channels: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
) -> Projection:
    """As projection.project, for float32 tensors on the card; no gradient by viewmat, K or through the depths."""
    return Projection(
        *Project.apply(means, quats, scales, opacities, channels, viewmat.double(), K, width, height, _run_each)
    )


@dataclass
class _Pairs:
    """P pairs of a Gaussian and a tile it meets.

    splats (N, SPLAT_FLOATS): Gaussians as they are blended. order (N,): Gaussians by depth, equal depths by index;
    rank_starts (N + 1,): where the slots of each rank's pairs begin. By tile, in a tile by depth: ids (P,), the
    Gaussian, slots (P,), where the pair's gradients go; tile_starts (tiles + 1,): where each tile's pairs begin.
    """

    splats: Tensor
    order: Tensor
    rank_starts: Tensor
    ids: Tensor
    slots: Tensor
    tile_starts: Tensor


def _pairs(
    means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, radii: Tensor, width: int, height: int
) -> _Pairs:
    n = len(means2d)
    splats, keys = means2d.new_empty(n, SPLAT_FLOATS), means2d.new_empty(n)
    geometry = [tensor.contiguous() for tensor in (means2d, conics, opacities, depths, radii)]
    _run_each("pack", n, *geometry, width, height, splats, keys)
    keys, order = keys.sort(stable=True)
    rank_starts = torch.zeros(n + 1, dtype=torch.int64, device=order.device)
    _run_each("count_tiles", n, splats, keys, order, width, height, rank_starts[1:])
    rank_starts.cumsum_(0)
    pairs = int(rank_starts[-1])
    check_pairs(pairs)

    tiles = -(-width // TILE) * -(-height // TILE)
    dtype = torch.int16 if tiles < 2**15 else torch.int32  # half the bytes to sort
    tile_of, ids = order.new_empty(pairs, dtype=dtype), order.new_empty(pairs, dtype=torch.int32)
    kernel = f"fill_tiles_{str(dtype).removeprefix('torch.')}"
    _run_each(kernel, n, splats, order, width, height, rank_starts, tile_of, ids)
    tile_of, slots = tile_of.sort(stable=True)
    tile_starts = torch.searchsorted(tile_of, torch.arange(tiles + 1, dtype=dtype, device=order.device))
    return _Pairs(splats, order, rank_starts, ids[slots], slots, tile_starts)


def _blend(
    pairs: _Pairs, channels: Tensor, background: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The picture, the transmittance behind all, and where in its tile's list each pixel ended."""
    channel_count = channels.shape[1]
    out = channels.new_empty(height, width, channel_count)
    transmittance = channels.new_empty(height, width)
    endings = torch.empty(height, width, dtype=torch.int32, device=channels.device)
    threads = (len(pairs.tile_starts) - 1) * THREADS
    lists = pairs.splats, channels, pairs.ids, pairs.tile_starts, background
    for first in range(0, channel_count, GROUP):
        kernel = f"blend_forward_{min(GROUP, channel_count - first)}"
        _run(kernel, threads, width, height, channel_count, first, *lists, out, transmittance, endings)
    return out, transmittance, endings


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
    ) -> tuple[Tensor, Tensor]:
        channels, background = channels.contiguous(), background.contiguous()
        p = _pairs(means2d, conics, opacities, depths, radii, width, height)
        out, transmittance, endings = _blend(p, channels, background, width, height)
        lists = p.splats, p.order, p.rank_starts, p.ids, p.slots, p.tile_starts
        ctx.save_for_backward(*lists, channels, background, transmittance, endings)
        return out, 1 - transmittance

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("rasterise backward")
    def backward(ctx: Any, by_out: Tensor, by_alpha: Tensor) -> tuple[Tensor | None, ...]:
        *lists, channels, background, transmittance, endings = ctx.saved_tensors
        p = _Pairs(*lists)
        n, channel_count = channels.shape
        height, width = transmittance.shape
        by_out, by_alpha = by_out.contiguous(), by_alpha.contiguous()
        gradients = channels.new_empty(len(p.ids), MOMENTS + channel_count)
        threads = (len(p.tile_starts) - 1) * THREADS
        inputs = p.splats, channels, p.ids, p.tile_starts, background, transmittance, endings, p.slots
        for first in range(0, channel_count, GROUP):
            kernel = f"blend_backward_{min(GROUP, channel_count - first)}"
            _run(kernel, threads, width, height, channel_count, first, *inputs, by_out, by_alpha, gradients)
        outputs = [channels.new_empty(n, *shape) for shape in ((2,), (3,), (), (channel_count,))]
        _run("gather_gradients", n * WARP, n, channel_count, p.splats, p.order, p.rank_starts, gradients, *outputs)
        by_background = (transmittance[..., None] * by_out).sum((0, 1))
        return *outputs, by_background, None, None, None, None


def blend(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    channels: Tensor,
    background: Tensor,
    depths: Tensor,
    radii: Tensor,
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """As reference.blend, for float32 tensors on the card. The gradient is not differentiable again."""
    return _Blend.apply(means2d, conics, opacities, channels, background, depths, radii, width, height)


def contributions(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    channels: Tensor,
    background: Tensor,
    depths: Tensor,
    radii: Tensor,
    width: int,
    height: int,
    weights: Tensor,
    image_gradient: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """As reference.contributions, for float32 tensors on the card and at most GROUP channels."""
    images = weights.contiguous(), image_gradient.contiguous()
    channels, background = channels.contiguous(), background.contiguous()
    n, channel_count = channels.shape
    p = _pairs(means2d, conics, opacities, depths, radii, width, height)
    _, transmittance, endings = _blend(p, channels, background, width, height)
    weight_count = weights.shape[2]
    size = 2 + weight_count
    results, sums = channels.new_empty(len(p.ids), size), channels.new_empty(n, size)
    threads = (len(p.tile_starts) - 1) * THREADS
    lists = p.splats, channels, p.ids, p.tile_starts, background, transmittance, endings, p.slots
    for first in range(0, max(weight_count, 1), WEIGHTS):
        kernel = f"contributions_{channel_count}"
        _run(kernel, threads, width, height, weight_count, first, *lists, *images, results)
    _run("gather_sums", n * WARP, n, size, p.order, p.rank_starts, results, sums)
    return sums[:, 2:], sums[:, 0], sums[:, 1]


def sh_colors(sh0: Tensor, shN: Tensor, directions: Tensor, degree: int) -> Tensor:
    """As gaussians.sh.evaluate_sh, for float32 tensors on the card; no gradient by directions."""
    return Colors.apply(sh0, shN, directions, degree, _run_by_channel)


def relit(display: Tensor, log_factor: Tensor) -> Tensor:
    """As water.light.relit, for float32 tensors on the card: display (..., 3), log_factor expands to its shape."""
    logs = log_factor.expand_as(display).reshape(-1, 3)
    return Relit.apply(display.reshape(-1, 3), logs, _run_by_channel).view_as(display)


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    @part("loss L1 and SSIM")
    def forward(ctx: Any, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        image, target = image.contiguous(), target.contiguous()
        height, width, _ = image.shape
        squares = -(-height // TILE) * -(-width // TILE)
        sums, derivatives = image.new_empty(squares, 2), image.new_empty(3, *image.shape)
        _run("l1_ssim_forward", squares * THREADS, height, width, image, target, sums, derivatives)
        ctx.save_for_backward(image, target, derivatives)
        l1, similarity = (sums.sum(0, dtype=torch.float64) / image.numel()).float()
        return l1, similarity

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("loss L1 and SSIM backward")
    def backward(ctx: Any, by_l1: Tensor, by_ssim: Tensor) -> tuple[Tensor, None]:
        image, target, derivatives = ctx.saved_tensors
        height, width, _ = image.shape
        squares = -(-height // TILE) * -(-width // TILE)
        factors = torch.stack([by_l1, by_ssim])  # stay on the card: reading them would wait for it
        gradient = torch.empty_like(image)
        inputs = image, target, derivatives, factors, 1 / image.numel()
        _run("l1_ssim_backward", squares * THREADS, height, width, *inputs, gradient)
        return gradient, None


def l1_ssim(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Mean absolute difference and mean SSIM of (H, W, 3) float32 images on the card; differentiable in image."""
    return _L1Ssim.apply(image, target)


def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    lr: float,
    beta1: float,
    beta2: float,
    eps: float,
    step: int,
) -> None:
    """As training.optimizer.adam_step, for contiguous float32 tensors on the card."""
    count = parameter.numel()
    corrected = lr / (1 - beta1**step), math.sqrt(1 - beta2**step)
    tensors = parameter, gradient.contiguous(), exp_avg, exp_avg_sq
    _run_each("adam_step", count, *tensors, *corrected, 1.0 - beta1, 1.0 - beta2, float(eps))


class _Water(torch.autograd.Function):
    @staticmethod
    @part("water")
    def forward(ctx: Any, colors: Tensor, offsets: Tensor, values: Tensor, degree: int, linear: bool) -> Tensor:
        colors, offsets, values = colors.contiguous(), offsets.contiguous(), values.contiguous()
        shown, n = torch.empty_like(colors), len(colors)
        _run_each("water_forward", n, degree, int(linear), values, colors, offsets, shown)
        ctx.save_for_backward(colors, offsets, values)
        ctx.mode = degree, int(linear)
        return shown

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("water backward")
    def backward(ctx: Any, by_shown: Tensor) -> tuple[Tensor | None, ...]:
        colors, offsets, values = ctx.saved_tensors
        n, by_colors, by_offsets = len(colors), torch.empty_like(colors), torch.empty_like(offsets)
        sums = values.new_empty(-(-n // THREADS), len(values))
        inputs = values, colors, offsets, by_shown.contiguous()
        _run_each("water_backward", n, *ctx.mode, *inputs, by_colors, by_offsets, sums)
        return by_colors, by_offsets, sums.sum(0, dtype=torch.float64).float(), None, None


def through_water(colors: Tensor, offsets: Tensor, values: Tensor, degree: int, linear: bool) -> Tensor:
    """As water.medium.through_water, for float32 tensors on the card; values (33,): beta_D, beta_B, veil (9, 3)."""
    return _Water.apply(colors, offsets, values, degree, linear)


class _OpenWater(torch.autograd.Function):
    @staticmethod
    @part("water")
    def forward(
        ctx: Any, values: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, degree: int, linear: bool
    ) -> Tensor:
        values, viewmat, K = values.contiguous(), viewmat.contiguous(), K.contiguous()
        shown, pixels = values.new_empty(height, width, 3), height * width
        _run_each("open_water_forward", pixels, width, degree, int(linear), values, viewmat, K, shown)
        ctx.save_for_backward(values, viewmat, K)
        ctx.mode = width, degree, int(linear)
        return shown

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("water backward")
    def backward(ctx: Any, by_shown: Tensor) -> tuple[Tensor | None, ...]:
        values, viewmat, K = ctx.saved_tensors
        pixels = by_shown.numel() // 3
        sums = values.new_empty(-(-pixels // THREADS), len(values))
        _run_each("open_water_backward", pixels, *ctx.mode, values, viewmat, K, by_shown.contiguous(), sums)
        return sums.sum(0, dtype=torch.float64).float(), None, None, None, None, None, None


def open_water(
    values: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, degree: int, linear: bool
) -> Tensor:
    """As water.medium.open_water, for float32 tensors on the card."""
    return _OpenWater.apply(values, viewmat, K, width, height, degree, linear)
