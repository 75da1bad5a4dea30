"""Jobs: what Blender may repeat, which run beside others, what undo leaves as it is, how Cancel ends one."""

import sys

import pytest


def test_no_job_can_be_repeated_by_adjust_last_operation(blender):
    found = blender.run("jobs.options")
    assert {"swag.train", "swag.import_scene", "swag.plan", "swag.label_run", "swag.install_engine"} <= set(found)
    repeatable = {name for name, options in found.items() if "REGISTER" in options}
    assert not repeatable
    assert "UNDO" in found["swag.train"] and "UNDO" in found["swag.import_scene"]


def test_a_job_that_takes_the_whole_machine_does_not_start_beside_another_one(blender, fake_engine, tmp_path):
    found = blender.run("jobs.start_beside", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    assert found == {"message": "Training is running: wait for its end, or cancel it.", "job": "Training"}


def test_cancel_stops_one_job_and_stops_it_now_when_pressed_again(blender):
    assert blender.run("jobs.cancel") == [
        [[True, False], [False, False]],
        [[True, True], [False, False]],
        ["CANCELLED"],
        [["Maps", True]],
    ]


def test_a_training_that_is_stopping_says_what_is_still_done(blender):
    texts = ["Stopping", "Stopping: evaluating test photo 3 of 7", "Stopping now"]
    assert blender.run("jobs.texts_while_stopping") == texts


def test_jobs_run_beside_a_training_where_they_do_not_write_to_its_run(blender, fake_engine, tmp_path):
    scene = tmp_path / "endless"
    scene.mkdir()
    found = blender.run("jobs.beside", scene, SWAG_ENGINE_PYTHON=fake_engine)
    wait = ": wait for its end, or cancel it"
    heavy, run = "Training is running" + wait, f"Training is working on {scene / 'swag_run'}" + wait
    assert found["started"] == ["INTERFACE"]
    # Train, Find Cameras, Check, Orthomosaic, Label.
    assert found["same run"] == [heavy, heavy, "", run, run]
    assert found["other run"] == [heavy, heavy, "", "", ""]
    assert found["no memory"][0].startswith("Training is running, and 0.2 GB of memory are free (at least 1.5 GB")
    assert found["checked"][0].startswith("11 of 12 photos have a camera") and found["checked"][1] == ["Training"]
    assert found["message"].startswith("Stopped; kept 600 Gaussians") and not found["failed"]
    assert found["workers"] == 0 and found["objects"] == [600]
    assert found["undone"] == ["other"], "the result is one step of undo"


def test_a_training_that_has_to_be_killed_is_a_warning(blender, fake_engine, tmp_path):
    scene = tmp_path / "deaf"
    scene.mkdir()
    message, failed = blender.run("jobs.killed", scene, SWAG_ENGINE_PYTHON=fake_engine)
    assert message.startswith("The engine did nothing for 0 s after Cancel and was ended. ") and failed


def test_an_installation_goes_on_when_another_file_is_opened(blender):
    found = blender.run("jobs.load_beside_an_installation")
    assert found["stopped"] == ["Training"] and found["running"] == ["Installation"]
    assert found["message"].startswith("Stopped, because another file was opened")


def test_undo_during_a_training_keeps_its_folder_and_its_plan(blender, fake_engine, tmp_path):
    found = blender.run("jobs.undo", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    kept = {
        "scene_folder": str(tmp_path),
        "run_folder": str(tmp_path / "swag_run"),
        "plan": [["attenuation", "on"], ["lamp", "off"], ["moving_objects", "unknown"]],
        "stale": False,
    }
    assert found["undone"] == kept | {"lamp": "ON", "cube": False}
    assert found["redone"] == kept | {"lamp": "ON", "cube": True}
    assert found["choice"] == "PLAN", "a choice that the user made after the start is undone"
    assert found["typed"] == str(tmp_path / "swag_run"), "so is a folder"


def test_undo_without_a_training_takes_back_what_was_chosen(blender, tmp_path):
    assert blender.run("jobs.undo_a_choice", tmp_path) == ""


@pytest.mark.main_version  # the sentence is the engine's
def test_a_folder_that_cannot_be_written_is_named_with_what_to_do(blender, tiny_scene, tmp_path):
    (tmp_path / "file").touch()
    run = tmp_path / "file" / "run"
    message = blender.run("jobs.train_to", tiny_scene, run, SWAG_ENGINE_PYTHON=sys.executable)
    assert message == f"Cannot write {run}: Not a directory; choose another folder, or check who may write to this one."
    assert "Traceback" not in blender.printed


def test_undo_goes_on_while_previews_arrive(blender, tmp_path):
    found = blender.run("jobs.undo_previews", tmp_path)
    assert found["before"] == {"points": [50], "x": 2}
    assert found["undone"] == {"points": [], "x": 0}
    assert found["redone"] == {"points": [60], "x": 2}
    assert found["deleted"] == {"points": [], "x": 2}
