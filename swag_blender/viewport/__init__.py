"""Splats in 3D viewports: the handlers that draw them and keep their textures up to date."""

import traceback
from typing import Any

import bpy

from ..blender_types import present
from ..nodes import splat_preview
from .drawing import TICK_SECONDS, ViewportDrawing
from .placements import drawn_objects, is_drawn

_drawing: ViewportDrawing | None = None
"""The ViewportDrawing, made when splats are drawn for the first time; None before, and after all splats are gone."""
_handler: Any = None
_shapes_shown = False
_failed = False


def drawing() -> ViewportDrawing | None:
    """What draws, for measurements and tests; None where nothing has been drawn."""
    return _drawing


def _draw() -> None:
    """Draw the splats of the viewport's scene; Blender calls this after it has drawn the viewport's objects."""
    global _drawing, _failed
    context = bpy.context
    _follow_rendered_shading()
    objects = drawn_objects(present(context.view_layer))
    if not objects and not any(map(is_drawn, bpy.data.objects)):
        _drawing = None
    if not objects or _is_rendered(present(context.area)) or _failed:
        return
    try:
        if _drawing is None:
            _drawing = ViewportDrawing()
        _drawing.draw(context, objects)
    except Exception:
        # Blender would print the same error at each redraw.
        _failed = True
        traceback.print_exc()
        return
    if _drawing.is_waiting() and not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=TICK_SECONDS)


def _tick() -> float | None:
    if _drawing is None or not _drawing.is_waiting():
        return None
    _drawing.tag_redraws()
    return TICK_SECONDS


def _follow_rendered_shading() -> None:
    """Have the nodes give viewports what renders draw while one is in Rendered shading, and only then."""
    windows = present(bpy.context.window_manager).windows
    rendered = any(_is_rendered(area) for window in windows for area in window.screen.areas)
    if rendered != _shapes_shown and not bpy.app.timers.is_registered(_switch_shapes):
        # Nothing may be changed while Blender draws.
        bpy.app.timers.register(_switch_shapes, first_interval=0.0)


def _is_rendered(area: bpy.types.Area) -> bool:
    """Whether an area is a 3D viewport in Rendered shading."""
    space = area.spaces.active
    return isinstance(space, bpy.types.SpaceView3D) and space.shading.type == "RENDERED"


def _switch_shapes() -> None:
    global _shapes_shown
    _shapes_shown = not _shapes_shown
    for obj in bpy.data.objects:
        if is_drawn(obj):
            splat_preview.set_input(obj, splat_preview.RENDERED_IN_VIEWPORT, _shapes_shown)


@bpy.app.handlers.persistent
def _after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if _drawing is not None:
        for update in depsgraph.updates:
            if update.is_updated_geometry:
                changed: Any = update.id
                _drawing.store.mark_stale(changed.original.session_uid)


@bpy.app.handlers.persistent
def _after_undo(*_: object) -> None:
    if _drawing is not None:
        _drawing.store.mark_stale(None)


@bpy.app.handlers.persistent
def _before_load(*_: object) -> None:
    global _drawing, _shapes_shown
    _drawing, _shapes_shown = None, False


@bpy.app.handlers.persistent
def _after_load(*_: object) -> None:
    # A file may have been saved with a viewport in Rendered shading.
    for obj in bpy.data.objects:
        if is_drawn(obj):
            splat_preview.set_input(obj, splat_preview.RENDERED_IN_VIEWPORT, False)


_HANDLERS = (
    ("depsgraph_update_post", _after_update),
    ("undo_post", _after_undo),
    ("redo_post", _after_undo),
    ("load_pre", _before_load),
    ("load_post", _after_load),
)


def register() -> None:
    """Draw from now on; there are no viewports without a window."""
    global _handler
    if bpy.app.background:
        return
    _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")
    for name, function in _HANDLERS:
        getattr(bpy.app.handlers, name).append(function)


def unregister() -> None:
    """Undo `register`."""
    global _handler, _drawing, _failed
    if _handler is None:
        return
    for name, function in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(function)
    for timer in (_tick, _switch_shapes):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
    _handler, _drawing, _failed = None, None, False
