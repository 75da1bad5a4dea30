"""The node groups as assets: a .blend in the extension's own folder, listed as a library in the asset browser.

The library is in the preferences only while the extension is enabled.
"""

import shutil
from pathlib import Path

import bpy

from . import EXTENSION
from .nodes import splat_preview, water_shader
from .water_values import WaterValues

LIBRARY = "SWAG Splatting"
DESCRIPTIONS = {
    splat_preview.NAME: "Draws a point cloud with the attributes of Gaussian splats, as a modifier",
    water_shader.NAME: "Light as it is seen through water, for materials",
}


def folder() -> Path:
    """Where the library is; it need not exist."""
    return Path(bpy.utils.extension_path_user(EXTENSION)) / "assets"


def install(values: WaterValues) -> Path:
    """Write the library and list it, in place of an older one; returns its file.

    values: the water whose figures the water's node group begins with. The open file is left as it is.
    """
    mine = (bpy.data.node_groups, bpy.data.materials)
    before = [set(blocks) for blocks in mine]
    groups = {splat_preview.node_group(), water_shader.free_group(values)}
    unmarked = [group for group in groups if not group.asset_data]
    for group in unmarked:
        group.asset_mark()
        group.asset_data.description = DESCRIPTIONS[group.name]
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
    """Take the library away, from the disk too."""
    unregister()
    shutil.rmtree(folder(), ignore_errors=True)


def register() -> None:
    if folder().exists() and not _listed():
        bpy.context.preferences.filepaths.asset_libraries.new(name=LIBRARY, directory=str(folder()))


def unregister() -> None:
    for library in _listed():
        bpy.context.preferences.filepaths.asset_libraries.remove(library)


def _listed() -> list[bpy.types.UserAssetLibrary]:
    return [one for one in bpy.context.preferences.filepaths.asset_libraries if Path(one.path) == folder()]
