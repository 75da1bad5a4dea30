"""Choice of tiles of mixed levels of detail within a number of splats. Blender imports it."""

import heapq
from collections import defaultdict
from collections.abc import Callable

from ..base.errors import InputError
from .survey_tiles import Tile, Tiles


def finest_level(tiles: Tiles, budget: int) -> list[Tile]:
    """Return the tiles of the finest level that has no more splats than `budget`.

    Raises:
        InputError: If the coarsest level has more.
    """
    fitting = [level for level in tiles.levels if level.splats <= budget]
    if not fitting:
        raise InputError(_too_many(tiles, budget))
    return tiles.of_level(min(level.level for level in fitting))


def refine(tiles: Tiles, budget: int, need: Callable[[Tile], float]) -> list[Tile]:
    """Choose tiles that cover the survey once: coarse ones, and finer ones in place of those that need it most.

    From the tiles of the coarsest level on, the tile of the largest need is replaced by the tiles of the next finer
    level in its cube, as long as all tiles together have no more than `budget` splats.

    Args:
        tiles: Tiles of all levels.
        budget: Largest number of splats.
        need: How much a tile must be replaced by finer ones; 0 where it is fine enough.

    Returns:
        The tiles, in no order.

    Raises:
        InputError: If the coarsest level has more splats than `budget`.
    """
    coarsest = max(level.level for level in tiles.levels)
    chosen = {tile.file: tile for tile in tiles.of_level(coarsest)}
    total = sum(tile.splats for tile in chosen.values())
    if total > budget:
        raise InputError(_too_many(tiles, budget))
    finer: dict[tuple[int, tuple[int, ...]], list[Tile]] = defaultdict(list)
    for tile in tiles.tiles:
        finer[tile.level + 1, tuple(number // 2 for number in tile.cell)].append(tile)
    queue = [(-need(tile), tile.file) for tile in chosen.values()]
    heapq.heapify(queue)
    while queue and queue[0][0] < 0:
        tile = chosen[heapq.heappop(queue)[1]]
        parts = finer.get((tile.level, tile.cell), [])
        grown = total + sum(part.splats for part in parts) - tile.splats
        if not parts or grown > budget:
            continue
        del chosen[tile.file]
        total = grown
        for part in parts:
            chosen[part.file] = part
            heapq.heappush(queue, (-need(part), part.file))
    return list(chosen.values())


def _too_many(tiles: Tiles, budget: int) -> str:
    least = min(level.splats for level in tiles.levels)
    return (
        f"The coarsest level of {tiles.folder} has {least:,} splats, more than the {budget:,} that may be loaded: "
        "raise the number of splats."
    )
