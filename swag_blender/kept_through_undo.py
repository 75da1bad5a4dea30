"""What undo does not take back from a scene: the folder of its run, and what the engine found about its photos.

A run is on the disk: without its folder in the scene, Continue would continue another one. What the user changed since
the training started is undone as usual.
"""

from typing import Any

import bpy

from .properties import SwagScene, swag_of

FIELDS = ("scene_folder", "found", "run_folder", "forecast")
USERS_CHOICE = "choice"
"""Property of a line of the plan that is the user's, not the engine's."""

_trained: dict[int, dict[str, Any]] = {}
"""Values of each scene, by its session_uid, when its last training started."""
_before: dict[int, dict[str, Any]] = {}
"""Values of each scene before the undo that is under way."""


def keep(scene: bpy.types.Scene) -> None:
    """Keep the present values of a scene through undo; for the start of a training."""
    _trained[scene.session_uid] = _values(swag_of(scene))


def _values(swag: SwagScene) -> dict[str, Any]:
    return {name: getattr(swag, name) for name in FIELDS} | {"plan": _read(swag.plan)}


def _read(group: bpy.types.PropertyGroup) -> dict[str, Any]:
    """The values of a property group; those of its collections as lists of such."""
    values = {}
    for prop in group.bl_rna.properties:
        if prop.type == "COLLECTION":
            values[prop.identifier] = [_read(one) for one in getattr(group, prop.identifier)]
        elif prop.type != "POINTER" and not prop.is_readonly:
            values[prop.identifier] = getattr(group, prop.identifier)
    return values


def _write(group: bpy.types.PropertyGroup, values: dict[str, Any]) -> None:
    """Write what `_read` gives."""
    for name, value in values.items():
        if isinstance(value, list):
            collection = getattr(group, name)
            collection.clear()
            for one in value:
                _write(collection.add(), one)
        else:
            setattr(group, name, value)


def _decisions(values: dict[str, Any]) -> list[dict[str, Any]]:
    """The plan without the user's choices."""
    return [{name: line[name] for name in line if name != USERS_CHOICE} for line in values["plan"]["lines"]]


@bpy.app.handlers.persistent
def _before_undo(*_: object) -> None:
    _before.clear()
    for scene in bpy.data.scenes:
        if scene.session_uid in _trained:
            _before[scene.session_uid] = _values(swag_of(scene))


@bpy.app.handlers.persistent
def _after_undo(*_: object) -> None:
    for scene in bpy.data.scenes:
        if before := _before.get(scene.session_uid):
            _write_back(swag_of(scene), before, _trained[scene.session_uid])


def _write_back(swag: SwagScene, before: dict[str, Any], trained: dict[str, Any]) -> None:
    """Write the values before an undo that are still those of the training, where the undo changed them."""
    now = _values(swag)
    for name in FIELDS:
        if before[name] == trained[name] != now[name]:
            setattr(swag, name, before[name])
    if _decisions(before) == _decisions(trained) != _decisions(now):
        _write(swag.plan, before["plan"])


_HANDLERS = (
    ("undo_pre", _before_undo),
    ("redo_pre", _before_undo),
    ("undo_post", _after_undo),
    ("redo_post", _after_undo),
)


def register() -> None:
    """Follow undo and redo."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Undo `register`."""
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
