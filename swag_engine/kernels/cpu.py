"""The backend of compiled kernels, for float32 tensors on the CPU.

Every result is the same to the bit for any number of threads (torch.get_num_threads() are used).
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..base.timing import part
from .cpu_library import constant, library, run, run_parts
from .elementwise import Colors, Project, Relit
from .protocol import Projection, check_pairs

RANK_CHUNKS = 8  # parts of the depth order that are binned independently
WATER_PARTS = 32  # ranges whose sums are added in their order


def can_run(*tensors: Tensor) -> bool:
    """Whether the kernels take these tensors: float32 on the CPU, and the library could be loaded."""
    fits = all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)
    return fits and library() is not None


def reason() -> str | None:
    """Why the kernels cannot run on this machine, None where they can."""
    return None if library() is not None else "its compiled kernels could not be loaded (see the warning)."


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
    """As projection.project, for float32 tensors on the CPU; no gradient by viewmat, K or through the depths."""
    return Projection(*Project.apply(means, quats, scales, opacities, channels, viewmat, K, width, height, run))


@dataclass
class _Blended:
    """A blended picture, and what going through its tiles once more needs."""

    out: Tensor
    transmittance: Tensor
    endings: Tensor
    splats: Tensor
    order: Tensor
    rank_starts: Tensor
    ids: Tensor
    slots: Tensor
    tile_starts: Tensor


def _blend(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    channels: Tensor,
    background: Tensor,
    depths: Tensor,
    radii: Tensor,
    width: int,
    height: int,
) -> _Blended:
    """Blend; channels (N, C) and background (C,) are contiguous."""
    n, channel_count = channels.shape
    splats = torch.empty(n, constant("splat_bytes"), dtype=torch.uint8)
    keys = torch.empty(n, dtype=torch.int32)
    geometry = [tensor.contiguous() for tensor in (means2d, conics, opacities, depths, radii)]
    run("pack", n, *geometry, width, height, splats, keys)
    order, rank_starts, tile_starts, ids, slots = _bin(splats, keys, width, height)
    out = channels.new_empty(height, width, channel_count)
    transmittance = channels.new_empty(height, width)
    endings = torch.empty(height, width, dtype=torch.int32)
    inputs = width, height, channel_count, splats, channels, ids, tile_starts, background
    run("blend_forward", len(tile_starts) - 1, *inputs, out, transmittance, endings)
    return _Blended(out, transmittance, endings, splats, order, rank_starts, ids, slots, tile_starts)


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
        b = _blend(means2d, conics, opacities, channels, background, depths, radii, width, height)
        ctx.save_for_backward(
            b.splats, channels, b.order, b.rank_starts, b.ids, b.slots, b.tile_starts, background, b.transmittance,
            b.endings,
        )  # fmt: skip
        return b.out, 1 - b.transmittance

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("rasterise backward")
    def backward(ctx: Any, out_gradient: Tensor, alpha_gradient: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        splats, channels, order, rank_starts, ids, slots, tile_starts, background, transmittance, endings = saved
        n, channel_count = channels.shape
        height, width = transmittance.shape
        tiles = len(tile_starts) - 1
        gradients = channels.new_empty(len(ids), constant("moment_count") + channel_count)
        per_tile = channels.new_empty(tiles, channel_count)
        inputs = splats, channels, ids, slots, tile_starts, background, transmittance, endings
        incoming = out_gradient.contiguous(), alpha_gradient.contiguous()
        run("blend_backward", tiles, width, height, channel_count, *inputs, *incoming, gradients, per_tile)
        means2d, conics, opacities, by_channel = (channels.new_zeros(n, size) for size in (2, 3, 1, channel_count))
        outputs = means2d, conics, opacities, by_channel
        run("gather", len(rank_starts) - 1, channel_count, splats, order, rank_starts, gradients, *outputs)
        by_background = per_tile.double().sum(0).float()
        return means2d, conics, opacities[:, 0], by_channel, by_background, None, None, None, None


def _bin(splats: Tensor, keys: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gaussians into tiles in depth order, without sorting (Gaussian, tile) pairs.

    The depth order is cut into RANK_CHUNKS parts; each counts its pairs by tile, the counts are summed into the places
    where each part writes. Returns order (V,) the V drawable Gaussians by depth, rank_starts (V + 1,) the first of each
    one's pairs, tile_starts (tiles + 1,) the first of each tile's pairs, and of the pairs by tile ids (P,) the Gaussian
    and slots (P,) the pair's number by Gaussian.
    """
    n = len(keys)
    spare = torch.empty(n, dtype=torch.int32)
    order = torch.empty(n, dtype=torch.int32)
    spare_keys = torch.empty(2 * n, dtype=torch.int32)
    drawable = constant("sort_by_depth", n, keys, order, spare, spare_keys)

    size = constant("tile_size")
    tiles = -(-width // size) * -(-height // size)
    rank_starts = torch.zeros(drawable + 1, dtype=torch.int64)
    counts = torch.zeros(RANK_CHUNKS, tiles, dtype=torch.int64)
    run_parts("count_tiles", drawable, [splats, order, width, height, rank_starts[1:]], counts)
    torch.cumsum(rank_starts, 0, out=rank_starts)
    pairs = int(rank_starts[-1])
    check_pairs(pairs)
    ends = counts.T.reshape(-1).cumsum(0).reshape(tiles, RANK_CHUNKS)  # by tile, then by part: depth order in a tile
    tile_starts = torch.cat([ends.new_zeros(1), ends[:, -1]])
    ids = torch.empty(pairs, dtype=torch.int32)
    slots = torch.empty(pairs, dtype=torch.int32)
    places = (ends.T - counts).contiguous()
    run_parts("fill_tiles", drawable, [splats, order, width, height, rank_starts, ids, slots], places)
    return order, rank_starts, tile_starts, ids, slots


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
    """As reference.blend, for float32 tensors on the CPU. The gradient is not differentiable again."""
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
    gradient: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """As reference.contributions, for float32 tensors on the CPU."""
    channels, background, weights, gradient = (t.contiguous() for t in (channels, background, weights, gradient))
    b = _blend(means2d, conics, opacities, channels, background, depths, radii, width, height)
    n, channel_count = channels.shape
    size = 2 + weights.shape[2]
    results = channels.new_empty(len(b.ids), size)
    tiles = len(b.tile_starts) - 1
    sizes = width, height, channel_count, weights.shape[2]
    lists = b.splats, channels, b.ids, b.slots, b.tile_starts, background, b.transmittance, b.endings
    run("contributions", tiles, *sizes, *lists, weights, gradient, results)
    sums = channels.new_zeros(n, size)
    run("gather_sums", len(b.rank_starts) - 1, size, b.order, b.rank_starts, results, sums)
    return sums[:, 2:], sums[:, 0], sums[:, 1]


def sh_colors(sh0: Tensor, shN: Tensor, directions: Tensor, degree: int) -> Tensor:
    """As gaussians.sh.evaluate_sh, for float32 tensors on the CPU; no gradient by directions."""
    return Colors.apply(sh0, shN, directions, degree, run)


def relit(display: Tensor, log_factor: Tensor) -> Tensor:
    """As water.light.relit, for float32 tensors on the CPU: display (..., 3), log_factor expands to its shape."""
    logs = log_factor.expand_as(display).reshape(-1, 3)
    return Relit.apply(display.reshape(-1, 3), logs, run).view_as(display)


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    @part("loss L1 and SSIM")
    def forward(ctx: Any, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        image, target = image.contiguous(), target.contiguous()
        height, width, _ = image.shape
        sums = torch.empty(height, 2, dtype=torch.float64)
        derivatives = image.new_empty(3, *image.shape)
        run("l1_ssim_forward", height, height, width, image, target, sums, derivatives)
        ctx.save_for_backward(image, target, derivatives)
        l1, similarity = (sums.sum(0) / image.numel()).float()
        return l1, similarity

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("loss L1 and SSIM backward")
    def backward(ctx: Any, by_l1: Tensor, by_ssim: Tensor) -> tuple[Tensor, None]:
        image, target, derivatives = ctx.saved_tensors
        height, width, _ = image.shape
        gradient = torch.empty_like(image)
        factors = float(by_l1) / image.numel(), float(by_ssim) / image.numel()
        run("l1_ssim_backward", height, height, width, image, target, derivatives, *factors, gradient)
        return gradient, None


def l1_ssim(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Mean absolute difference and mean SSIM of (H, W, 3) float32 images on the CPU; differentiable in image."""
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
    """As training.optimizer.adam_step, for contiguous float32 tensors on the CPU."""
    corrected = lr / (1 - beta1**step), 1 / math.sqrt(1 - beta2**step)
    weights = beta1, 1 - beta1, beta2, 1 - beta2
    tensors = parameter, gradient.contiguous(), exp_avg, exp_avg_sq
    run("adam_step", parameter.numel(), *tensors, *corrected, *weights, eps)


class _Water(torch.autograd.Function):
    @staticmethod
    @part("water")
    def forward(ctx: Any, colors: Tensor, offsets: Tensor, values: Tensor, degree: int, linear: bool) -> Tensor:
        colors, offsets, values = colors.contiguous(), offsets.contiguous(), values.contiguous()
        shown = torch.empty_like(colors)
        run("water_forward", len(colors), degree, int(linear), values, colors, offsets, shown)
        ctx.save_for_backward(colors, offsets, values)
        ctx.mode = degree, int(linear)
        return shown

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("water backward")
    def backward(ctx: Any, by_shown: Tensor) -> tuple[Tensor | None, ...]:
        colors, offsets, values = ctx.saved_tensors
        by_colors, by_offsets = torch.empty_like(colors), torch.empty_like(offsets)
        sums = torch.empty(WATER_PARTS, values.numel(), dtype=torch.float64)
        arguments = [*ctx.mode, values, colors, offsets, by_shown.contiguous(), by_colors, by_offsets]
        run_parts("water_backward", len(colors), arguments, sums)
        return by_colors, by_offsets, sums.sum(0).float(), None, None


def through_water(colors: Tensor, offsets: Tensor, values: Tensor, degree: int, linear: bool) -> Tensor:
    """As water.medium.through_water, for float32 tensors on the CPU; values (33,): beta_D, beta_B, veil (9, 3)."""
    return _Water.apply(colors, offsets, values, degree, linear)


class _OpenWater(torch.autograd.Function):
    @staticmethod
    @part("water")
    def forward(
        ctx: Any, values: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, degree: int, linear: bool
    ) -> Tensor:
        values, viewmat, K = values.contiguous(), viewmat.contiguous(), K.contiguous()
        shown = values.new_empty(height, width, 3)
        run("open_water_forward", height, width, degree, int(linear), values, viewmat, K, shown)
        ctx.save_for_backward(values, viewmat, K)
        ctx.mode = width, degree, int(linear)
        return shown

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("water backward")
    def backward(ctx: Any, by_shown: Tensor) -> tuple[Tensor | None, ...]:
        values, viewmat, K = ctx.saved_tensors
        sums = torch.empty(WATER_PARTS, values.numel(), dtype=torch.float64)
        run_parts("open_water_backward", len(by_shown), [*ctx.mode, values, viewmat, K, by_shown.contiguous()], sums)
        return sums.sum(0).float(), None, None, None, None, None, None


def open_water(
    values: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, degree: int, linear: bool
) -> Tensor:
    """As water.medium.open_water, for float32 tensors on the CPU."""
    return _OpenWater.apply(values, viewmat, K, width, height, degree, linear)
