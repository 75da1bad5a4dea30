"""Jobs: what Blender may repeat, what undo and a closed dialog leave as it is, how Cancel ends one."""

import sys

import pytest


def test_no_job_can_be_repeated_by_adjust_last_operation(blender):
    found = blender.run("jobs.options")
    assert {"swag.train", "swag.import_scene", "swag.plan", "swag.label_run", "swag.install_engine"} <= set(found)
    repeatable = {name for name, options in found.items() if "REGISTER" in options}
    assert not repeatable
    assert "UNDO" in found["swag.train"] and "UNDO" in found["swag.import_scene"]


def test_a_dialog_that_is_closed_leaves_the_running_job_alone(blender):
    assert blender.run("jobs.close_dialog") == "Training"


def test_no_job_starts_beside_another_one(blender, fake_engine, tmp_path):
    found = blender.run("jobs.start_beside", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    assert "Training is running: wait for its end, or cancel it" in found["message"]
    assert found["job"] == "Training"


def test_cancel_stops_the_job_and_does_nothing_once_it_has_ended(blender):
    assert blender.run("jobs.cancel") == {"running": True, "ended": False}


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
