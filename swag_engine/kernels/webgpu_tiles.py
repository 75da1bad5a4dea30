"""The lists of the Gaussians of each tile, in depth order, by the kernels of sort.wgsl and tiles.wgsl."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from .webgpu_device import WebGpu, WebGpuUnavailable, Workspace, request

THREADS = 256
"""Threads of a group that takes an item each; as in common.wgsl."""
TILE = 16
"""Width and height of a tile, pixels; as in splat.wgsl and ssim.wgsl."""
SPLAT_NUMBERS = 10
"""Size of a packed Gaussian, numbers; as in splat.wgsl."""
MOMENTS = 6
"""Sums that the gradients by the geometry are made of; as in blend.wgsl."""
GROUP = 4
"""Channels that a kernel takes at once; as in blend.wgsl."""
RADIX_BITS = 4
"""Bits of a key that one pass of the sort takes; as in sort.wgsl."""
BLOCK = 1024
"""Keys that a group of threads sorts; as in sort.wgsl."""

CHECKED = 70 * BLOCK
"""Keys that a device sorts before it is used: so many that the counts of their digits are in two blocks."""


@dataclass(frozen=True)
class TileGrid:
    """The tiles of an image.

    Attributes:
        width: Width of the image, pixels.
        height: Height of the image, pixels.
    """

    width: int
    height: int

    @property
    def across(self) -> int:
        """Tiles in a row."""
        return -(-self.width // TILE)

    @property
    def down(self) -> int:
        """Rows of tiles."""
        return -(-self.height // TILE)

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return self.across * self.down


@dataclass(frozen=True)
class TileRows:
    """Rows of tiles whose pairs are in one list.

    Attributes:
        number: Number of the list.
        first: First row.
        end: Row after the last.
    """

    number: int
    first: int
    end: int


@dataclass(frozen=True)
class DepthOrder:
    """N Gaussians by depth.

    Attributes:
        splats: (N, SPLAT_NUMBERS) Gaussians as they are blended.
        keys: (N,) sorted keys.
        ids: (N,) the Gaussians in their order.
        count: N.
    """

    splats: Any
    keys: Any
    ids: Any
    count: int


@dataclass(frozen=True)
class Counted:
    """Pairs of a Gaussian and a tile, counted.

    Attributes:
        starts: (N,) where the pairs of each rank of the depth order begin in those of their block.
        total: The number of pairs, then that before each block.
    """

    starts: Any
    total: Any


def _sums(space: Workspace, name: str, data: Any, count: int) -> Any:
    """Replace numbers by the sums of those before in their block; return the total and what is before each block."""
    blocks = -(-count // BLOCK)
    sums, call = space.empty(f"{name}.sums", blocks + 1), {"count": count, "blocks": blocks}
    space.run("sum_blocks", blocks, call, data=data, sums=sums)
    space.run("sum_totals", 1, call, sums=sums)
    return sums


def _sort(space: Workspace, name: str, keys: Any, values: Any, count: int, bits: int) -> tuple[Any, Any]:
    """Sort by the lowest bits of the keys; equal keys keep their order."""
    blocks = -(-count // BLOCK)
    spare = space.empty("sort.keys", count), space.empty(f"{name}.spare", count)
    counts = space.empty("sort.counts", blocks << RADIX_BITS)
    for shift in range(0, bits, RADIX_BITS):
        call = {"count": count, "shift": shift, "blocks": blocks}
        space.run("count_digits", blocks, call, keys_in=keys, data=counts)
        sums = _sums(space, "sort", counts, blocks << RADIX_BITS)
        moved = {"keys_in": keys, "values_in": values, "keys_out": spare[0], "values_out": spare[1]}
        space.run("move_by_digit", blocks, call, **moved, data=counts, sums=sums)
        (keys, values), spare = spare, (keys, values)
    return keys, values


def request_checked() -> WebGpu:
    """Get a device that sorts: one whose barriers or sums are wrong does not.

    Raises:
        WebGpuUnavailable: There is none.
        WebGpuFailure: The device failed.
    """
    gpu = request()
    check(gpu)
    return gpu


def check(gpu: WebGpu) -> None:
    """Let a device sort, to find out whether its barriers and sums in workgroup memory are right.

    Raises:
        WebGpuUnavailable: It sorts wrongly.
        WebGpuFailure: It failed.
    """
    keys = torch.from_numpy(np.random.default_rng(0).integers(0, 2**8, CHECKED, dtype=np.int32))
    numbers = torch.arange(CHECKED, dtype=torch.int32)
    _, ids = _sort(Workspace(gpu, keeps=False), "check", gpu.upload(keys), gpu.upload(numbers), CHECKED, 8)
    if not torch.equal(gpu.read(ids, (CHECKED,), torch.int32).long(), torch.sort(keys, stable=True).indices):
        raise WebGpuUnavailable(f"{gpu.adapter_name} computes wrongly: it does not sort. Update its driver.")


def depth_order(space: Workspace, splats: Any, keys: Any, ids: Any, count: int) -> DepthOrder:
    """Sort packed Gaussians by depth.

    Args:
        space: Where the lists are.
        splats: (N, SPLAT_NUMBERS) packed Gaussians.
        keys: (N,) their keys.
        ids: (N,) 0 to N - 1.
        count: N.

    Returns:
        The order.
    """
    return DepthOrder(splats, *_sort(space, "order", keys, ids, count, 32), count)


def count_tiles(space: Workspace, order: DepthOrder, grid: TileGrid, rows: TileRows) -> Counted:
    """Count the pairs of a Gaussian and a tile of some rows.

    Args:
        space: Where the lists are.
        order: The Gaussians.
        grid: The tiles.
        rows: Which of them count.

    Returns:
        The counts, for `list_tiles`.
    """
    starts = space.empty("starts", order.count)
    buffers = {"splats": order.splats, "sorted_keys": order.keys, "order": order.ids, "counts": starts}
    space.run("count_tiles", -(-order.count // THREADS), _call(order, grid, rows), **buffers)
    return Counted(starts, _sums(space, "pairs", starts, order.count))


def list_tiles(
    space: Workspace,
    order: DepthOrder,
    counted: Counted,
    grid: TileGrid,
    rows: TileRows,
    room: int,
    ranges: Any,
    found: Any,
) -> Any:
    """List the Gaussians of each tile of some rows.

    Args:
        space: Where the lists are.
        order: The Gaussians.
        counted: What `count_tiles` returned for these rows.
        grid: The tiles.
        rows: Which of them are listed.
        room: Pairs that the list holds.
        ranges: (tiles, 2) where each tile's pairs begin and end, 0 before; those of the rows are set.
        found: (lists, 2) for each list the number of pairs and `room`; that of these rows is set.

    Returns:
        (room,) the Gaussian of each pair, by tile, in a tile by depth.
    """
    keys, ids = space.empty("pairs.keys", room), space.empty(f"pairs.{rows.number}", room)
    call = _call(order, grid, rows) | {"room": room}
    lists = {"starts": counted.starts, "totals": counted.total, "keys": keys, "ids": ids, "found": found}
    groups = -(-max(order.count, room) // THREADS)
    space.run("fill_tiles", groups, call, splats=order.splats, order=order.ids, **lists)
    keys, ids = _sort(space, f"pairs.{rows.number}", keys, ids, room, grid.tiles.bit_length())
    space.run("find_ranges", -(-room // THREADS), call, sorted_keys=keys, ranges=ranges)
    return ids


def _call(order: DepthOrder, grid: TileGrid, rows: TileRows) -> dict[str, int]:
    return {
        "count": order.count, "width": grid.width, "height": grid.height, "first_row": rows.first, "end_row": rows.end,
        "band": rows.number,
    }  # fmt: skip
