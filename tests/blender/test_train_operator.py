"""Training from Blender without a window: with fake_worker.py, whose behaviour is the scene folder's name, and once
with the engine."""

import os
import sys

import pytest

GO_ON = "What was saved is kept: start again, or press Continue."
INSTALL = (
    "install the packages of requirements.txt there, or press Install Engine in Blender's preferences of SWAG "
    "Splatting."
)


def test_a_training_reports_progress_and_puts_its_result_into_the_scene(blender, fake_engine, tmp_path):
    scene = tmp_path / "Räuber höhle"
    scene.mkdir()
    found = blender.run("train.train_twice", scene, SWAG_ENGINE_PYTHON=fake_engine)
    run = str(scene / "swag_run")
    assert found["first"] == {
        "points": [1000],
        "run": run,
        "gaussians": 1000,
        "psnr": 25.5,
        "interrupted": False,
        "continue": False,
        "message": "Trained 1000 Gaussians in 1:01, 25.5 dB on held-out photos.",
    }
    assert found["second"] == {"objects": 2, "run": run + "-2"}, "a second run gets a folder of its own"
    assert "Training: Photo 1 of 3" in blender.printed
    line = (
        "Training: Iteration 10 of 10, PSNR 30.00 dB, 1000 Gaussians, Maximum 5000, Photos 640 px wide, "
        "7.5 iterations/s, 1:05 left"
    )
    assert line in blender.printed


def test_a_preview_file_that_was_removed_before_it_was_read_is_skipped(blender, fake_engine, tmp_path):
    scene = tmp_path / "removes its preview"
    scene.mkdir()
    assert blender.run("train.points_after_training", scene, SWAG_ENGINE_PYTHON=fake_engine) == [1000]
    assert not (scene / "swag_run" / "preview.ply").exists() and "Traceback" not in blender.printed


@pytest.mark.parametrize(
    ("scene", "sentence"),
    [
        ("unusable", "unusable holds no COLMAP model: look for the folder with sparse/0."),
        (
            "killed",
            "ran out. Close other programs or choose a lower Quality. " + GO_ON,
        ),
        ("terminated", "The engine was ended by the system or another program (signal 15). " + GO_ON),
        ("interrupted", "The engine was ended by the system or another program (signal 15). " + GO_ON),
        ("crash", "The engine ended with exit code 1 before it was done: MemoryError: no memory left. " + GO_ON),
        ("incomplete", "/python lacks the package numpy: " + INSTALL),
    ],
)
def test_a_failed_training_is_reported_in_one_sentence(blender, fake_engine, tmp_path, scene, sentence):
    (tmp_path / scene).mkdir()
    message = blender.run("train.train", tmp_path / scene, SWAG_ENGINE_PYTHON=fake_engine)
    assert message.startswith("Error: ") and message.strip().endswith(sentence)


def test_a_missing_scene_and_a_missing_engine_are_reported_in_one_sentence(blender, tmp_path):
    assert "Choose photos or a video first" in blender.run("train.train", "")
    message = blender.run("train.train", tmp_path, SWAG_ENGINE_PYTHON="/no/such/python")
    assert "The engine's Python /no/such/python cannot be run" in message
    assert "Traceback" not in blender.printed


def test_a_cancelled_training_keeps_its_result(blender, fake_engine, tmp_path):
    scene = tmp_path / "endless"
    scene.mkdir()
    assert blender.run("train.cancel", scene, SWAG_ENGINE_PYTHON=fake_engine) is True
    assert (scene / "run" / "result.ply").exists()


def test_a_worker_that_ignores_a_cancel_is_killed(blender, fake_engine, tmp_path):
    scene = tmp_path / "deaf"
    scene.mkdir()
    message = blender.run("train.cancel", scene, SWAG_ENGINE_PYTHON=fake_engine)
    assert message == "The engine did nothing for 0 s after Cancel and was ended. " + GO_ON


def test_a_worker_ends_with_the_file_the_extension_and_blender(blender, fake_engine, tmp_path):
    scene = tmp_path / "endless"
    scene.mkdir()
    found = blender.run("train.leave_a_worker", scene, SWAG_ENGINE_PYTHON=fake_engine)
    assert found["ended"] == {"file": True, "extension": True}
    os.kill(found["alive"], 0)
    blender.quit()
    with pytest.raises(ProcessLookupError):
        os.kill(found["alive"], 0)


@pytest.mark.main_version  # test_films.py starts the engine in every version
def test_the_engine_trains_an_imported_scene(blender, tiny_scene, tmp_path):
    found = blender.run("train.train_by_the_engine", tiny_scene, tmp_path / "run", SWAG_ENGINE_PYTHON=sys.executable)
    assert found["points"] == [found["gaussians"]] and found["gaussians"] > 0
    assert found["parent"] == tiny_scene.name and found["psnr"] > 10
    assert "is finished already" in found["resumed"]
    assert "Traceback" not in blender.printed


def test_inspecting_a_scene_shows_its_images_and_points(blender, fake_engine, tmp_path):
    found = blender.run("train.inspect", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    assert found.splitlines() == [
        "11 of 12 photos have a camera, 345 points, field of view 64° (focal length 812 px ± 0.4%)",
        "The disk lacks one.png.",
    ]
