"""Splat files as objects."""

from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.gltf import COLMAP_UP
from ..swag_engine.formats.registry import find_format
from ..swag_engine.scene.georeference import Placement
from ..swag_engine.splats.develop_splats import undo_development
from . import colors, framing, scene_import, splats
from .blender_types import present
from .georeference import georeference_of, remember_placement, use_units
from .open_run import know_run, run_of_file


def open_splats(
    context: bpy.types.Context, paths: list[Path], in_scene: bool, sh_degree: int
) -> tuple[list[bpy.types.Object], list[str]]:
    """Make an object of each splat file, select the new objects and make the last one active.

    Args:
        context: where the objects go: its collection.
        paths: files of any format of the engine's registry.
        in_scene: whether the files are in the COLMAP frame of the imported scene; else they are placed upright.
        sh_degree: highest degree of spherical harmonics to keep, 0 to 3.

    Returns:
        The objects, and a sentence for each file that could not be opened.
    """
    opened, failed = [], []
    for path in paths:
        try:
            opened.append(_open_file(context, path, in_scene, sh_degree))
        except InputError as error:
            failed.append(str(error))
    if opened:
        splats.select_only(context, opened)
        framing.frame_first_splats(context, opened)
    return opened, failed


def _open_file(context: bpy.types.Context, path: Path, in_scene: bool, sh_degree: int) -> bpy.types.Object:
    format = find_format(path)
    root = scene_import.active_root(context) if in_scene else None
    if in_scene and root is None:
        raise InputError(f"{path.name} needs an imported scene: import its COLMAP scene, or place it upright.")
    run = run_of_file(path)
    up = scene_import.up_of(root) if root else np.asarray(run.read_config()[2] if run else COLMAP_UP, float)
    loaded = format.read(path, up)
    loaded.sh = loaded.sh[:, : (sh_degree + 1) ** 2]
    obj = splats.new_splat_object(path.stem, undo_development(loaded), present(context.collection), root)
    scene_import.hide_sparse_points(root)
    if loaded.development:
        colors.remember_developments(obj, {"auto": loaded.development.development.to_json()})
    if loaded.placement:
        _place(obj, loaded.placement, context, root)
    elif root is None:
        obj.matrix_world = scene_import.colmap_to_blender(up, loaded.positions) if run else splats.FILE_FRAME
    if run:
        try:
            know_run(obj, run)
        except InputError:
            bpy.data.objects.remove(obj)
            raise
    return obj


def _place(
    obj: bpy.types.Object, placement: Placement, context: bpy.types.Context, root: bpy.types.Object | None
) -> None:
    """Place splats of a georeferenced file: below the root of their scene, else upright in metres.

    Raises:
        InputError: the scene lies elsewhere; the object is removed.
    """
    if root is None:
        remember_placement(obj, placement)
        use_units(present(context.scene))
        obj.matrix_world = Matrix.Diagonal((*[1 / present(context.scene).unit_settings.scale_length] * 3, 1.0))
        return
    measured = georeference_of(root)
    if measured is None or (measured.placement or placement) != placement:
        name = obj.name
        bpy.data.objects.remove(obj)
        raise InputError(f"{name} is georeferenced, and not where the scene is: open it without In Scene.")
    obj.matrix_basis = Matrix(np.linalg.inv(measured.matrix).tolist())
