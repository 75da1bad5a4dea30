"""A survey of four blocks, written by hand: its folder has all that Blender reads, and no run ran.

The splats lie on a square of 8 units, in cubes of 2 units at level 0: 16 tiles of 64 splats, then 4 of 64, then 1.
"""

import json
from pathlib import Path

import numpy as np

from swag_engine.formats.ply import write_ply
from swag_engine.formats.run_folder import write_json
from swag_engine.formats.survey_folder import Block, Ground, Survey, SurveyFolder
from swag_engine.formats.survey_tiles import Level, Tile, Tiles
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.development import Development
from swag_engine.splats.splats import Splats

UP = (0.0, -1.0, 0.0)
AXES = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), UP)
"""Rows: x, y and up of the ground."""
ORIGIN = (4.0, 0.0, 4.0)
HEIGHT = 0.1
"""Of the splats above the ground."""
EDGE = 2.0
PER_TILE = 64
WATER = {
    "beta_D": [0.1, 0.05, 0.03],
    "beta_B": [0.1, 0.1, 0.1],
    "background_sh": [[0.0] * 3] * 9,
    "light": "linear",
    "per": "unit",
}
DEVELOPMENT = Development(exposure=0.5).to_json()
BLOCKS = ("B-001", "B-002", "B-003", "B-004")


def make_survey(folder: Path, scene: Path, merged: bool = True) -> SurveyFolder:
    """Write a survey whose blocks are waiting, or whose blocks are done and merged; return its folder."""
    survey = SurveyFolder(folder)
    settings = TrainSettings(iterations=900, width=480, max_gaussians=4000)
    survey.write(
        Survey(
            scene, "0.1.0", settings, TrainSettings(iterations=100, width=240), ("a.jpg",), ("b.jpg",), ("c.jpg",),
            Ground(ORIGIN, AXES), (-4.0, -4.0, 4.0, 4.0), 12, BLOCKS,
        )
    )  # fmt: skip
    ends = ((-np.inf, 0.0), (0.0, np.inf))
    for index, name in enumerate(BLOCKS):
        (left, right), (bottom, top) = ends[index % 2], ends[index // 2]
        core = (left, bottom, right, top)
        images = tuple(f"{name}-{number}.jpg" for number in range(3))
        survey.write_block(Block(name, core, core, images, (), (), index, 900, 1000, 50, 10**8))
    if merged:
        survey.coarse.write_config(scene, settings, list(UP))
        for name in ("coarse", *BLOCKS):
            finish(survey, name, 20.0 + len(name))
        survey.coarse.water.write_text(json.dumps(WATER))
        survey.coarse.write_development(DEVELOPMENT)
        write_tiles(survey)
    return survey


def finish(survey: SurveyFolder, name: str, psnr: float) -> None:
    """Write the done.json of a job."""
    document = {"version": 1, "block": name, "iterations": 900, "gaussians": 1200, "gaussians_in_core": 1000}
    write_json(survey.done(name), document | {"test_psnr": psnr, "seconds": 61.0})


def write_tiles(survey: SurveyFolder) -> Tiles:
    """Write three levels of tiles, of 1024, 256 and 64 splats; labels are 1 in the west and 2 in the east."""
    tiles = []
    for level in range(3):
        count = 4 >> level
        for x in range(count):
            for y in range(count):
                tiles.append(_write_tile(survey, level, x, y))
    levels = tuple(Level(n, PER_TILE * (4 >> n) ** 2, 10_000, 24.0 - n) for n in range(3))
    made = Tiles(survey.merged, EDGE, UP, (0.1, 0.2, 0.3), levels, tuple(tiles))
    made.write()
    write_json(survey.merged / "labels.json", {"labels": [{"id": 1, "name": "sand"}, {"id": 2, "name": "coral"}]})
    return made


def _write_tile(survey: SurveyFolder, level: int, x: int, y: int) -> Tile:
    edge = EDGE * 2**level
    side = int(PER_TILE**0.5)
    grid = (np.arange(side) + 0.5) / side
    positions = np.zeros((PER_TILE, 3), np.float32)
    positions[:, 0] = edge * (x + np.repeat(grid, side))
    positions[:, 1] = -HEIGHT
    positions[:, 2] = edge * (y + np.tile(grid, side))
    splats = Splats(
        positions,
        np.tile(np.array([1, 0, 0, 0], np.float32), (PER_TILE, 1)),
        np.full((PER_TILE, 3), 0.3 * edge / side, np.float32),
        np.full(PER_TILE, 0.9, np.float32),
        np.full((PER_TILE, 4 if level == 0 else 1, 3), 0.2 * level, np.float32),
        {"label": (1 + (positions[:, 0] > 4)).astype(np.int32)},
    )
    file = f"tiles/{level}/{x}-{y}-0.ply"
    write_ply(survey.merged / file, splats)
    return Tile(level, (x, -1, y), _corner(positions.min(axis=0)), _corner(positions.max(axis=0)), PER_TILE, file)


def _corner(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
