"""Maps and measurements in Blender: made by the engine, and shown at their place."""

import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio

from tests.scenes.flat_splats import GEOREFERENCE, sheet, write_run


def survey(folder, coral=True):
    """Sand 4 m by 3 m with a coral 20 cm above it, which is gone without `coral`."""
    parts = [sheet(0, 0, 4, 3, 0.05, lambda x, y: 0.02 * np.sin(9 * x) + 0.02 * np.cos(7 * y), label=1)]
    if coral:
        parts.append(sheet(1, 1, 1.8, 1.6, 0.03, 0.2, color=(0.8, 0.3, 0.3), label=2))
    return write_run(folder, parts, ("sand", "coral"))


@pytest.mark.main_version
def test_each_map_is_made_by_the_engine_and_shown_at_its_place(blender, tmp_path):
    """Fifteen seconds: six calls of the engine, each a process that imports torch."""
    run, later = survey(tmp_path / "first"), survey(tmp_path / "second", coral=False)
    to_map = GEOREFERENCE.matrix
    line = np.array([[0.4, 1.3, 0.0], [2.8, 1.3, 0.0]])
    in_scene = (line - to_map[:3, 3]) @ np.linalg.inv(to_map[:3, :3]).T
    found = blender.run("maps.make_all", run, later, in_scene.tolist(), SWAG_ENGINE_PYTHON=sys.executable)
    maps = found["maps"]
    assert set(maps) == {"ortho", "dem", "areas", "profile", "change"} and found["objects"] == 2 + 5
    with rasterio.open(run / "maps" / "orthomosaic.tif") as dataset:
        bounds = np.array(dataset.bounds) - (500_000, 4_000_000) * 2
        width, height = maps["ortho"]["image"]
        assert width % dataset.width == 0 and width * dataset.height == height * dataset.width  # enlarged
    left, bottom, right, top = bounds
    to_world = np.array(found["matrix"]) @ np.linalg.inv(to_map)
    corners = np.array([(left, bottom, 0.2), (right, bottom, 0.2), (right, top, 0.2), (left, top, 0.2)])
    wanted = corners @ to_world[:3, :3].T + to_world[:3, 3]
    assert np.allclose(maps["ortho"]["corners"], wanted, atol=0.02)
    assert (run / "maps" / "heights_slope.tif").exists()
    rows = {row[0]: row for row in maps["areas"]["lines"]}
    assert float(rows["coral"][1].split()[0]) == pytest.approx(0.48, rel=0.1) and "sand" in rows
    curve = np.array(maps["profile"]["points"])
    assert np.allclose(curve[[0, -1]], found["ends"], atol=0.05)
    ((change, area, height),) = maps["change"]["lines"][1:]
    assert change == "lower" and height.startswith("-0.2") and 0.45 < float(area.split()[0]) < 0.62
    assert "Traceback" not in blender.printed and "Map: Rendering" in blender.printed
    assert Path(maps["change"]["file"]) == run / "maps" / "change"


@pytest.mark.main_version
def test_maps_that_cannot_be_made_are_refused_in_one_sentence(blender, tmp_path):
    run = write_run(tmp_path, [sheet(0, 0, 1, 1, 0.1)])
    found = blender.run("maps.refusals", run, SWAG_ENGINE_PYTHON=sys.executable)
    assert found["change"] == "There is no later run to compare with: choose its folder in Later Run."
    assert found["profile"].startswith("A profile needs two points: use Pick Profile")
    assert found["areas"].startswith("The splats have no labels")
    assert found["view"].startswith("There is no 3D viewport to see the map from")
    assert found["no folder"].startswith(f"There is no folder {run / 'typo'}") and not (run / "typo").exists()
    assert found["folder"].startswith("Cannot write") and "choose another folder" in found["folder"]
    assert found["run"].startswith("The splats of reef are from no run on this machine")
    assert found["failed"] and not found["shown"] and "Traceback" not in blender.printed
