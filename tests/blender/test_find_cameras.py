"""Find Cameras without a window: with fake_worker.py, and with the engine."""

import sys

import cv2
import numpy as np
import pytest

from swag_engine.scene.images import read_image
from tests.scenes.panels import SIZE, render, write_photos
from tests.scenes.rotation_flag import with_rotation_flag


def test_cameras_are_found_and_imported(blender, fake_engine, tmp_path):
    found = blender.run("find_cameras.find_and_import", tmp_path / "Fotos ä", SWAG_ENGINE_PYTHON=fake_engine)
    sentence = "Took 5 of 90 frames. 4 of 5 photos have a camera, 50 points, field of view 64° (focal length 812 px), "
    sentence += "the most frequent of 2 lenses, drift 1.2% of the path"
    assert found == {
        "folder": str(tmp_path / "Fotos ä_scene"),
        "found": [sentence, "The focal length is doubtful."],
        "message": f"{sentence}. The focal length is doubtful.",
        "failed": False,
        "cameras": 4,
        "points": 50,
        "page": {"opened": [], "drawn": 0},
    }
    assert "Find Cameras: Matching photos" in blender.printed and "Traceback" not in blender.printed


def test_photos_that_cannot_be_used_are_reported_in_one_sentence(blender, fake_engine, tmp_path):
    found = blender.run("find_cameras.refuse", tmp_path / "unusable", SWAG_ENGINE_PYTHON=fake_engine)
    first, second = found["messages"]
    assert first.strip() == "Error: Choose the folder of the photos, or a video."
    assert second.strip() == f"Error: There are no photos (JPEG, PNG, TIFF, BMP or WebP) in {tmp_path / 'unusable'}."
    assert found["objects"] == 0 and found["folder"] == "" and "Traceback" not in blender.printed


def test_photos_may_be_given_as_a_folder_a_photo_or_a_video_and_the_scene_gets_a_free_folder(blender, tmp_path):
    for name in ("dive.1", "dive.1_scene", "dive.1_scene-2"):
        (tmp_path / name).mkdir()
    choices = [(tmp_path / "dive.1", ""), (f"{tmp_path / 'dive.1'}/", ""), (tmp_path / "dive.1" / "a.JPG", "")]
    choices += [(tmp_path / "film.mp4", ""), (tmp_path / "film.mp4", tmp_path / "mine")]
    made = blender.run("find_cameras.requests", [[str(text) for text in choice] for choice in choices])
    assert [(request["photos"], request["out"]) for request in made] == [
        *[(str(tmp_path / "dive.1"), str(tmp_path / "dive.1_scene-3"))] * 3,
        (str(tmp_path / "film.mp4"), str(tmp_path / "film_scene")),
        (str(tmp_path / "film.mp4"), str(tmp_path / "mine")),
    ]


def test_pictures_with_a_rotation_flag_are_shown_as_the_engine_reads_them(blender, tmp_path):
    paths = [tmp_path / "a.jpg", tmp_path / "b.tif"]
    for path in paths:
        path.write_bytes(with_rotation_flag(cv2.imencode(path.suffix, render(0))[1].tobytes()))
        assert read_image(path)[0].shape == (SIZE[1], SIZE[0], 3)
    assert blender.run("find_cameras.picture_sizes", [str(path) for path in paths]) == [list(SIZE)] * 2


@pytest.mark.main_version
def test_the_engine_finds_cameras_and_a_cancelled_search_leaves_nothing(blender, tmp_path):
    photos = write_photos(tmp_path / "dive", np.linspace(-1, 1, 6))
    cancelled = blender.run("find_cameras.cancel", photos, SWAG_ENGINE_PYTHON=sys.executable)
    assert cancelled["pressed"] and "Find Cameras was stopped; nothing was written." in cancelled["message"]
    assert cancelled["objects"] == 0 and cancelled["folder"] == ""
    assert [path.name for path in tmp_path.iterdir()] == ["dive"]
    found = blender.run("find_cameras.find_and_import", photos, tmp_path / "out", SWAG_ENGINE_PYTHON=sys.executable)
    assert "px ± " in found["found"][0] and found["message"].startswith(found["found"][0])
    assert found["page"] == {"opened": [(tmp_path / "out" / "cameras.html").as_uri()], "drawn": 1}
    assert found["cameras"] == 6 and found["points"] > 100 and found["folder"] == str(tmp_path / "out")
    assert found["found"][0].startswith("6 of 6 photos have a camera") and "Traceback" not in blender.printed


@pytest.mark.main_version
def test_photos_without_a_model_are_offered_to_find_cameras(blender, tmp_path):
    photos = write_photos(tmp_path / "photos", np.linspace(-0.5, 0.5, 4))
    no_model = write_photos(tmp_path / "no model", [0.0])
    found = blender.run("find_cameras.buttons", no_model, SWAG_ENGINE_PYTHON=sys.executable)
    assert len(found["messages"]) == 2 and photos.exists()
    for message in found["messages"]:
        assert "No COLMAP model was found" in message and "Find Cameras" in message and "swag_engine" not in message
    first, *refused, done = found["drawn"]
    assert first == [{"operator": "swag.open_photos", "text": ""}]
    offered = {"operator": "swag.find_cameras", "text": "Find Cameras of These Photos", "filepath": str(no_model)}
    for drawn in refused:
        assert drawn[0] == first[0] and drawn[-1] == offered
    assert done[0] == first[0] and offered not in done
    assert [drawn["text"] for drawn in done if "prop" in drawn] == ["Cameras", "Sparse Points"]


@pytest.mark.main_version
def test_cameras_are_imported_where_the_photos_have_them_and_found_where_not(blender, tiny_scene, tmp_path):
    photos = write_photos(tmp_path / "dive", np.linspace(-0.5, 0.5, 4))
    inside = [tiny_scene / "images", tiny_scene / "sparse" / "0", next((tiny_scene / "images").iterdir())]
    done = blender.run("find_cameras.open_photos", photos, [tiny_scene, *inside], SWAG_ENGINE_PYTHON=sys.executable)
    assert done == [["Find Cameras", f"{photos}_scene"], *[["Import", str(tiny_scene)]] * 4]


def test_hidden_cameras_keep_their_places(blender, tiny_scene):
    found = blender.run("find_cameras.hide_cameras", tiny_scene, SWAG_ENGINE_PYTHON=sys.executable)
    assert found["visible"] == [False, True, True]
    before, after = np.array(found["places"])
    np.testing.assert_allclose(after - before, (5, 0, 0), atol=1e-5)
