"""Surveys made by hand, with splats in place of trained blocks."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from swag_engine.formats.ply import write_ply
from swag_engine.formats.run_folder import write_json
from swag_engine.formats.survey_folder import VERSION, Block, Box, Ground, Survey, SurveyFolder
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.splats import Splats

GROUND = Ground((0.25, -0.125, 0.5), ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
"""A plane whose axes are not those of the scene: x is the scene's z, y its x, up its y. float32 holds its origin."""


def random_splats(count: int, seed: int = 0, size: float = 10.0, degree: int = 1) -> Splats:
    """Make small splats on a rough square of that edge around the origin of GROUND, with labels and a confidence."""
    random = np.random.default_rng(seed)
    rotations = random.normal(size=(count, 4))
    on_ground = np.column_stack([random.uniform(-size / 2, size / 2, (count, 2)), random.normal(0, 0.1, count)])
    positions = on_ground @ np.array(GROUND.axes) + GROUND.origin
    return Splats(
        positions.astype(np.float32),
        (rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        np.exp(random.normal(-4, 0.4, (count, 3))).astype(np.float32),
        random.uniform(0.1, 0.95, count).astype(np.float32),
        random.normal(0, 0.5, (count, (degree + 1) ** 2, 3)).astype(np.float32),
        {
            "confidence": random.random(count).astype(np.float32),
            "label": (positions[:, 0] > 0).astype(np.int32) + 3,
        },
    )


def make_survey(folder: Path, splats: Splats, columns: int = 2, rows: int = 2, size: float = 10.0) -> SurveyFolder:
    """Write a survey of columns x rows blocks that are done; each has all splats of its extended box."""
    survey = SurveyFolder(folder)
    x_edges, y_edges = (np.linspace(-size / 2, size / 2, count + 1) for count in (columns, rows))
    names: list[str] = []
    on_ground = GROUND.on_ground(splats.positions)
    for row in range(rows):
        for column in range(columns):
            names.append(f"B-{len(names) + 1:03d}")
            edges = x_edges[column], y_edges[row], x_edges[column + 1], y_edges[row + 1]
            outer = column == 0, row == 0, column == columns - 1, row == rows - 1
            left, bottom, right, top = (
                float(np.inf * sign if open else edge)
                for edge, open, sign in zip(edges, outer, (-1, -1, 1, 1), strict=True)
            )
            core: Box = (left, bottom, right, top)
            extended: Box = (core[0] - 1, core[1] - 1, core[2] + 1, core[3] + 1)
            block = Block(names[-1], core, extended, ("a.png",), (), (), 0, 10, len(splats), 100, 10**9)
            survey.write_block(block)
            x, y = on_ground[:, 0], on_ground[:, 1]
            near = (x >= extended[0]) & (x < extended[2]) & (y >= extended[1]) & (y < extended[3])
            finish_block(survey, names[-1], splats.subset(near))
    settings = TrainSettings()
    bounds: Box = (-size / 2, -size / 2, size / 2, size / 2)
    survey.write(
        Survey(folder / "scene", "test", settings, settings, ("a.png",), (), (), GROUND, bounds, 1, tuple(names))
    )
    return survey


def add_seam(survey: SurveyFolder, name: str, sides: tuple[str, ...], core: Box, splats: Splats) -> None:
    """Add a seam that is done to a survey."""
    survey.write_block(Block(name, core, core, ("a.png",), (), (), 0, 10, len(splats), 100, 10**9, sides))
    whole = survey.read()
    survey.write(replace(whole, seams=(*whole.seams, name)))
    finish_block(survey, name, splats)


def finish_block(survey: SurveyFolder, name: str, splats: Splats) -> None:
    """Write the result of a block, and done.json."""
    result = survey.run(name).ply
    write_ply(result, splats)
    digest = hashlib.sha256(result.read_bytes()).hexdigest()
    write_json(survey.done(name), {"version": VERSION, "block": name, "result_sha256": digest})
