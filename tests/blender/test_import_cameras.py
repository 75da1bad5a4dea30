"""Import Cameras without a window: with fake_worker.py, and with the engine."""

import json
import sys

import numpy as np
import pytest

from tests.scenes.panels import SIZE, write_photos


def test_the_cameras_of_another_program_are_imported(blender, fake_engine, tmp_path):
    file, photos = tmp_path / "cameras.xml", tmp_path / "photos"
    found = blender.run("import_cameras.import_and_look", file, photos, SWAG_ENGINE_PYTHON=fake_engine)
    assert found["error"] == "" and found["folder"] == str(tmp_path / "cameras_scene")
    assert (found["cameras"], found["points"]) == (4, 50) and "The focal length is doubtful." in found["message"]
    assert "Import Cameras: Matching photos" in blender.printed and "Traceback" not in blender.printed


def test_files_that_cannot_be_used_are_reported_in_one_sentence(blender, fake_engine, tmp_path):
    found = blender.run("import_cameras.refuse", tmp_path / "unusable", SWAG_ENGINE_PYTHON=fake_engine)
    first, second = (message.strip() for message in found["messages"])
    assert first == "Error: Choose the file with the cameras, such as the XML of Metashape."
    assert second.startswith("Error: There are no photos") and found["objects"] == 0


def test_photos_and_points_are_only_sent_where_they_are_chosen(blender, tmp_path):
    (tmp_path / "a_scene").mkdir()
    file = str(tmp_path / "a.xml")
    choices = [(file, "", "", ""), (file, str(tmp_path / "p"), str(tmp_path / "c.ply"), str(tmp_path / "mine"))]
    least, most = blender.run("import_cameras.requests", choices)
    assert least == {"request": "import_cameras", "file": file, "out": str(tmp_path / "a_scene-2")}
    assert most["photos"] == str(tmp_path / "p") and most["points"] == str(tmp_path / "c.ply")
    assert most["out"] == str(tmp_path / "mine")


def test_the_panel_and_the_menu_offer_the_import(blender):
    found = blender.run("import_cameras.menu_and_panel")
    assert found["menu"] == 1
    assert found["panel"][:4] == ["cameras_file", "cameras_photos", "cameras_points", "swag.import_cameras"]
    assert ["filepath", "/a/cameras.xml"] in found["panel"] and ["photos_folder", "/a/photos"] in found["panel"]


@pytest.mark.main_version
def test_the_engine_makes_the_scene(blender, tmp_path):
    places = np.linspace(-0.6, 0.6, 4)
    write_photos(tmp_path / "photos", places)
    frames = []
    for number, x in enumerate(places):
        matrix = np.diag([1.0, -1.0, -1.0, 1.0])
        matrix[:3, 3] = [x, 0.1 * np.sin(2 * x), 0]
        frames.append({"file_path": f"{number}.png", "transform_matrix": matrix.tolist()})
    lens = {"w": SIZE[0], "h": SIZE[1], "fl_x": 1.1 * SIZE[0]}
    (tmp_path / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    found = blender.run(
        "import_cameras.import_and_look",
        tmp_path / "transforms.json",
        tmp_path / "photos",
        tmp_path / "out",
        SWAG_ENGINE_PYTHON=sys.executable,
    )
    assert found["error"] == "" and found["cameras"] == 4 and found["points"] > 100
    assert found["message"].startswith("4 of 4 photos have a camera") and "Traceback" not in blender.printed
