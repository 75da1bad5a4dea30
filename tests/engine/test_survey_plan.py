"""Planning of surveys: files, sizes, splits, notes and errors."""

import json
import os
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.formats import survey_folder
from swag_engine.formats.survey_folder import SurveyFolder
from swag_engine.kernels.machine import engine_version
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.split import split_views
from swag_engine.settings.presets import PRESETS
from swag_engine.settings.settings import TrainSettings
from swag_engine.survey.plan import FEWEST_TRAINING, describe, plan_survey
from swag_engine.training.pacing.memory import USABLE_FRACTION
from tests.scenes.lawn_mower import write_lawn_mower

BLOCK_IMAGES = 80


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return write_lawn_mower(tmp_path_factory.mktemp("surveys") / "reef", columns=20, rows=10, points=12_000)


@pytest.fixture(scope="module")
def planned(scene):
    """A planned survey beside its scene: its folder, and what the plan says."""
    out = scene.parent / "reef survey"
    return SurveyFolder(out), plan_survey(scene, out, TrainSettings(seed=5), BLOCK_IMAGES)


def test_the_plan_is_in_the_files_and_in_the_document(planned, scene):
    folder, document = planned
    survey = folder.read()
    blocks = [folder.read_block(name) for name in survey.blocks]
    assert len(blocks) >= 4 and survey.images == 200 and survey.engine == engine_version()
    assert json.loads(json.dumps(document, allow_nan=False)) == document | {
        "ground": {"origin": list(survey.ground.origin), "axes": [list(row) for row in survey.ground.axes]},
        "bounds": list(survey.bounds),
    }
    assert [block["name"] for block in document["blocks"]] == list(survey.blocks)
    assert document["totals"]["extra_images"] == sum(len(block.images) for block in blocks) / 200 - 1
    assert {name for block in blocks for name in block.images} == {view.name for view in load_scene(scene).views}
    assert survey.median_range == pytest.approx(2.2, abs=0.1)  # the camera is 2 above the floor
    text = describe(document)
    assert all(block.name in text for block in blocks) and "200, of which 25 are held out" in text


def test_the_version_of_the_engine_is_that_of_the_package():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    assert engine_version() == project["project"]["version"]


def test_held_out_images_are_held_out_in_every_run(planned, scene):
    folder, _ = planned
    survey = folder.read()
    split = split_views(view.name for view in load_scene(scene).views)
    assert survey.test == split.test
    for block in map(folder.read_block, survey.blocks):
        assert set(block.training) <= set(split.train) and len(block.training) >= FEWEST_TRAINING
        assert set(block.validation) <= set(split.validation) and set(block.test) <= set(split.test)
    assert set(survey.coarse_training) <= set(split.train)
    assert set(survey.coarse_validation) <= set(split.validation)


def test_sizes_of_a_preset(planned):
    folder, _ = planned
    survey = folder.read()
    blocks = [folder.read_block(name) for name in survey.blocks]
    assert survey.settings.iterations == PRESETS["standard"].iterations and survey.settings.width > 0
    visits = [block.iterations / len(block.training) for block in blocks]
    assert max(visits) < 1.02 * min(visits)
    assert sum(block.iterations for block in blocks) == pytest.approx(3000 * len(blocks), abs=len(blocks))
    assert len({block.seed for block in blocks}) == len(blocks) and survey.settings.seed == 5
    assert all(block.memory > block.max_gaussians * 1280 for block in blocks)
    assert survey.coarse_settings.width <= 320 and 0 < survey.coarse_settings.iterations <= 3000


def test_numbers_that_the_user_gives_are_those_of_the_whole(scene, tmp_path):
    settings = TrainSettings(iterations=500, max_gaussians=300_000, width=100)
    document = plan_survey(scene, tmp_path / "out", settings, BLOCK_IMAGES)
    survey = SurveyFolder(tmp_path / "out").read()
    blocks = [SurveyFolder(tmp_path / "out").read_block(name) for name in survey.blocks]
    assert (survey.settings.width, survey.settings.max_gaussians) == (100, 300_000)
    points = len(load_scene(scene).points.positions)
    for block in blocks:
        assert block.max_gaussians == round(300_000 * block.points / points)
    assert sum(block.iterations for block in blocks) == pytest.approx(500 * len(blocks), abs=len(blocks))
    assert document["coarse"]["max_gaussians"] <= min(200_000, max(block.max_gaussians for block in blocks))
    assert survey.coarse_settings.width == 100


def test_memory_cuts_further_and_is_a_sentence_where_that_cannot_help(scene, tmp_path):
    settings = TrainSettings(iterations=500, max_gaussians=600_000, width=100)
    whole = plan_survey(scene, tmp_path / "whole", settings, 200)
    assert whole["totals"]["blocks"] == 1
    memory = int(0.9 * whole["totals"]["largest_memory"] / USABLE_FRACTION)
    parts = plan_survey(scene, tmp_path / "parts", settings, 200, memory=memory)
    assert parts["totals"]["blocks"] > 1 and parts["totals"]["largest_memory"] <= USABLE_FRACTION * memory
    assert any("not trained as seams" in note for note in parts["notes"])  # it needs the Gaussians of both blocks
    with pytest.raises(InputError, match=r"needs .* GB of memory.*smaller width"):
        plan_survey(scene, tmp_path / "none", settings, 200, memory=10_000_000)
    assert not (tmp_path / "none").exists()


def test_scene_and_survey_can_be_moved_together(planned, scene, tmp_path):
    folder, _ = planned
    assert json.loads(folder.survey.read_text())["scene"] == "../reef"
    shutil.copytree(scene.parent, tmp_path / "moved")
    moved = SurveyFolder(tmp_path / "moved" / "reef survey").read()
    assert moved.scene == tmp_path / "moved" / "reef"
    plan_survey(scene, tmp_path / "elsewhere" / "survey", TrainSettings(iterations=50), BLOCK_IMAGES)
    document = json.loads((tmp_path / "elsewhere" / "survey" / "survey.json").read_text())
    assert document["scene"] == str(scene) == str(SurveyFolder(tmp_path / "elsewhere" / "survey").read().scene)


def test_the_same_survey_is_planned_the_same(planned, scene, tmp_path):
    folder, _ = planned
    plan_survey(scene, tmp_path / "again", TrainSettings(seed=5), BLOCK_IMAGES)
    for name in folder.read().blocks:
        again = SurveyFolder(tmp_path / "again").block_file(name)
        assert again.read_bytes() == folder.block_file(name).read_bytes()


def test_a_small_scene_is_one_block(tmp_path):
    scene = write_lawn_mower(tmp_path / "reef", 5, 2, 2000)
    document = plan_survey(scene, tmp_path / "out", TrainSettings(iterations=40, width=64), 300)
    survey = SurveyFolder(tmp_path / "out").read()
    block = SurveyFolder(tmp_path / "out").read_block(survey.blocks[0])
    assert len(survey.blocks) == 1 and len(block.images) == 10 and block.core == (-np.inf, -np.inf, np.inf, np.inf)
    notes = "\n".join(document["notes"])
    assert "few enough for one block" in notes
    assert notes in describe(document).replace("Note: ", "")


def fails(scene: Path, out: Path, *words: str, block_images: int = BLOCK_IMAGES, **settings: Any) -> None:
    before = sorted(out.rglob("*")) if out.exists() else None
    with pytest.raises(InputError) as caught:
        plan_survey(scene, out, TrainSettings(**settings), block_images)
    message = str(caught.value)
    assert all(word in message for word in words) and "\n" not in message and message.endswith(".")
    assert (sorted(out.rglob("*")) if out.exists() else None) == before


def test_a_survey_of_two_places(tmp_path):
    scene = write_lawn_mower(tmp_path / "two", 6, 4, 2000, places=((0.0, 0.0), (40.0, 5.0)))
    fails(scene, tmp_path / "out", str(scene), "2 places", "24 photos from 00001.jpg to 00024.jpg", "each by itself")


def test_few_images_without_connection_are_noted(tmp_path):
    """An image of its own place, and one without points."""
    scene = write_lawn_mower(tmp_path / "reef", 8, 4, 3000)
    loaded = load_scene(scene)
    lonely = replace(loaded.views[3], point_indices=loaded.views[3].point_indices[:0])
    from swag_engine.survey import plan

    blind = replace(loaded, views=(*loaded.views[:3], lonely, *loaded.views[4:]))
    *_, document = plan._planned(blind, TrainSettings(iterations=40), 300, None, lambda stage, fraction: None)
    assert any("1 photos are in no block" in note and "00004.jpg" in note for note in document["notes"])
    seen = [view.point_indices for view in loaded.views]
    own = [seen[0][:1], *(np.setdiff1d(rows, seen[0][:1]) for rows in seen[1:])]
    notes: list[str] = []
    plan._check_one_place(loaded, [view.name for view in loaded.views], own, notes)
    assert notes == ["1 photos share no sparse points with the others: 00001.jpg."]


def test_bad_settings_and_folders(scene, planned, tmp_path):
    folder, _ = planned
    fails(scene, folder.path, "planned already", "new folder")
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "notes.txt").write_text("mine")
    fails(scene, tmp_path / "used", "is not empty")
    fails(scene, tmp_path / "out", "no time budget", "iterations", time_budget="10m")
    fails(scene, tmp_path / "out", "at least 6", block_images=5)
    fails(tmp_path / "nothing", tmp_path / "out", "no folder")
    (tmp_path / "empty").mkdir()
    plan_survey(scene, tmp_path / "empty", TrainSettings(iterations=40), BLOCK_IMAGES)
    assert sorted(path.name for path in (tmp_path / "empty").iterdir()) == ["blocks", "coarse", "seams", "survey.json"]


def test_a_survey_with_too_few_photos(tiny_scene, tmp_path):
    """And with a model that does not say which points a photo shows, which `survey run` could not train."""
    scene = write_lawn_mower(tmp_path / "three", 3, 1, 500)
    fails(scene, tmp_path / "out", f"fewer than {FEWEST_TRAINING} training photos")
    fails(tiny_scene, tmp_path / "out", "does not say which points a photo shows")


def test_a_full_disk_leaves_nothing(scene, tmp_path, monkeypatch):
    def full(source: Path, target: Path) -> None:
        if str(target).endswith("survey.json"):
            raise OSError(28, "No space left on device")
        rename(source, target)

    rename = os.replace
    monkeypatch.setattr(os, "replace", full)
    fails(scene, tmp_path / "out", "survey.json", "free some space")


def test_a_plan_of_another_version_is_refused(planned, tmp_path, monkeypatch):
    folder, _ = planned
    monkeypatch.setattr(survey_folder, "VERSION", 2)
    with pytest.raises(InputError, match=r"version 1, and this program reads version 2.*plan it again"):
        folder.read()
