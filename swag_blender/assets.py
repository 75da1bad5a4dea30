"""The node groups as an asset library: a .blend in the extension's own folder, listed in the asset browser.

The library is in the preferences only while the extension is enabled.
"""

import shutil
from pathlib import Path
from typing import Any, cast

import bpy

from ..swag_engine.base.errors import InputError
from . import EXTENSION, water
from .blender_types import present
from .nodes import splat_preview, water_shader
from .water_values import WaterValues

LIBRARY = "SWAG Splatting"
DESCRIPTIONS = {
    splat_preview.NAME: "Modifier that draws a point cloud with the attributes of Gaussian splats",
    splat_preview.NATIVE: "Modifier for the colors of Gaussian splats that Blender draws itself",
    water_shader.NAME: "Light seen through water, for materials",
}


def folder() -> Path:
    """Folder of the library; it need not exist."""
    return Path(bpy.utils.extension_path_user(EXTENSION)) / "assets"


def install(context: bpy.types.Context) -> Path:
    """Write the library, over an older one, and list it; returns its file. The open file does not change.

    The water's node group gets the water of the active splat object, else of the scene, as default values. Raises
    InputError when the library cannot be written.
    """
    source = water.find(present(context.scene), context.active_object)
    try:
        return _write_library(water.water_of(source) or WaterValues())
    except (OSError, RuntimeError) as error:
        raise InputError(f"The asset library cannot be written: {error}") from error


def _write_library(values: WaterValues) -> Path:
    mine: tuple[Any, ...] = (bpy.data.node_groups, bpy.data.materials)
    before = [set(blocks) for blocks in mine]
    groups: set[bpy.types.ID] = {splat_preview.node_group(native=False), water_shader.free_group(values)}
    if splat_preview.HAS_NATIVE:
        groups.add(splat_preview.node_group(native=True))
    unmarked = [group for group in groups if not group.asset_data]
    for group in unmarked:
        group.asset_mark()
        present(group.asset_data).description = DESCRIPTIONS[group.name]
    path = folder() / "nodes.blend"
    path.parent.mkdir(parents=True, exist_ok=True)
    bpy.data.libraries.write(str(path), groups, fake_user=True)
    for group in unmarked:
        group.asset_clear()
    for blocks, known in zip(mine, before, strict=True):
        for made in set(blocks) - known:
            blocks.remove(made)
    register()
    return path


def remove() -> None:
    """Remove the library from the preferences, and its files."""
    unregister()
    shutil.rmtree(folder(), ignore_errors=True)


def register() -> None:
    """List the library in the preferences if it exists."""
    if folder().exists() and not _listed():
        present(bpy.context.preferences).filepaths.asset_libraries.new(name=LIBRARY, directory=str(folder()))


def unregister() -> None:
    """Remove the library from the preferences."""
    for library in _listed():
        present(bpy.context.preferences).filepaths.asset_libraries.remove(library)


def _listed() -> list[bpy.types.UserAssetLibrary]:
    return [
        one
        for one in present(bpy.context.preferences).filepaths.asset_libraries
        if Path(cast(Any, one).path) == folder()
    ]
