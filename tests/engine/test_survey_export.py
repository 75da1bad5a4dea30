"""Levels and boxes of a survey as files, the same as when they are written from memory."""

import json
import shutil
import tracemalloc

import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.formats import ply
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.run_folder import write_json
from swag_engine.formats.survey_tiles import Tiles
from swag_engine.splats.develop_splats import bake_development
from swag_engine.splats.development import Development
from swag_engine.splats.splats import concatenate
from swag_engine.survey import export, merge
from swag_engine.survey.export import export_survey
from swag_engine.survey.merge import merge_survey
from tests.interop.install import HERE
from tests.scenes.small_surveys import GROUND, make_survey, random_splats


@pytest.fixture(scope="module")
def merged(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(merge, "TILE_SPLATS", 400)
        patch.setattr(merge, "COARSEST", 200)
        patch.setattr(merge.os, "fsync", lambda _: None)
        survey = make_survey(tmp_path_factory.mktemp("survey"), random_splats(6000))
        merge_survey(survey.path)
        return survey


def level_of(survey, level):
    tiles = Tiles.read(survey.merged)
    return concatenate([read_ply(tiles.path(tile)) for tile in tiles.of_level(level)])


@pytest.mark.parametrize("level", [0, 1])
def test_a_streamed_ply_is_that_of_the_memory_to_the_byte(merged, tmp_path, level):
    stages = []
    result = export_survey(merged.path, "ply", tmp_path / "a.ply", level, progress=lambda *stage: stages.append(stage))
    splats = level_of(merged, level)
    write_ply(tmp_path / "b.ply", splats)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert result["splats"] == len(splats) and result["bytes"] == (tmp_path / "b.ply").stat().st_size
    assert len(stages) == len(Tiles.read(merged.merged).of_level(level))


@pytest.mark.parametrize("box", [(-2, -1, 3, 1.5), (-2, -1, 3, 1.5, -0.05, 0.1), (-np.inf, -1, 0, np.inf)])
def test_a_box_on_the_ground(merged, tmp_path, box):
    result = export_survey(merged.path, "ply", tmp_path / "a.ply", box=box)
    splats = level_of(merged, 0)
    x, y, height = GROUND.on_ground(splats.positions).T
    low, high = (box[4], box[5]) if len(box) == 6 else (-np.inf, np.inf)
    inside = (x >= box[0]) & (x < box[2]) & (y >= box[1]) & (y < box[3]) & (height >= low) & (height < high)
    write_ply(tmp_path / "b.ply", splats.subset(inside))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert 0 < result["splats"] == inside.sum() < len(splats)


def test_a_glb_of_a_level(merged, tmp_path):
    export_survey(merged.path, "glb", tmp_path / "a.glb", 1)
    splats, found = level_of(merged, 1), read_glb(tmp_path / "a.glb", GROUND.axes[2])
    np.testing.assert_allclose(found.positions, splats.positions, atol=1e-6)
    np.testing.assert_array_equal(found.extras["label"], splats.extras["label"])


def test_colors_are_developed_and_measured_scenes_are_in_metres(merged, tmp_path):
    survey = merged.path
    brighter = Development(exposure=0.5)
    try:
        merged.coarse.write_development(brighter.to_json())
        result = export_survey(survey, "ply", tmp_path / "a.ply")
        plain = export_survey(survey, "ply", tmp_path / "b.ply", develop="none")
    finally:
        shutil.rmtree(merged.coarse.path)
    expected = bake_development(level_of(merged, 0), brighter)
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply").sh, expected.sh, atol=1e-5)
    assert "developed" in result["notes"][0] and plain["notes"] == []
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply").sh, level_of(merged, 0).sh)
    document = json.loads(merged.survey.read_text())
    try:
        write_json(merged.survey, document | {"settings": document["settings"] | {"metres_per_unit": 0.5}})
        export_survey(survey, "ply", tmp_path / "c.ply")
    finally:
        write_json(merged.survey, document)
    halved = read_ply(tmp_path / "c.ply")
    np.testing.assert_allclose(halved.positions, level_of(merged, 0).positions / 2, atol=1e-6)
    np.testing.assert_allclose(halved.scales, level_of(merged, 0).scales / 2, rtol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"level": 9}, "levels 0 to"),
        ({"format": "obj"}, "no format obj"),
        ({"box": (1, 1, 0, 2)}, "left below right"),
        ({"box": (90, 90, 91, 91)}, "No splat of level 0"),
    ],
)
def test_what_cannot_be_exported_is_said_and_nothing_is_written(merged, tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        export_survey(merged.path, **{"format": "ply", "out": tmp_path / "a.ply"} | changes)
    assert not list(tmp_path.iterdir())


def test_a_level_that_does_not_fit_is_refused_before_it_is_read(merged, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "free_memory", lambda: 10**5)
    with pytest.raises(InputError, match=r"Level 0 has 6000 splats; as glb .* memory"):
        export_survey(merged.path, "glb", tmp_path / "a.glb")
    monkeypatch.undo()
    monkeypatch.setattr(export, "GLB_LIMIT", 10**5)
    with pytest.raises(InputError, match="a GLB can hold"):
        export_survey(merged.path, "glb", tmp_path / "a.glb")


def test_an_interrupted_export_leaves_the_earlier_file(merged, tmp_path):
    (tmp_path / "a.ply").write_bytes(b"earlier")

    def stop(stage, fraction):
        if fraction > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_survey(merged.path, "ply", tmp_path / "a.ply", progress=stop)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"earlier"]


def test_memory_of_a_ply_does_not_hold_the_level(merged, tmp_path, monkeypatch):
    """Two fifths of the level are enough, although a tile is a tenth of it and is read through several arrays."""
    monkeypatch.setattr(ply, "BLOCK", 64)
    whole = level_of(merged, 0)
    size = sum(getattr(whole, name).nbytes for name in merge.ARRAYS)
    seen = []

    def look(*_):
        seen.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.reset_peak()

    tracemalloc.start()
    export_survey(merged.path, "ply", tmp_path / "a.ply", progress=look)
    tracemalloc.stop()
    assert max(seen[1:]) - seen[0] < 0.4 * size


def test_a_streamed_sog_without_its_program(merged, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match=r"npm install --global @playcanvas/splat-transform@"):
        export_survey(merged.path, "sog", tmp_path / "sog")
    assert not list(tmp_path.iterdir())


def test_the_version_of_splat_transform_is_that_of_the_tests():
    name, _, version = export.SPLAT_TRANSFORM.rpartition("@")
    assert json.loads((HERE / "package.json").read_text())["dependencies"][name] == version
