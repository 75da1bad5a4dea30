"""Merging of the blocks of a survey into tiles in levels of detail.

Each block contributes the Gaussians in its core, except those in a seam, which come from the seam. Blocks and tiles are
read one after the other, so that the memory does not grow with the survey. The files depend on the results of the
blocks and seams alone, to the bit.

The name of a tile's file ends in a hash of its content, and tiles.json is written last: until then the tiles of an
earlier merge are in place. Files that tiles.json does not list are removed.
"""

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, reading, remedy
from ..base.files import locked_folder, not_writable, temporary_folder
from ..base.text import first_names
from ..formats.ply import read_ply, write_ply
from ..formats.run_folder import read_json
from ..formats.select import LABEL
from ..formats.survey_folder import COARSE, VERSION, Survey, SurveyFolder
from ..formats.survey_tiles import Cell, Level, Tile, Tiles
from ..products.tiles import Progress
from ..splats.splats import Splats, concatenate
from .job import hash_of
from .labels import SurveyLabels
from .levels import coarser

TILE_SPLATS = 32_768
"""Most splats of the tile that the average splat is in, at level 0: 8 MB at SH degree 3."""
COARSEST = 50_000
"""Splats of a level that needs no coarser one."""
SAMPLES = 4096
"""Positions of a block that the size of tiles is chosen by."""
ARRAYS = ("positions", "rotations", "scales", "opacities", "sh")
"""The arrays of splats besides extras."""
TILE = re.compile(r"-?\d+_-?\d+_-?\d+-[0-9a-f]{12}\.ply")
"""Names of the files of tiles."""
NEW = "new.ply"
"""Name of the file of a tile whose content is not known yet."""
VISIBLE = 1 / 255
"""Least opacity that is drawn (kernels/reference/projection.py)."""


def merge_survey(folder: Path, progress: Progress | None = None, partial: bool = False) -> dict[str, Any]:
    """Make tiles of all levels of detail from the results of the blocks; an earlier merge is replaced.

    Args:
        folder: Folder of the survey.
        progress: Called with the stage of the work and its fraction; what it raises ends the work.
        partial: Merge the blocks that are done, although others are not.

    Returns:
        `folder`, of the tiles; `blocks`, names of those (with the seams) that were merged, and `missing`, of those that
        are not done;
        `splats` of level 0; `tiles`, their number in all levels; `levels`, as in tiles.json; `notes`, sentences for the
        user.

    Raises:
        InputError: If blocks are not done, their results are damaged or have no splats in their cores, another process
            merges the survey, or the tiles cannot be written.
    """
    survey_folder = SurveyFolder(folder)
    survey = survey_folder.read()
    done = [name for name in survey.parts if survey_folder.done(name).exists()]
    missing = [name for name in survey.parts if name not in done]
    if missing and not (partial and set(done).intersection(survey.blocks)):
        raise InputError(
            f"{len(missing)} of {len(survey.parts)} blocks and seams of {folder} are not done: {first_names(missing)}. "
            + remedy(
                "Run them with survey run, or merge the others with --partial.",
                "Run the command that Copy copies, or press Merge Finished Blocks.",
            )
        )
    with locked_folder(survey_folder.merged):
        tiles = _Merge(survey_folder, survey, done, progress or (lambda stage, fraction: None)).run()
    notes = []
    if missing:
        notes.append(
            f"{len(missing)} of {len(survey.parts)} blocks and seams are missing here: {first_names(missing)}."
        )
    return {
        "folder": str(tiles.folder),
        "blocks": done,
        "missing": missing,
        "splats": tiles.levels[0].splats,
        "tiles": len(tiles.tiles),
        "levels": [vars(level) for level in tiles.levels],
        "notes": notes,
    }


def describe(document: dict[str, Any]) -> str:
    """Format what `merge_survey` returned as the lines that `survey merge` prints."""
    lines = [
        f"{len(document['blocks'])} blocks and seams merged: {document['splats']:,} splats, {document['tiles']} tiles.",
        *(
            f"Level {each['level']}: {each['splats']:,} splats, {each['bytes'] / 1e6:.1f} MB"
            for each in document["levels"]
        ),
        *document["notes"],
        f"Tiles: {document['folder']}",
    ]
    return "\n".join(lines)


class _Merge:
    """One merge of the given blocks."""

    def __init__(self, folder: SurveyFolder, survey: Survey, blocks: Sequence[str], progress: Progress) -> None:
        self.folder, self.survey, self.blocks, self.progress = folder, survey, blocks, progress
        self.seams = [folder.read_block(name) for name in blocks if name in survey.seams]
        self.merged = folder.merged
        self.labels = SurveyLabels.of(folder, blocks)
        self.label_counts = np.zeros(len(self.labels.names) + 1, np.int64)

    def run(self) -> Tiles:
        """Write all tiles, then tiles.json."""
        try:
            tiles = self._tiles()
            self.labels.write(self.merged, self.label_counts[1:].tolist())
            tiles.write()
            return tiles
        except OSError as error:
            raise not_writable(self.merged, error) from error
        finally:
            _remove_unlisted(self.merged)

    def _tiles(self) -> Tiles:
        pattern, positions, weights = self._examine()
        edge = tile_edge(positions, weights)
        latest = self._finest(pattern, edge)
        tiles = list(latest)
        while sum(tile.splats for tile in latest) > COARSEST:
            coarse = self._coarser(latest)
            if sum(tile.splats for tile in coarse) == sum(tile.splats for tile in latest):
                break  # each splat is alone in its cube
            latest = coarse
            tiles += latest
        levels = tuple(self._level(list(those)) for _, those in groupby(tiles, lambda tile: tile.level))
        x, y, z = self.survey.ground.axes[2]
        return Tiles(self.merged, edge, (x, y, z), self._background(), levels, tuple(tiles))

    def _level(self, tiles: Sequence[Tile]) -> Level:
        """Return the figures of the level of these tiles."""
        size = sum((self.merged / tile.file).stat().st_size for tile in tiles)
        return Level(tiles[0].level, sum(tile.splats for tile in tiles), size)

    def _background(self) -> tuple[float, float, float]:
        """Return the color behind the coarse model, black without one."""
        metrics = self.folder.run(COARSE).metrics
        if not metrics.exists():
            return 0.0, 0.0, 0.0
        document = read_json(metrics, "")
        with reading(metrics, "run the survey again"):
            red, green, blue = map(float, document.get("background", (0, 0, 0)))
            return red, green, blue

    def _examine(self) -> tuple[Splats, np.ndarray, np.ndarray]:
        """Check the results of the blocks.

        Returns:
            No splats, with the properties that those of any block have, so that all tiles get the same; positions
            (N, 3) of some splats, and how many splats each of them stands for (N,).
        """
        patterns: list[Splats] = []
        positions, weights = [], []
        for number, name in enumerate(self.blocks):
            self.progress("Checking the blocks", number / len(self.blocks))
            self._check(name)
            core = self._core(name)
            patterns = [concatenate([*patterns, core.subset(np.arange(0))])]
            chosen = core.positions[:: max(1, -(-len(core) // SAMPLES))].copy()
            positions.append(chosen)
            weights.append(np.full(len(chosen), len(core) / max(1, len(chosen))))
        if not sum(map(len, positions)):
            raise InputError(f"No block of {self.folder.path} has a Gaussian in its core; plan the survey again.")
        return patterns[0], np.concatenate(positions), np.concatenate(weights)

    def _check(self, name: str) -> None:
        """Raise InputError where the result of a block is not what done.json says."""
        file, result = self.folder.done(name), self.folder.run(name).ply
        again = f"run the block {name} again " + remedy(
            f"(survey block {self.folder.path} --block {name})", "by the command that Copy copies"
        )
        document = read_json(file, f"The block {name} is not done any more; run it again.")
        if document.get("version") != VERSION or not isinstance(document.get("result_sha256"), str):
            raise InputError(f"{file} is damaged or of another version: {again}.")
        try:
            digest = hash_of(result)
        except InputError as error:
            raise InputError(f"{str(error).rstrip('.')}; {again}.") from error
        if digest != document["result_sha256"]:
            raise InputError(f"{result} was changed or damaged after the block was done: {again}.")

    def _core(self, name: str) -> Splats:
        """Return the splats that a block or seam contributes.

        Of a seam these are all: each started in it, wherever it is now. Of a block these are the ones in its core that
        did not start in a seam, as the Gaussians of the block are where the seam has found them.
        """
        splats = read_ply(self.folder.run(name).ply)
        if name in self.survey.blocks:
            places = self.survey.ground.on_ground(splats.positions)
            chosen = self.folder.read_block(name).in_core(places)
            for seam in self.seams:
                chosen &= ~seam.in_core(places)
            splats = splats.subset(chosen)
        return self.labels.renumbered(name, splats)

    def _finest(self, pattern: Splats, edge: float) -> list[Tile]:
        """Write the tiles of level 0."""
        parts: dict[Cell, list[tuple[Path, slice]]] = {}
        tiles = []
        with temporary_folder(self.merged) as staging:
            for number, name in enumerate(self.blocks):
                self.progress("Cutting into tiles", 0.5 * number / len(self.blocks))
                splats = concatenate([self._core(name), pattern])
                if LABEL in splats.extras:
                    counts = np.bincount(splats.extras[LABEL], minlength=len(self.label_counts))
                    self.label_counts += counts[: len(self.label_counts)]  # numbers beyond have no name
                order, cells = by_cell(splats.positions, edge)
                sorted_rows = staging / f"{number}.npy"
                np.save(sorted_rows, _rows(splats)[order])
                for cell, place in cells.items():
                    parts.setdefault(cell, []).append((sorted_rows, place))
            for number, cell in enumerate(sorted(parts)):
                self.progress("Cutting into tiles", 0.5 + 0.5 * number / len(parts))
                rows = [np.load(file, mmap_mode="r")[place] for file, place in parts[cell]]
                tiles.append(self._store(0, cell, _splats(np.concatenate(rows), pattern)))
        return tiles

    def _coarser(self, tiles: Sequence[Tile]) -> list[Tile]:
        """Write the tiles of the level above the one of `tiles`."""
        level = tiles[0].level + 1
        children: dict[Cell, list[Tile]] = {}
        for tile in tiles:
            x, y, z = tile.cell
            children.setdefault((x // 2, y // 2, z // 2), []).append(tile)
        result = []
        for number, cell in enumerate(sorted(children)):
            self.progress(f"Level of detail {level}", number / len(children))
            made: list[Splats] = []
            waiting: list[Splats] = []  # small tiles are merged together
            for child in children[cell]:
                if sum(map(len, waiting)) + child.splats > TILE_SPLATS and waiting:
                    made.append(coarser(concatenate(waiting)))
                    waiting = []
                waiting.append(read_ply(self.merged / child.file))
            made.append(coarser(concatenate(waiting)))
            result.append(self._store(level, cell, concatenate(made)))
        return result

    def _store(self, level: int, cell: Cell, splats: Splats) -> Tile:
        """Write a tile."""
        new = self.merged / "tiles" / NEW
        write_ply(new, splats)
        file = f"tiles/{level}/{_cell_name(cell)}-{hash_of(new)[:12]}.ply"
        (self.merged / file).parent.mkdir(parents=True, exist_ok=True)
        os.replace(new, self.merged / file)
        low, high = (tuple(limit(axis=0).tolist()) for limit in (splats.positions.min, splats.positions.max))
        return Tile(level, cell, low, high, len(splats), file, reach(splats))


def tile_edge(positions: np.ndarray, weights: np.ndarray) -> float:
    """Choose the edge of the cubes of level 0.

    Args:
        positions: (N, 3) positions of some splats, scene units.
        weights: (N,) numbers of splats that each of them stands for.

    Returns:
        The largest power of two, scene units, at which the tile of the average splat has at most TILE_SPLATS splats.
    """
    edge = 2.0 ** np.ceil(np.log2(max(float(np.abs(positions).max()), 1e-6)))
    for _ in range(30):  # splats at one place cannot be divided
        cells = np.unique(np.floor(positions / edge), axis=0, return_inverse=True)[1]
        sizes = np.bincount(cells.ravel(), weights)
        if np.square(sizes).sum() <= TILE_SPLATS * sizes.sum():
            break
        edge /= 2
    return edge


def reach(splats: Splats) -> float:
    """Return the largest distance from its position at which one of some splats is visible, scene units."""
    deviations = np.sqrt(2 * np.log(np.maximum(splats.opacities.astype(np.float64) / VISIBLE, 1)))
    return float((splats.scales.max(axis=1) * deviations).max())


def by_cell(positions: np.ndarray, edge: float) -> tuple[np.ndarray, dict[Cell, slice]]:
    """Sort positions by the cubes that they are in.

    Args:
        positions: (N, 3), scene units.
        edge: Edge of the cubes, scene units.

    Returns:
        Indices (N,) of the positions cube by cube, in their order within a cube; and the part of these that is in each
        cube.
    """
    cells = np.floor(positions.astype(np.float64) / edge).astype(np.int64)
    order = np.lexsort(cells.T[::-1])
    found, starts = np.unique(cells[order], axis=0, return_index=True)
    ends = np.append(starts[1:], len(order))
    return order, {(x, y, z): slice(*place) for (x, y, z), *place in zip(found.tolist(), starts, ends, strict=True)}


def _rows(splats: Splats) -> np.ndarray:
    """Return splats as an array (N,) with one field for each property."""
    arrays = {name: getattr(splats, name) for name in ARRAYS} | {f"extra {n}": v for n, v in splats.extras.items()}
    rows = np.empty(len(splats), [(name, array.dtype, array.shape[1:]) for name, array in arrays.items()])
    for name, array in arrays.items():
        rows[name] = array
    return rows


def _splats(rows: np.ndarray, pattern: Splats) -> Splats:
    """Return the splats of `_rows`, with the placement, the development and the origin of `pattern`."""
    extras = {name: np.ascontiguousarray(rows[f"extra {name}"]) for name in pattern.extras}
    positions, rotations, scales, opacities, sh = (np.ascontiguousarray(rows[name]) for name in ARRAYS)
    bare = Splats(positions, rotations, scales, opacities, sh, extras)
    return replace(bare, placement=pattern.placement, development=pattern.development, origin=pattern.origin)


def _cell_name(cell: Cell) -> str:
    return "_".join(map(str, cell))


def _remove_unlisted(merged: Path) -> None:
    """Remove the files of tiles that tiles.json does not list, and folders that are then empty."""
    try:
        listed = {merged / tile.file for tile in Tiles.read(merged).tiles}
    except InputError:
        listed = set()
    for path in [*merged.glob("tiles/*/*.ply"), *merged.glob("tiles/*"), merged / "tiles"]:
        with suppress(OSError):
            if path == merged / "tiles" / NEW or TILE.fullmatch(path.name):
                if path not in listed:
                    path.unlink()
            else:
                path.rmdir()
