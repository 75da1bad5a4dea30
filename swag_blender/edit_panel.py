"""The panel Edit: selecting, hiding, deleting, cropping and measuring splats."""

from typing import Annotated, Any, cast

import bpy
from bpy.props import BoolProperty, PointerProperty
from bpy.types import PropertyGroup

from . import labels, splats
from .blender_types import present, set_button, with_properties
from .clean_up import draw_clean_up, draw_score, proposed_objects
from .sidebar import SwagPanel
from .similar_splats import KINDS
from .splat_selection import edited_objects, selected_count


@with_properties
class SwagEdit(PropertyGroup):
    """`scene.swag_edit`: how the tools of the panel select."""

    through: Annotated[
        bool,
        BoolProperty(
            name="Select Through",
            description="Select splats behind others too; most of what is seen has splats behind it",
            default=True,
        ),
    ]


class SWAG_PT_edit(SwagPanel):
    """Panel that selects and edits splats."""

    bl_label = "Edit"
    bl_order = 30
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether splats are selected, or the box that crops them."""
        return bool(edited_objects(context))

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, settings = present(self.layout), cast(Any, context.scene).swag_edit
        objects = edited_objects(context)
        total = sum(splats.count(obj) for obj in objects)
        text = bpy.app.translations.pgettext_iface("{selected} of {total} splats selected")
        draw_clean_up(layout, context)
        layout.label(text=text.format(selected=sum(map(selected_count, objects)), total=total))
        column = layout.column(align=True)
        row = column.row(align=True)
        set_button(row.operator("swag.select_box", text="Box"), through=settings.through)
        set_button(row.operator("swag.select_circle", text="Circle"), through=settings.through)
        set_button(row.operator("swag.select_lasso", text="Lasso"), through=settings.through)
        row = column.row(align=True)
        set_button(row.operator("swag.select_brush", text="Brush"), through=settings.through)
        row.operator("swag.select_sphere", text="Sphere")
        row.operator("swag.select_flood", text="Flood")
        row = layout.row(align=True)
        for action, label in (("SELECT", "All"), ("DESELECT", "None"), ("INVERT", "Invert")):
            set_button(row.operator("swag.select_all_splats", text=label), action=action)
        layout.prop(settings, "through")
        layout.label(text="Select By")
        grid = layout.grid_flow(row_major=True, columns=2, even_columns=True, align=True)
        for kind, label, _ in KINDS:
            set_button(grid.operator("swag.select_by", text=label), kind=kind)
        column = layout.column(align=True)
        column.operator("swag.find_floaters", icon="VIEWZOOM")
        if not proposed_objects(context):  # there it stands above
            draw_score(column, context)
        layout.operator("swag.delete_splats", text="Delete", icon="TRASH")
        row = layout.row(align=True)
        set_button(row.operator("swag.hide_splats", text="Hide", icon="HIDE_ON"), unselected=False)
        set_button(row.operator("swag.hide_splats", text="Hide Others"), unselected=True)
        row = layout.row()
        row.enabled = any(labels.MASKED in splats.pointcloud_of(obj).attributes for obj in objects)
        row.operator("swag.reveal_splats", icon="HIDE_OFF")


class SWAG_PT_crop(SwagPanel):
    """Panel of the crop box."""

    bl_label = "Crop Box"
    bl_parent_id = "SWAG_PT_edit"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, objects = present(self.layout), edited_objects(context)
        layout.operator("swag.add_crop_box", icon="MESH_CUBE")
        if objects:
            layout.prop(cast(Any, objects[0]).swag_display, "crop", text="")
        layout.operator("swag.delete_outside_crop")


class SWAG_PT_measure(SwagPanel):
    """Panel of the tools that read splats."""

    bl_label = "Measure"
    bl_parent_id = "SWAG_PT_edit"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        row = present(self.layout).row(align=True)
        row.operator("swag.measure", icon="DRIVER_DISTANCE")
        row.operator("swag.read_point", icon="EYEDROPPER")


_CLASSES = (SwagEdit, SWAG_PT_edit, SWAG_PT_crop, SWAG_PT_measure)


def register() -> None:
    """Register the panels and give every scene the settings of the tools."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    cast(Any, bpy.types.Scene).swag_edit = PointerProperty(type=SwagEdit)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.Scene).swag_edit
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
