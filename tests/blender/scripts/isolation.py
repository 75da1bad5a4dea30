"""A script that leaves as much as it can, one that looks for it, and ones that never answer."""

import os
import sys
import time
from pathlib import Path

import bpy
from bl_ext.user_default.swag_splatting.swag_blender import engine_process

HANDLERS = bpy.app.handlers.load_post


@bpy.app.handlers.persistent
def left_handler(_):
    """Stay registered."""


def leave_everything():
    bpy.data.objects.new("left", None).use_fake_user = True
    bpy.context.scene["left"] = 1
    bpy.context.scene.swag.scene_folder = "/left"
    bpy.types.Scene.left = bpy.props.IntProperty()
    bpy.context.preferences.edit.undo_steps = 7
    bpy.context.preferences.addons["bl_ext.user_default.swag_splatting"].preferences.engine_python = "/left"
    HANDLERS.append(left_handler)
    engine_process.CANCEL_SECONDS = -1
    os.environ["LEFT"] = "1"
    os.chdir("/")
    sys.path.append("/left")
    Path(bpy.app.tempdir, "left").touch()
    Path(bpy.utils.extension_path_user("bl_ext.user_default.swag_splatting", create=True), "left").touch()
    return found_state()


def found_state():
    """What leave_everything changes, as it is now."""
    preferences = bpy.context.preferences
    user = Path(bpy.utils.extension_path_user("bl_ext.user_default.swag_splatting", create=True))
    return {
        "objects": list(bpy.data.objects.keys()),
        "scene": [bpy.context.scene.get("left"), bpy.context.scene.swag.scene_folder, hasattr(bpy.types.Scene, "left")],
        "undo steps": preferences.edit.undo_steps,
        "engine": preferences.addons["bl_ext.user_default.swag_splatting"].preferences.engine_python,
        "handlers": [handler.__name__ for handler in HANDLERS if handler.__name__ == "left_handler"],
        "module": engine_process.CANCEL_SECONDS,
        "process": [os.environ.get("LEFT"), os.getcwd(), "/left" in sys.path],
        "files": [Path(bpy.app.tempdir, "left").exists(), (user / "left").exists()],
    }


def crash():
    print("the last words", flush=True)
    os.abort()


def hang():
    time.sleep(60)


def fail():
    raise ValueError("this script fails")
