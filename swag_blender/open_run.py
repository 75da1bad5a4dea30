"""A run from its folder: splats, water, labels, figures and plan, and its imported scene where there is one."""

import contextlib
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.ply import read_ply
from ..swag_engine.formats.run_folder import RunFolder, read_json
from . import framing, labels, scene_import, splats
from .blender_types import call_operator, present
from .properties import swag_of
from .runs import RUN_KEY, remember_training, show_splats


def find_run(path: Path) -> RunFolder:
    """The run of a folder, or of a file in it such as config.json. Raises InputError where there is none."""
    folder = path if path.is_dir() else path.parent
    run = RunFolder(folder.absolute())
    if not run.config.is_file():
        raise InputError(f"{folder} is not the folder of a run: choose the one that has config.json and result.ply.")
    return run


def open_run(context: bpy.types.Context, path: Path) -> tuple[bpy.types.Object, str]:
    """Show a run in the scene, select it, and choose its photos and folder for training.

    Args:
        context: where the splats go: its scene.
        path: the run's folder, or a file in it.

    Returns:
        The splat object, and what to tell the user.

    Raises:
        InputError: there is no run, it has no result yet, or a file of it is damaged.
    """
    run = find_run(path)
    if not run.ply.is_file():
        raise InputError(
            f"{run.path} holds no result yet: choose it as Output Folder and its photos, and press Continue."
        )
    images, _, up = run.read_config()
    loaded, metrics = read_ply(run.ply), _metrics(run)
    scene = present(context.scene)
    swag = swag_of(scene)
    root = _root_of(scene, images)
    obj = show_splats(scene, loaded, str(run.path), root[scene_import.ROOT_KEY] if root else str(images))
    obj.name = f"{images.name} {run.path.name}"
    if obj.parent is None:
        obj.matrix_world = scene_import.colmap_to_blender(np.asarray(up, float), loaded.positions)
    know_run(obj, run)
    if images.is_dir():
        swag.scene_folder = str(images)
    swag.run_folder = str(run.path)
    if metrics:
        swag.show_metrics({"ply": str(run.ply), "metrics": metrics, "interrupted": bool(metrics.get("interrupted"))})
    # A plan of another version is not shown; the run does not need it any more.
    with contextlib.suppress(InputError, KeyError, TypeError, AttributeError):
        if run.plan.is_file():
            swag.plan.take(read_json(run.plan, ""), swag.scene_path)
    if context.mode == "OBJECT" and present(context.view_layer).objects.get(obj.name):
        splats.select_only(context, [obj])
    framing.frame_first_splats(context, [obj])
    return obj, f"{len(loaded):,} splats of the run in {run.path}."


def know_run(obj: bpy.types.Object, run: RunFolder) -> None:
    """Give a splat object what its run knows of it: the run's folder, its water, its labels, its pixel size.

    Raises:
        InputError: a file of the run is damaged.
    """
    obj[RUN_KEY] = str(run.path)
    remember_training(obj, run, {"background": (0.0, 0.0, 0.0)} | _metrics(run))
    if labels.attribute(obj, labels.LABEL) is not None:
        labels.read_labels(obj, str(run.path))


def run_of_file(path: Path) -> RunFolder | None:
    """The run whose result a splat file is; None for other files."""
    run = RunFolder(path.absolute().parent)
    with contextlib.suppress(InputError):
        run.read_config()
        return run if path.absolute() in run.results.values() else None
    return None


def import_cameras(obj: bpy.types.Object, scene: bpy.types.Scene) -> str:
    """Start to import the photos and cameras of the run of a splat object, unless they are there.

    Returns:
        What to tell the user where it cannot be done; "" otherwise.
    """
    images, _, _ = RunFolder(Path(obj[RUN_KEY])).read_config()
    if obj.parent is not None or _root_of(scene, images):
        return ""
    if not images.is_dir():
        return f"Its photos are not in {images} any more: there are no cameras."
    try:
        call_operator("import_scene", "EXEC_DEFAULT" if bpy.app.background else "INVOKE_DEFAULT", directory=str(images))
    except RuntimeError as error:
        return f"Its cameras are not imported: {str(error).strip().removeprefix('Error: ')}"
    return ""


def adopt_splats(root: bpy.types.Object, scene: bpy.types.Scene) -> None:
    """Put the splats of runs of a scene that was just imported below its root, where they fit its cameras."""
    for obj in list(scene.objects):
        if not obj.get(RUN_KEY) or obj.parent is not None or not splats.is_splats(obj):
            continue
        run = RunFolder(Path(obj[RUN_KEY]))
        with contextlib.suppress(InputError):
            if _same(run.read_config()[0], Path(root[scene_import.ROOT_KEY])):
                obj.parent = root
                obj.matrix_parent_inverse.identity()
                obj.matrix_basis.identity()
                know_run(obj, run)
                scene_import.hide_sparse_points(root)


def _metrics(run: RunFolder) -> dict[str, Any]:
    return read_json(run.metrics, "") if run.metrics.is_file() else {}


def _root_of(scene: bpy.types.Scene, images: Path) -> bpy.types.Object | None:
    roots = scene_import.roots(scene)
    return next((root for root in roots if _same(Path(root[scene_import.ROOT_KEY]), images)), None)


def _same(first: Path, second: Path) -> bool:
    return first.resolve() == second.resolve()
