"""Scale from Targets, measured scenes, and georeferenced files in Blender."""

import shutil
import sys

import numpy as np
import pytest

from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.registry import FORMATS
from swag_engine.georeference.measure import Measurements, scale_scene
from swag_engine.scene.georeference import Georeference, Placement, write_georeference
from swag_engine.splats.transform import transformed
from tests.blender.test_export import some_splats
from tests.scenes.targets import make_target_scene, ring, target_corners

MEASURED = Georeference(
    0.25, 0.01, "points", "full", np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([1.0, -2.0, -7.0]),
    Placement("EPSG:32633", (500_321.0625, 6_540_052.001, 0.0)),
)  # fmt: skip


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    return make_target_scene(
        tmp_path_factory.mktemp("scene") / "Riff ä", corners=target_corners(0.15, (0, 1, 2)), centres=ring(4)
    )


@pytest.mark.main_version
def test_targets_scale_the_imported_scene(blender, photographed, tmp_path):
    folder = tmp_path / photographed.folder.name
    shutil.copytree(photographed.folder, folder)
    found = blender.run("scale_targets.from_targets", folder, 0.15, SWAG_ENGINE_PYTHON=sys.executable)
    before, after = found["before"], found["after"]
    assert before["metres"] is None and "times as large as its coordinates" in found["drawn before"][0]
    assert after["metres"] == after["water"] == found["kept"] == pytest.approx(0.37, rel=3e-3)
    assert after["scale"] == pytest.approx(after["metres"], rel=1e-5)
    assert np.allclose(after["clip"], np.array(before["clip"]) * after["metres"] / before["scale"], rtol=1e-4)
    assert after["setting"] == 0 and after["units"] == ["METRIC", 1.0]  # training takes the measured one
    assert after["message"].startswith("1 unit = 0.3") and "± 0.1" in after["message"]
    assert after["message"].rstrip(".") == found["drawn"][0]
    assert found["drawn"][1:] == ["swag.scale_from_targets", "swag.pick_scale", "swag.set_scale"]
    assert "No target of the family apriltag_36h11 was found in the 4 photos" in found["refused"]
    assert "Traceback" not in blender.printed


@pytest.mark.main_version
def test_a_measured_scene_is_imported_in_metres(blender, photographed, tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(photographed.folder, folder)
    table = tmp_path / "points.csv"
    rows = [f"{name},{x + 4e5},{y + 6e6},{z}" for name, (x, y, z) in photographed.centres.items()]
    table.write_text("name,x,y,z\n" + "\n".join(rows))
    document = scale_scene(folder, Measurements(points=table))
    found = blender.run("scale_targets.import_measured", folder, SWAG_ENGINE_PYTHON=sys.executable)
    offset = np.array(document["offset"]) - (4e5, 6e6, 0)
    assert found["units"] == pytest.approx(["METRIC", 0.01])
    for name, place in found["cameras"].items():  # a unit is a centimetre
        assert np.allclose(np.array(place) / 100 + offset, photographed.centres[name], atol=1e-4)
    assert found["drawn"][0].startswith("1 unit = 0.37 m") and "all axes measured" in found["drawn"][0]


def test_georeferenced_files_keep_their_coordinates(blender, tmp_path):
    reef = some_splats(60, 1)
    write_ply(tmp_path / "reef.ply", reef)
    found = blender.run("scale_targets.georeferenced_files", tmp_path, MEASURED.to_json())
    wanted = transformed(reef, MEASURED.matrix)
    for suffix in ("ply", "glb", "spz"):
        assert np.allclose(found["matrices"][suffix], np.eye(4), atol=1e-6)
        for name in ("placed", "again"):
            read = FORMATS[suffix].read(tmp_path / f"{name}.{suffix}", (0.0, -1.0, 0.0))
            assert read.placement == MEASURED.placement
            assert np.allclose(read.positions, wanted.positions, atol=1e-5 if suffix != "spz" else 1e-3)
    assert np.allclose(read_ply(tmp_path / "in_scene.ply").positions, reef.positions, atol=1e-4)
    assert read_ply(tmp_path / "in_scene.ply").placement is None
    assert "The scale of scene was not measured" in found["elsewhere"] and not (tmp_path / "no.ply").exists()
    assert found["stored"] is None


@pytest.mark.main_version
def test_a_damaged_scale_is_refused_in_one_sentence(blender, photographed, tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(photographed.folder, folder)
    write_georeference(folder, MEASURED).write_text("{}")
    refused = blender.run("scale_targets.import_refused", folder, SWAG_ENGINE_PYTHON=sys.executable)
    assert "scale.json cannot be read" in refused
