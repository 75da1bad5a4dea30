"""Export of a merged survey, or of a part of it, to files that other programs read."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ..base.computer_memory import free_memory
from ..base.errors import InputError
from ..base.files import not_writable
from ..formats.ply import read_ply, write_ply_parts
from ..formats.registry import FORMATS
from ..formats.survey_folder import Ground, SurveyFolder, inside
from ..formats.survey_tiles import Tile, Tiles
from ..products.tiles import Progress
from ..scene.georeference import read_georeference
from ..splats.develop_splats import bake_development, name_development
from ..splats.development import NO_DEVELOPMENT
from ..splats.splats import Splats, concatenate
from ..splats.transform import transformed

STREAMED_SOG = "sog"
"""Name of the format that PlayCanvas' splat-transform writes: all levels, cut into pieces for the web."""
SPLAT_TRANSFORM = "@playcanvas/splat-transform@3.7.0"
"""The npm package that writes it, in the version that the tests use (tests/interop/package.json)."""
META = "lod-meta.json"
"""File of a streamed SOG that lists the others."""
COPIES = 4
"""Memory that a file of one piece needs, in sizes of its splats as PLY: tiles, joined, changed, and as attributes."""
GLB_LIMIT = 2**32
"""Bytes that a GLB can hold."""

Change = Callable[[Splats], Splats]


def export_survey(
    folder: Path,
    format: str,
    out: Path,
    level: int = 0,
    box: Sequence[float] | None = None,
    progress: Progress | None = None,
    develop: str = "auto",
) -> dict[str, Any]:
    """Write a level of a merged survey, or the part of it in a box, to a file, which is whole or absent.

    As `export_run` does: colors are developed, and a scene whose scale is known is in metres. A PLY has the axes of the
    scene and is written tile by tile; other formats but a streamed SOG need the level in memory.

    Args:
        folder: Folder of the survey.
        format: Name of a format in formats/registry.py, or `sog`: a folder with a streamed SOG of this level and all
            coarser ones, which needs the program splat-transform.
        out: File to write; for `sog` the folder.
        level: Level of detail, 0 is the finest.
        box: Only splats in a box on the ground of the survey: left, bottom, right and top edge in scene units, and
            after these, if given, the lowest and the highest height. Upper edges are outside.
        progress: Called with the stage of the work and its fraction; what it raises ends the work.
        develop: Development of the colors, as `RunFolder.color_view` of the coarse run.

    Returns:
        `out`; `level`; `splats`, their number (of the level that was asked for); `bytes`, the size of what was written;
        `files`, a list of it; `notes`, sentences for the user.

    Raises:
        InputError: If the survey is not merged, has no such level or no splats in the box, the format is unknown or its
            program is missing, the level does not fit into memory or the format, or `out` cannot be written.
    """
    if format not in (*FORMATS, STREAMED_SOG):
        raise InputError(f"There is no format {format}; choose one of {', '.join((*FORMATS, STREAMED_SOG))}.")
    survey_folder = SurveyFolder(folder)
    survey = survey_folder.read()
    tiles = Tiles.read(survey_folder.merged)
    report = progress or (lambda stage, fraction: None)
    development = survey_folder.coarse.color_view(develop).at(0)
    named = survey_folder.coarse.color_view("auto").at(0) if develop == "none" else NO_DEVELOPMENT
    measured = read_georeference(survey.scene)
    metres = (measured.metres_per_unit if measured else survey.settings.metres_per_unit) or 1.0

    def change(splats: Splats) -> Splats:
        splats = bake_development(name_development(splats, named), development)
        return splats if metres == 1 else transformed(splats, np.diag([metres] * 3 + [1.0]))

    def change_without_sh(splats: Splats) -> Splats:
        return change(replace(splats, sh=splats.sh[:, :1]))

    region = _Region(survey.ground, _checked(box)) if box is not None else None
    program = _splat_transform(out) if format == STREAMED_SOG else []
    on_processor = "cpu" in program
    used = change_without_sh if on_processor else change
    parts = partial(_Parts, tiles, region=region, change=used, progress=report)
    chosen = parts(level)
    if format == "ply":
        write_ply_parts(out, chosen, chosen.count)
    elif format == STREAMED_SOG:
        _write_streamed_sog(out, program, [parts(each.level) for each in tiles.levels if each.level >= level])
    else:
        _require_room(format, tiles, chosen)
        splats = concatenate(list(chosen))
        FORMATS[format].write(out, splats, tiles.up, ())
    files = sorted(path for path in out.rglob("*") if path.is_file()) if out.is_dir() else [out]
    kept = FORMATS["ply" if format == STREAMED_SOG else format]
    notes = kept.notes(chosen.pattern)
    if on_processor:
        notes.append("splat-transform found no graphics card: colors do not change with the view in this file.")
    if development != NO_DEVELOPMENT:
        notes.append("Colors are developed; --develop none leaves them restored.")
    return {
        "out": str(out),
        "level": level,
        "splats": chosen.count,
        "bytes": sum(path.stat().st_size for path in files),
        "files": [str(path) for path in files],
        "notes": notes,
    }


def describe(result: dict[str, Any]) -> str:
    """Return the lines that the command `survey export` prints.

    Args:
        result: What `export_survey` returned.
    """
    size = f"level {result['level']}, {result['splats']:,} splats, {result['bytes'] / 1e6:.1f} MB"
    return "\n".join([f"{result['out']}: {size}", *result["notes"]])


class _Region:
    """A half-open box on the ground.

    Attributes:
        low: (3,) least x, y and height, scene units.
        high: (3,) their upper limits.
    """

    def __init__(self, ground: Ground, edges: tuple[float, ...]) -> None:
        self.ground, self.edges = ground, edges
        self.low, self.high = np.array([*edges[:2], edges[4]]), np.array([*edges[2:4], edges[5]])

    def holds(self, positions: np.ndarray) -> np.ndarray:
        """Return which positions (N, 3) are inside, (N,) bool."""
        places = self.ground.on_ground(positions)
        left, bottom, right, top, lowest, highest = self.edges
        return inside((left, bottom, right, top), places) & (lowest <= places[:, 2]) & (places[:, 2] < highest)

    def meets(self, tile: Tile) -> bool:
        """Return whether a tile may have splats inside."""
        corners = self.ground.on_ground(np.array(list(product(*zip(tile.low, tile.high, strict=True)))))
        return bool((corners.min(axis=0) < self.high).all() and (corners.max(axis=0) >= self.low).all())


class _Parts:
    """The splats of a level in a region, tile by tile, as they are exported.

    Attributes:
        level: The level.
        count: Number of its splats in the region.
        pattern: Its first splat, for the properties that all have.

    Raises:
        InputError: If there are none.
    """

    def __init__(self, tiles: Tiles, level: int, region: _Region | None, change: Change, progress: Progress) -> None:
        self.tiles, self.level, self.region, self.change, self.progress = tiles, level, region, change, progress
        self.needed = [tile for tile in tiles.of_level(level) if region is None or region.meets(tile)]
        if region is None:
            self.count = sum(tile.splats for tile in self.needed)
        else:
            counts = [len(self._read(tile)) for tile in self._reported("Counting the splats in the box")]
            self.needed = [tile for tile, count in zip(self.needed, counts, strict=True) if count]
            self.count = sum(counts)
        if not self.count:
            raise InputError(
                f"No splat of level {level} is in the box: give left, bottom, right and top in units of the scene on "
                "the survey's ground (the bounds in survey.json)."
            )
        self.pattern = change(self._read(self.needed[0]).subset(np.arange(1)))

    def __iter__(self) -> Iterator[Splats]:
        for tile in self._reported(f"Writing level {self.level}"):
            yield self.change(self._read(tile))

    def _reported(self, stage: str) -> Iterator[Tile]:
        for number, tile in enumerate(self.needed):
            self.progress(stage, number / len(self.needed))
            yield tile

    def _read(self, tile: Tile) -> Splats:
        splats = read_ply(self.tiles.path(tile))
        return splats if self.region is None else splats.subset(self.region.holds(splats.positions))


def _checked(box: Sequence[float]) -> tuple[float, ...]:
    """Return left, bottom, right, top, lowest and highest; raises InputError for a box that holds nothing."""
    edges = tuple(float(edge) for edge in box)
    edges = (*edges, -np.inf, np.inf) if len(edges) == 4 else edges
    if len(edges) != 6 or not (edges[0] < edges[2] and edges[1] < edges[3] and edges[4] < edges[5]):
        raise InputError(
            "The box must be left, bottom, right and top on the ground, then, if given, lowest and highest; left below "
            "right, bottom below top, lowest below highest."
        )
    return edges


def _require_room(format: str, tiles: Tiles, parts: _Parts) -> None:
    """Raise InputError where a file of one piece does not fit into memory or into the format."""
    pattern = concatenate([parts.pattern] * 100)
    size = FORMATS[format].size(Path("size"), pattern, tiles.up, ()) / 100 * parts.count
    memory = COPIES * FORMATS["ply"].size(Path("size"), pattern, tiles.up, ()) / 100 * parts.count
    free = free_memory()
    instead = "choose a coarser level, a box or the format ply, which needs the memory of one tile"
    if free is not None and memory > free:
        raise InputError(
            f"Level {parts.level} has {parts.count} splats; as {format} they need {memory / 1e9:.1f} GB of memory, and "
            f"{free / 1e9:.1f} GB are free: {instead}."
        )
    if format == "glb" and size > GLB_LIMIT:
        raise InputError(
            f"Level {parts.level} has {parts.count} splats; they would be {size / 1e9:.1f} GB, and a GLB can hold 4.3 "
            f"GB: {instead}."
        )


def _splat_transform(out: Path) -> list[str]:
    """Return the command of splat-transform without its files.

    It runs on the processor, `--gpu cpu`, where it finds no graphics card. Colors that change with the view are too
    slow then, because they become a palette of up to 65 536 entries: the 53 000 splats of the demo scene's levels
    were not done after 5 minutes of one core, those of constant colors take 3 seconds.

    Raises:
        InputError: If there is no such program, or `out` holds other files.
    """
    program = shutil.which("splat-transform")
    if program is None:
        raise InputError(
            "A streamed SOG is written by PlayCanvas' program splat-transform, which was not found: install Node, then "
            f"run `npm install --global {SPLAT_TRANSFORM}`."
        )
    held = [path for path in out.rglob("*") if not path.is_dir()] if out.is_dir() else []
    others = [path for path in held if path.suffix != ".webp" and not path.name.endswith("meta.json")]
    if out.is_file() or others or (held and not (out / META).is_file()):
        raise InputError(f"{out} exists and is not a streamed SOG: choose a new folder.")
    try:
        listed = subprocess.run([program, "--list-gpus"], capture_output=True, text=True, timeout=60, check=True)
        has_card = "No GPU" not in listed.stdout + listed.stderr
    except (OSError, subprocess.SubprocessError):
        has_card = False
    return [program, "--quiet", *([] if has_card else ["--gpu", "cpu"])]


def _write_streamed_sog(out: Path, program: Sequence[str], levels: Sequence[_Parts]) -> None:
    """Write a streamed SOG with splat-transform, from PLY files of the levels in a temporary folder beside it."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as scratch:
            arguments: list[str] = []
            for number, parts in enumerate(levels):
                ply = Path(scratch, f"{number}.ply")
                write_ply_parts(ply, parts, parts.count)
                arguments += [str(ply), "--tag-lod", str(number)]
            new = Path(scratch, "new")
            new.mkdir()
            said = _run([*program, *arguments, str(new / META)], levels[0].progress)
            if not (new / META).is_file():
                raise InputError(f"splat-transform failed: {said or 'it said nothing'}.")
            if out.exists():
                out.rename(Path(scratch, "old"))
            os.replace(new, out)
    except OSError as error:
        raise not_writable(out, error) from error


def _run(command: Sequence[str], progress: Progress) -> str:
    """Run a program, which ends when `progress` raises; return the last line that it wrote."""
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        try:
            while process.poll() is None:
                progress("Packing with splat-transform", 0.0)
                with suppress(subprocess.TimeoutExpired):
                    process.wait(0.5)
        finally:
            process.kill()
            process.wait()
        output.seek(0)
        return output.read().decode(errors="replace").strip().rpartition("\n")[2]
