"""Labels of a splat object in panels: the list, the search, the choices of labelling."""

from typing import Any

import bpy

from . import splats
from .blender_types import set_button
from .labels import SIMILARITY, labels_of


def draw_labels(layout: bpy.types.UILayout, obj: bpy.types.Object) -> None:
    """Draw the label list of a splat object with its buttons and the search."""
    own = labels_of(obj)
    if not own.entries:
        layout.operator("swag.read_labels", icon="FILE_REFRESH")
        return
    row = layout.row()
    row.template_list("SWAG_UL_labels", "", own, "entries", own, "active", rows=4)
    column = row.column(align=True)
    column.operator("swag.read_labels", text="", icon="FILE_REFRESH")
    column.operator("swag.show_labels", text="", icon="HIDE_OFF")
    column.prop(own, "tinted", text="", icon="COLOR")
    row = layout.row(align=True)
    row.prop(own, "words", text="", icon="VIEWZOOM")
    row.operator("swag.search_labels", text="Search")
    row = layout.row()
    row.enabled = SIMILARITY in splats.pointcloud_of(obj).attributes
    row.prop(own, "threshold", slider=True)
    row = layout.row(align=True)
    row.operator("swag.keep_mask", text="Mask")
    row.operator("swag.separate_splats", text="Separate")
    row.operator("swag.merge_splats", text="Merge")


def draw_labelling(layout: bpy.types.UILayout, obj: bpy.types.Object) -> None:
    """Draw the choices of labelling and the button that starts it."""
    own = labels_of(obj)
    layout.prop(own, "source")
    if own.source == "WORDS":
        layout.prop(own, "wanted")
        layout.prop(own, "download")
    elif own.source == "MASKS":
        layout.prop(own, "masks")
    button = layout.operator("swag.label_run", icon="BOOKMARKS")
    set_button(button, source=own.source, words=own.wanted, masks=own.masks, download=own.download)


class SWAG_UL_labels(bpy.types.UIList):
    """List of labels: color, name, number of splats, buttons."""

    def draw_item(
        self,
        context: bpy.types.Context | None,
        layout: bpy.types.UILayout,
        data: Any,
        item: Any,
        icon: int | None,
        active_data: Any,
        active_property: str | None,
        index: int | None,
        flt_flag: int | None,
    ) -> None:
        """Draw one label; Blender calls this."""
        row = layout.row(align=True)
        swatch = row.row()
        swatch.ui_units_x = 0.8
        swatch.prop(item, "color", text="")
        row.prop(item, "name", text="", emboss=False)
        count = row.row()
        count.alignment = "RIGHT"
        count.label(text=f"{item.count}")
        button = row.operator("swag.select_label", text="", icon="RESTRICT_SELECT_OFF", emboss=False)
        set_button(button, number=item.number)
        button = row.operator("swag.isolate_label", text="", icon="ZOOM_SELECTED", emboss=False)
        set_button(button, number=item.number)
        row.prop(item, "visible", text="", icon="HIDE_OFF" if item.visible else "HIDE_ON", emboss=False)


register, unregister = bpy.utils.register_classes_factory((SWAG_UL_labels,))
