"""Films in Blender: cameras that move, what is sent to the engine, and its frames."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest


def test_a_turntable_goes_around_the_splats_at_even_speed(blender):
    blender.run("films.turntable")


def test_a_sweep_stays_on_the_side_of_the_photos(blender):
    blender.run("films.partial_turntable")


@pytest.mark.main_version
def test_a_turntable_goes_around_selected_splats(blender):
    blender.run("films.turntable_of_selected_splats")


def test_a_camera_path_passes_through_the_photos(blender):
    blender.run("films.camera_path")


@pytest.mark.main_version
def test_a_camera_path_needs_two_cameras_and_no_distance(blender):
    blender.run("films.path_without_photos")


def test_a_film_sends_the_splats_that_are_shown_and_cameras_as_blender_projects(blender, tmp_path):
    blender.run("films.request_of_scene", tmp_path / "film")


def test_several_objects_are_filmed_as_they_stand_in_the_scene(blender, tmp_path):
    blender.run("films.several_objects", tmp_path / "film")


@pytest.mark.main_version
def test_cropped_splats_are_not_filmed(blender):
    blender.run("films.cropped_splats")


@pytest.mark.main_version
def test_what_cannot_be_filmed_is_refused_in_one_sentence(blender, fake_engine, tmp_path):
    found = blender.run("films.refusals", tmp_path / "film", SWAG_ENGINE_PYTHON=fake_engine)
    assert found["no folder"].startswith("Choose the folder of the film first")
    assert found["typo"].startswith(f"There is no folder {tmp_path / 'film'}")
    assert found["lens"].startswith("camera is no perspective camera")
    assert found["scale"].startswith("reef is mirrored or not scaled equally")
    assert found["hidden"] == "There are no splats to film: all of them are hidden or cropped."
    assert found["moves"].startswith("other moves relative to reef in frame 2")
    assert "Traceback" not in blender.printed


def test_a_render_has_32_samples(blender):
    blender.run("films.set_up_render")


def test_a_frame_through_a_photos_camera_is_the_engines_own_image(blender, finished_run, tiny_scene, tmp_path):
    from swag_engine.experiments.evaluate_run import load_newest
    from swag_engine.formats.run_folder import RunFolder
    from swag_engine.rendering.render import render
    from swag_engine.scene.colmap import load_scene

    out = tmp_path / "film"
    found = blender.run("films.film_of_run", finished_run, tiny_scene, out, SWAG_ENGINE_PYTHON=sys.executable)
    assert found["message"] == f"2 frames: {out}" and "Film: Frame 2 of 2" in blender.printed
    assert found["depth"] == pytest.approx(4, rel=0.1)  # in Blender units, by the scale of the scene
    assert {path.name for path in out.iterdir()} == {"0001.png", "0002.png", "depth", "cameras.json"}
    cloud, effects, _ = load_newest(finished_run)
    _, settings, _ = RunFolder(Path(finished_run)).read_config()
    cameras = {view.camera.name: view.camera for view in load_scene(tiny_scene).views}
    for number, name in enumerate(found["names"], 1):
        own = render(cloud, cameras[name], settings.sh_degree, effects.medium, lamp=effects.lamp).color
        seen = cv2.cvtColor(cv2.imread(str(out / f"{number:04d}.png")), cv2.COLOR_BGR2RGB)
        error = seen.astype(float) - (own.clamp(0, 1) * 255).round().numpy()
        assert 10 * np.log10(255**2 / max(np.square(error).mean(), 1e-9)) > 55, f"frame {number}"
