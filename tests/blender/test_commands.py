"""`blender --background --command swag`: the engine's commands, and `import`, which writes a .blend."""

import sys

import pytest


@pytest.mark.main_version
def test_import_writes_a_blend_of_a_scene_and_of_its_run(blender, tiny_scene, tmp_path):
    found = blender.run("command_line.import_scene_and_run", tiny_scene, tmp_path, SWAG_ENGINE_PYTHON=sys.executable)
    assert found["codes"] == [0, 0, 0, 0], blender.printed
    assert found["cameras"] == 10 and found["path"] == str(tiny_scene)
    assert found["trained"] == {"objects": 1, "has parent": True, "renderer": "CYCLES"}
    assert f"10 cameras, 2 point clouds: {tmp_path / 'run.blend'}" in blender.printed
    assert f"0 cameras, 1 point clouds: {tmp_path / 'file.blend'}" in blender.printed
    assert "Traceback" not in blender.printed


def test_import_reports_what_is_wrong_and_writes_nothing(blender, fake_engine, tmp_path):
    (tmp_path / "stopped").mkdir()
    (tmp_path / "stopped" / "config.json").write_text("{}")
    codes = blender.run("command_line.wrong_imports", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    assert codes == {"wrong": [2] * 4, "import help": 0, "help": 7}
    assert "a.obj must end in .blend." in blender.printed and "holds no result yet" in blender.printed
    assert "usage: blender --background --command swag import" in blender.printed
    assert "In Blender there is also" in blender.printed
    assert not list(tmp_path.glob("*.blend")) and "Traceback" not in blender.printed


def test_a_command_runs_the_engine_with_the_same_arguments_and_exit_code(blender, fake_engine):
    words = ["train", "a folder", "--out", "räumlich"]
    assert blender.run("command_line.run", *words, SWAG_ENGINE_PYTHON=fake_engine) == 7
    assert 'arguments ["train", "a folder", "--out", "r\\u00e4umlich"]' in blender.printed


def test_a_command_without_an_engine_is_refused_in_one_sentence(blender):
    assert blender.run("command_line.run", "doctor", SWAG_ENGINE_PYTHON="/no/such/python") == 2
    assert "/no/such/python cannot be run" in blender.printed and "Traceback" not in blender.printed


@pytest.mark.main_version
def test_sigterm_is_passed_on_and_keeps_what_exists(blender, tiny_scene, tmp_path):
    assert (
        blender.run("command_line.train_and_terminate", tiny_scene, tmp_path, SWAG_ENGINE_PYTHON=sys.executable) == 143
    )
    assert (tmp_path / "run" / "result.ply").exists() and "Traceback" not in blender.printed
