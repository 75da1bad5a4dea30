"""Splat objects of files that another version of Blender or of the extension saved: shown as in this version.

What Blender 4.5 or 5.2 saved with own shapes becomes native in 5.3, and the other way round. With a window this happens
just after the file is open, as a step that undo takes back, and a message says it.
"""

from typing import Any, cast

import bpy
from bpy.app.translations import pgettext_iface

from . import display, splats, water
from .blender_types import present
from .nodes import splat_preview
from .sidebar import show_popup


def update(obj: bpy.types.Object) -> bool:
    """Show a splat object with the nodes of this version; returns whether Blender draws it natively from now on."""
    modifier = splat_preview.modifier_of(obj)
    if modifier is None or obj.library is not None or present(obj.data).library is not None:
        return False
    shapes = bool(splat_preview.read_inputs(obj).get(splat_preview.BLEND_DISPLAY)) or (
        splat_preview.HAS_NATIVE and splat_preview.has_current_nodes(obj) and not splat_preview.is_native(obj)
    )
    if splat_preview.use_shapes(obj, shapes):
        # Drivers name an input by a number that earlier versions gave to others.
        water.follow_slider(obj)
        display.update_crop(obj)
    became = splat_preview.HAS_NATIVE and not shapes and cast(Any, obj.data).type != "GAUSSIAN_SPLAT"
    splats.fit_to_version(splats.pointcloud_of(obj))
    display.apply(obj)
    return became


def update_all() -> list[str]:
    """Update all splat objects of the file; returns what to tell the user, in sentences."""
    native = [obj.name for obj in bpy.data.objects if splats.is_splats(obj) and update(obj)]
    without_colors = [obj.name for obj in bpy.data.objects if splats.lacks_colors(obj)]
    now_native = pgettext_iface(
        "Blender now draws these splats itself: {names}. Undo brings back the earlier nodes; Exact Shapes in the panel "
        "Display draws them as before."
    )
    no_colors = pgettext_iface(
        "Blender 5.3 or later saved these splats, and this version of Blender cannot read their colors: {names}. Open "
        "the file in Blender 5.2 or later, or export the splats there as PLY."
    )
    told = [(now_native, native), (no_colors, without_colors)]
    return [sentence.format(names=", ".join(names)) for sentence, names in told if names]


@bpy.app.handlers.persistent
def _after_load(*_: object) -> None:
    if bpy.app.background:
        for sentence in update_all():
            print(sentence)
    else:
        # Blender takes the state that undo goes back to when all handlers have run.
        bpy.app.timers.register(_update_in_window, first_interval=0.0)


def _update_in_window() -> None:
    windows = present(bpy.context.window_manager).windows
    told = update_all()
    if not told or not windows:
        return
    with bpy.context.temp_override(window=windows[0]):
        bpy.ops.ed.undo_push(message="Update Splats")
    show_popup(told, "INFO")


def register() -> None:
    """Update files from now on."""
    bpy.app.handlers.load_post.append(_after_load)


def unregister() -> None:
    """Undo `register`."""
    bpy.app.handlers.load_post.remove(_after_load)
    if bpy.app.timers.is_registered(_update_in_window):
        bpy.app.timers.unregister(_update_in_window)
