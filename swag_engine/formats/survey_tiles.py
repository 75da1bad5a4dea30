"""Tiles of a merged survey, in levels of detail: which files they have, and how they are found. Blender imports it.

Level 0 has all splats. Each further level has fewer, larger ones that were made of those of the level before. A level
is cut into cubes; the cubes of level n have edges of `edge` * 2^n. A tile is the 3DGS PLY of one cube. Each splat of a
level is in one tile, that of its position.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import DAMAGE, InputError
from .run_folder import read_json, write_json

VERSION = 1
"""Version of tiles.json."""

Corner = tuple[float, float, float]
Cell = tuple[int, int, int]


@dataclass(frozen=True)
class Tile:
    """Splats of one cube of one level.

    Attributes:
        level: Level of detail, 0 is the finest.
        cell: Numbers of the cube along x, y and z: it begins at cell * edge * 2^level.
        low: Least x, y and z of the positions of its splats, scene units.
        high: Largest x, y and z.
        splats: Number of splats.
        file: The PLY file, relative to tiles.json.
        reach: Largest distance from its position at which one of its splats is visible, scene units.
    """

    level: int
    cell: Cell
    low: Corner
    high: Corner
    splats: int
    file: str
    reach: float = 0.0


@dataclass(frozen=True)
class Level:
    """One level of detail.

    Attributes:
        level: Its number.
        splats: Number of splats.
        bytes: Size of its tiles together.
        psnr: PSNR of the test images against the photos, dB; None where it was not measured.
    """

    level: int
    splats: int
    bytes: int
    psnr: float | None = None


@dataclass(frozen=True)
class Tiles:
    """Levels and tiles of a merged survey: tiles.json.

    Attributes:
        folder: Folder of tiles.json.
        edge: Edge of the cubes of level 0, scene units.
        up: Up direction (3,) in the scene's coordinates.
        background: (3,) display color behind all splats; black where open water is modelled.
        levels: The levels, finest first.
        tiles: The tiles of all levels.
    """

    folder: Path
    edge: float
    up: Corner
    background: Corner
    levels: tuple[Level, ...]
    tiles: tuple[Tile, ...]

    def of_level(self, level: int) -> list[Tile]:
        """Return the tiles of a level.

        Raises:
            InputError: If there is no such level.
        """
        if level not in {each.level for each in self.levels}:
            raise InputError(f"{self.folder} has the levels 0 to {len(self.levels) - 1}, not {level}.")
        return [tile for tile in self.tiles if tile.level == level]

    def in_box(self, level: int, low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> list[Tile]:
        """Return the tiles of a level that have splats near a box: their own box meets it.

        Args:
            level: The level.
            low: (3,) least corner of the box, scene units.
            high: (3,) largest corner.

        Raises:
            InputError: If there is no such level.
        """
        return [
            tile
            for tile in self.of_level(level)
            if np.all(np.array(tile.low) <= high) and np.all(np.array(tile.high) >= low)
        ]

    def path(self, tile: Tile) -> Path:
        """Return the file of a tile."""
        return self.folder / tile.file

    def write(self) -> None:
        """Write tiles.json.

        Raises:
            InputError: If it cannot be written.
        """
        document: dict[str, Any] = {"version": VERSION} | asdict(self)
        del document["folder"]
        write_json(self.folder / "tiles.json", document)

    @classmethod
    def read(cls, folder: Path) -> "Tiles":
        """Read tiles.json of a folder.

        Raises:
            InputError: If the survey is not merged yet, or the file is damaged or of another version.
        """
        file = folder / "tiles.json"
        document = read_json(file, f"{folder} has no tiles.json: merge the survey first (survey merge).")
        if document.get("version") != VERSION:
            raise InputError(f"{file} has version {document.get('version')!r}, not {VERSION}: merge the survey again.")
        try:
            return cls(
                folder,
                float(document["edge"]),
                _corner(document["up"]),
                _corner(document["background"]),
                tuple(Level(**_known(Level, level)) for level in document["levels"]),
                tuple(_tile(tile) for tile in document["tiles"]),
            )
        except DAMAGE as error:
            raise InputError(f"{file} is damaged: {error!r}; merge the survey again.") from error


def _tile(values: Mapping[str, Any]) -> Tile:
    x, y, z = (int(number) for number in values["cell"])
    file = str(values["file"])
    if Path(file).is_absolute() or ".." in Path(file).parts:
        raise ValueError(f"a tile lies outside of its folder: {file}")
    return Tile(
        int(values["level"]),
        (x, y, z),
        _corner(values["low"]),
        _corner(values["high"]),
        int(values["splats"]),
        file,
        float(values["reach"]),
    )


def _known(kind: type, values: Mapping[str, Any]) -> dict[str, Any]:
    return {entry.name: values[entry.name] for entry in fields(kind)}


def _corner(values: Any) -> Corner:
    x, y, z = (float(value) for value in values)
    return x, y, z
