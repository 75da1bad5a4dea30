"""Blending on the CPU by the compiled kernels, loaded through ctypes and run on Python threads (ctypes frees the GIL).

Every result is the same to the bit for any number of threads (torch.get_num_threads() are used).
"""

import ctypes
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch
from torch import Tensor

from .kernels.build import host_targets

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


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="swag-kernels")


def run(kernel: str, count: int, *arguments: Tensor | int | float, tasks: int | None = None) -> None:
    """Call `kernel(begin, end, *arguments)` over ranges that cover [0, count), on all threads. Tensors go as pointers."""
    function: Callable[..., None] = getattr(library(), kernel)
    values = [_argument(value) for value in arguments]
    threads = torch.get_num_threads()
    tasks = min(count, tasks or (threads * TASKS_PER_THREAD if threads > 1 else 1))
    edges = [ctypes.c_int64(count * i // max(tasks, 1)) for i in range(tasks + 1)]
    if threads == 1 or tasks == 1:
        for begin, end in zip(edges[:-1], edges[1:], strict=True):
            function(begin, end, *values)
    else:
        list(_threads(threads).map(lambda i: function(edges[i], edges[i + 1], *values), range(tasks)))


def _argument(value: Tensor | int | float) -> ctypes.c_void_p | ctypes.c_int | ctypes.c_float:
    if isinstance(value, Tensor):
        assert value.is_contiguous() and value.device.type == "cpu"
        return ctypes.c_void_p(value.data_ptr())
    return ctypes.c_int(value) if isinstance(value, int) else ctypes.c_float(value)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, opacities, channels, background, depths, radii, width, height):
        kernels = library()
        inputs = [t.contiguous() for t in (means2d, conics, opacities, channels, background, depths, radii)]
        means2d, conics, opacities, channels, background, depths, radii = inputs
        n, channel_count = channels.shape
        splats = torch.empty(n, kernels.splat_bytes(), dtype=torch.uint8)
        keys = torch.empty(n, dtype=torch.int32)
        run("pack", n, means2d, conics, opacities, depths, radii, width, height, splats, keys)

        order, spare = torch.empty(2, n, dtype=torch.int32)
        spare_keys = torch.empty(2 * n, dtype=torch.int32)
        kernels.sort_by_depth.restype = ctypes.c_int64
        drawable = kernels.sort_by_depth(ctypes.c_int64(n), *map(_argument, (keys, order, spare, spare_keys)))

        size = kernels.tile_size()
        tiles = -(-width // size) * -(-height // size)
        rank_starts = torch.zeros(drawable + 1, dtype=torch.int64)
        per_tile = torch.zeros(RANK_CHUNKS, tiles, dtype=torch.int64)
        _run_chunks("count_tiles", drawable, splats, order, width, height, rank_starts[1:], per_tile)
        torch.cumsum(rank_starts, 0, out=rank_starts)
        entries = int(rank_starts[-1])
        if entries >= 2**31:
            raise RuntimeError(f"{drawable} Gaussians cover {entries} tiles, more than can be blended; they are too large.")
        ends = per_tile.T.reshape(-1).cumsum(0).reshape(tiles, RANK_CHUNKS)  # by tile, then by chunk: depth order in a tile
        tile_starts = torch.cat([ends.new_zeros(1), ends[:, -1]])
        ids, slots = torch.empty(2, entries, dtype=torch.int32)
        next_entry = ends.T - per_tile
        _run_chunks("fill_tiles", drawable, splats, order, width, height, rank_starts, next_entry.contiguous(), ids, slots)

        out = torch.empty(height, width, channel_count)
        transmittance = torch.empty(height, width)
        stopped = torch.empty(tiles, dtype=torch.int64)
        run(
            "blend_forward", tiles, width, height, channel_count, splats, channels, ids, tile_starts, background,
            out, transmittance, stopped,
        )  # fmt: skip
        ctx.save_for_backward(
            splats, channels, order, rank_starts, ids, slots, tile_starts, stopped, out, transmittance
        )
        return out, 1 - transmittance

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, out_gradient, alpha_gradient):
        splats, channels, order, rank_starts, ids, slots, tile_starts, stopped, out, transmittance = ctx.saved_tensors
        n, channel_count = channels.shape
        height, width = transmittance.shape
        tiles = len(stopped)
        gradients = torch.empty(len(ids), library().moment_count() + channel_count)
        background_gradients = torch.empty(tiles, channel_count)
        run(
            "blend_backward", tiles, width, height, channel_count, splats, channels, ids, slots, tile_starts, stopped,
            out, transmittance, out_gradient.contiguous(), alpha_gradient.contiguous(), gradients, background_gradients,
        )  # fmt: skip
        results = [torch.zeros(n, size) for size in (2, 3, 1, channel_count)]
        run("gather", len(rank_starts) - 1, channel_count, splats, order, rank_starts, gradients, *results)
        means2d, conics, opacities, channel_gradients = results
        background = background_gradients.double().sum(0).float()
        return means2d, conics, opacities[:, 0], channel_gradients, background, None, None, None, None


def _run_chunks(kernel, count, splats, order, width, height, per_rank, per_chunk, *outputs):
    """Run `kernel` over RANK_CHUNKS fixed ranges of ranks, each with its own row of `per_chunk`."""
    function = getattr(library(), kernel)
    fixed = [_argument(value) for value in (splats, order, width, height, per_rank)]
    rest = [_argument(value) for value in outputs]

    def chunk(i: int) -> None:
        begin, end = (ctypes.c_int64(count * j // RANK_CHUNKS) for j in (i, i + 1))
        function(begin, end, *fixed, _argument(per_chunk[i]), *rest)

    list(_threads(torch.get_num_threads()).map(chunk, range(RANK_CHUNKS)))


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
