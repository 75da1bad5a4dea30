"""Blending on the CPU by the compiled kernels, loaded through ctypes and run on Python threads (ctypes frees the GIL).

Every result is the same to the bit for any number of threads (torch.get_num_threads() are used).
"""

import ctypes
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import torch
from torch import Tensor

from .kernels.build import host_targets
from .projection import Projection

RANK_CHUNKS = 8  # parts of the depth order that are binned independently
TASKS_PER_THREAD = 8


@cache
def library() -> ctypes.CDLL | None:
    """The kernels for this processor, or None after one warning that says why there are none."""
    level = {"AVX512": 4, "AVX2": 3}.get(torch.backends.cpu.get_cpu_capability(), 2)
    reason = "none are built for this platform"
    for target in host_targets():
        if target.level > level:
            continue
        try:
            return ctypes.CDLL(str(target.path))
        except OSError as error:
            reason = str(error)
    warnings.warn(
        f"CPU kernels not loaded ({reason}); using torch, which is many times slower. "
        "To build them: python -m swag_engine.rasterize.kernels.build",
        stacklevel=2,
    )
    return None


def can_run(*tensors: Tensor) -> bool:
    """Whether the kernels take these tensors: float32 on the CPU, and the kernels could be loaded."""
    fits = all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)
    return fits and library() is not None


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="swag-kernels")


Argument = Tensor | int | float


def constant(kernel: str, *arguments: Argument) -> int:
    """Call a kernel once, on this thread; returns its integer."""
    function = getattr(library(), kernel)
    function.restype = ctypes.c_int64
    return int(function(*map(_converted, arguments)))


def run(kernel: str, count: int, *arguments: Argument) -> None:
    """Call `kernel(begin, end, *arguments)` over ranges that cover [0, count), on all threads."""
    function = getattr(library(), kernel)
    values = [_converted(argument) for argument in arguments]
    threads = torch.get_num_threads()
    tasks = min(count, TASKS_PER_THREAD * threads if threads > 1 else 1)
    _spread(lambda task: function(*_range(count, task, tasks), *values), tasks)


def run_parts(kernel: str, count: int, arguments: list[Argument], per_part: Tensor) -> None:
    """As `run`, but in as many ranges as `per_part` has rows whatever the threads; each range gets its row, last."""
    function = getattr(library(), kernel)
    values = [_converted(argument) for argument in arguments]
    parts = len(per_part)
    _spread(lambda part: function(*_range(count, part, parts), *values, _converted(per_part[part])), parts)


def _range(count: int, part: int, parts: int) -> tuple[ctypes.c_int64, ctypes.c_int64]:
    return ctypes.c_int64(count * part // parts), ctypes.c_int64(count * (part + 1) // parts)


def _spread(task: Callable[[int], None], tasks: int) -> None:
    threads = torch.get_num_threads()
    list((_threads(threads).map if threads > 1 and tasks > 1 else map)(task, range(tasks)))


def _converted(argument: Argument) -> ctypes.c_void_p | ctypes.c_int64 | ctypes.c_float:
    """A tensor as the pointer to its data."""
    if isinstance(argument, Tensor):
        assert argument.is_contiguous() and argument.device.type == "cpu"
        return ctypes.c_void_p(argument.data_ptr())
    return ctypes.c_int64(argument) if isinstance(argument, int) else ctypes.c_float(argument)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        channels: Tensor,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        n = len(means)
        viewmat, K, means, quats, scales = (tensor.contiguous() for tensor in (viewmat, K, means, quats, scales))
        means2d, conics, depths, radii = (means.new_empty(n, *shape) for shape in ((2,), (3,), (), ()))
        limits = opacities.contiguous(), channels.contiguous()
        inputs = width, height, channels.shape[1], viewmat, K, means, quats, scales, *limits
        run("project_forward", n, *inputs, means2d, conics, depths, radii)
        ctx.save_for_backward(viewmat, K, means, quats, scales, radii)
        ctx.size = width, height
        ctx.mark_non_differentiable(depths, radii)
        return means2d, conics, depths, radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_means2d: Tensor, by_conics: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        results = [torch.empty_like(tensor) for tensor in saved[2:5]]
        incoming = by_means2d.contiguous(), by_conics.contiguous()
        run("project_backward", len(results[0]), *ctx.size, *saved, *incoming, *results)
        return *results, None, None, None, None, None, None


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
    return Projection(*_Project.apply(means, quats, scales, opacities, channels, viewmat, K, width, height))


class _Blend(torch.autograd.Function):
    @staticmethod
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
        ctx.save_for_backward(
            splats, channels, order, rank_starts, ids, slots, tile_starts, background, transmittance, endings
        )
        return out, 1 - transmittance

    @staticmethod
    @torch.autograd.function.once_differentiable
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
    if pairs >= 2**31:
        raise RuntimeError(f"{drawable} Gaussians meet {pairs} tiles, more than can be blended: they are too large.")
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
