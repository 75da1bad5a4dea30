"""The bpy package with this working tree as an extension; needs nothing that Blender's own Python does not have."""

import importlib
import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EXTENSION = "bl_ext.user_default.swag_splatting"


def blender_with_extension(user: Path):
    """The bpy module with this working tree enabled as an extension; `user`: a folder for Blender's user files."""
    os.environ["BLENDER_USER_RESOURCES"] = str(user)
    extensions = user / "extensions" / "user_default"
    extensions.mkdir(parents=True)
    (extensions / "swag_splatting").symlink_to(ROOT, target_is_directory=True)
    import bpy

    addon_utils = importlib.import_module("addon_utils")  # on the path once bpy is there
    addon_utils.enable("bl_pkg")
    addon_utils.enable(EXTENSION, default_set=True)
    return bpy
