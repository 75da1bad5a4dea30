"""Install Engine, Check Engine and Remove Engine in Blender's preferences, from a folder of wheels."""

import pytest

INSTALL = """
import json, sys, bpy
from bl_ext.user_default.swag_splatting.swag_blender import engine_process
own = bpy.context.preferences.addons[EXTENSION].preferences
status = bpy.context.window_manager.swag

def attempt(word, operator):
    try:
        operator()
        print(word, json.dumps(status.message))
    except RuntimeError as error:
        print(word, json.dumps(str(error)))

engine_process.PACKAGES = ("no_such_package",)  # this Python is no engine
"""


def test_installs_from_wheels_checks_and_removes(blender, wheels):
    if blender.version == "5.2":
        pytest.skip("The wheels lend the packages of this Python, which is not Blender 5.2's.")
    printed = blender.run(
        INSTALL
        + """
attempt("OFFLINE", bpy.ops.swag.install_engine)
own.wheels_folder = sys.argv[-1]
attempt("LOOK", bpy.ops.swag.look_up_engine)
print("HALF", json.dumps(engine_process.environment_is_whole()))
attempt("INSTALL", bpy.ops.swag.install_engine)
print("WHOLE", json.dumps([engine_process.environment_is_whole(), engine_process.engine_python()]))
print("DOCTOR", status.doctor)
attempt("CHECK", bpy.ops.swag.check_engine)
attempt("REMOVE", bpy.ops.swag.remove_engine)
print("LEFT", json.dumps([engine_process.environment_is_whole(), engine_process.environment_folder().exists()]))
attempt("NONE", bpy.ops.swag.check_engine)
""",
        wheels,
    )
    assert "Online access is off" in blender.json_after("OFFLINE", printed)
    assert blender.json_after("LOOK", printed).endswith("0 MB of them are to be downloaded.")
    assert blender.json_after("HALF", printed) is False
    assert blender.json_after("INSTALL", printed).startswith("The engine is installed: Python 3.11")
    whole, python = blender.json_after("WHOLE", printed)
    assert whole and python.startswith(str(blender.user))
    assert set(blender.json_after("DOCTOR", printed)["packages"].values()).isdisjoint({None})
    assert blender.json_after("CHECK", printed).startswith("The engine is ready: torch ")
    assert blender.json_after("LEFT", printed) == [False, False]
    assert "press Install Engine" in blender.json_after("NONE", printed)


def test_failed_installation_is_one_sentence_and_has_a_log(blender, tmp_path):
    (tmp_path / "empty").mkdir()
    printed = blender.run(
        INSTALL
        + """
own.wheels_folder = sys.argv[-1]
attempt("FAILED", bpy.ops.swag.install_engine)
bpy.ops.swag.show_log()
print("LOG", json.dumps(bpy.data.texts["SWAG Log"].as_string()))
print("WHOLE", json.dumps(engine_process.environment_is_whole()))
attempt("NONE", bpy.ops.swag.check_engine)
""",
        tmp_path / "empty",
    )
    failed = blender.json_after("FAILED", printed)
    assert "The engine could not be installed. There is no wheel of " in failed and "Traceback" not in printed
    assert "Looking up the packages" in blender.json_after("LOG", printed)
    assert blender.json_after("WHOLE", printed) is False
    assert "press Install Engine" in blender.json_after("NONE", printed)


def test_an_environment_of_a_blender_that_is_gone_is_not_taken(blender):
    printed = blender.run(
        INSTALL
        + """
python = engine_process.environment_python()
python.parent.mkdir(parents=True)
python.symlink_to("/no/such/blender/python")
(engine_process.environment_folder() / "installed.json").write_text("{}")
print("WHOLE", json.dumps(engine_process.environment_is_whole()))
"""
    )
    assert blender.json_after("WHOLE", printed) is False


def test_a_python_without_the_packages_is_told_what_it_lacks(blender, tmp_path):
    bare = tmp_path / "python"
    bare.write_text('#!/bin/sh\nexec /usr/bin/env python3 -S "$@"\n')
    bare.chmod(0o755)
    printed = blender.run(
        INSTALL + "own.engine_python = sys.argv[-1]\nattempt('CHECK', bpy.ops.swag.check_engine)", bare
    )
    assert "This Python lacks torch, numpy" in blender.json_after("CHECK", printed)
