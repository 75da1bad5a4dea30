"""Keep splats right when operators of Blender move their points: Apply, Join, and transforms in edit mode.

Blender moves `position` and leaves `scale`, `rotation` and the spherical harmonics. The attribute `splats.SHAPED_AT`
holds the position for which those are right: it tells how the points were moved since, also after undo, and through
modifiers.
"""

from typing import Any, cast

import bpy

from . import splats
from .blender_types import present
from .sidebar import show_popup

WAIT_SECONDS = 0.1
"""Time after which it is looked again whether the user has ended a transform."""
_waiting: set[str] = set()
"""Names of the point clouds whose points the user is moving."""
_messages: list[str] = []


def correct(pointcloud: bpy.types.PointCloud) -> None:
    """Turn and scale the splats of a point cloud along with the points that were moved."""
    if splats.BASE not in pointcloud.attributes or not cast(Any, pointcloud).is_editable:
        return
    unexplained = splats.follow_points_of(pointcloud)
    if unexplained:
        text = bpy.app.translations.pgettext_iface(
            "{count} splats of {name} were moved, but their sizes and rotations could not follow: undo this to keep "
            "them right. To join objects, use Merge in the panel Edit."
        )
        _tell(text.format(count=unexplained, name=pointcloud.name))


def _tell(message: str) -> None:
    print(message)
    if not bpy.app.background:
        _messages.append(message)
        if not bpy.app.timers.is_registered(_show_messages):
            # A popup cannot open while Blender updates the scene.
            bpy.app.timers.register(_show_messages, first_interval=0.0)


def _show_messages() -> None:
    sentences = list(dict.fromkeys(_messages))
    _messages.clear()
    show_popup(sentences, "ERROR")


def _is_transforming() -> bool:
    """Whether the user is moving something; until the end, positions are written anew from those at the start."""
    windows = present(bpy.context.window_manager).windows
    return any(
        operator.bl_idname.startswith("TRANSFORM_OT_")
        for window in windows
        for operator in cast(Any, window).modal_operators
    )


@bpy.app.handlers.persistent
def _after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    for update in depsgraph.updates:
        if update.is_updated_geometry and isinstance(update.id, bpy.types.PointCloud):
            original = present(update.id.original)
            if not _is_transforming():
                correct(original)
                continue
            _waiting.add(original.name)
            if not bpy.app.timers.is_registered(_after_transform):
                bpy.app.timers.register(_after_transform, first_interval=WAIT_SECONDS)


def _after_transform() -> float | None:
    if _is_transforming():
        return WAIT_SECONDS
    for name in _waiting:
        if (pointcloud := bpy.data.pointclouds.get(name)) is not None:
            correct(pointcloud)
    _waiting.clear()
    return None


@bpy.app.handlers.persistent
def _correct_all(*_: object) -> None:
    # The step of undo that an operator makes holds its result before `_after_update`.
    for pointcloud in bpy.data.pointclouds:
        correct(pointcloud)


_HANDLERS = (
    ("depsgraph_update_post", _after_update),
    ("undo_post", _correct_all),
    ("redo_post", _correct_all),
    ("load_post", _correct_all),
)


def register() -> None:
    """Follow changes of point clouds."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Undo `register`."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
    for timer in (_after_transform, _show_messages):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
