"""The panel Maps: orthomosaic, heights, areas, profile and change of the active splats, and what was measured."""

import json

import bpy

from . import maps, splats
from .blender_types import present, set_button
from .sidebar import SwagPanel, draw_job, draw_outcome, draw_wrapped


class SWAG_PT_maps(SwagPanel):
    """Panel that makes maps and measurements."""

    bl_label = "Maps"
    bl_order = 55
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, obj = present(self.layout), context.active_object
        width = present(context.region).width
        if draw_job(layout, context, maps.JOB):
            return
        if not splats.is_splats(obj):
            draw_wrapped(layout, "Select an object with splats first.", width, icon="INFO")
            return
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = maps.maps_of(present(context.scene))
        column = layout.column(align=True)
        column.prop(settings, "plane")
        column.prop(settings, "pixel")
        column.prop(settings, "output")
        column = layout.column(align=True)
        column.operator("swag.make_orthomosaic", icon="IMAGE_DATA")
        column.prop(settings, "taglab")
        column = layout.column(align=True)
        column.operator("swag.make_heights", icon="RNDCURVE")
        column.prop(settings, "derived")
        column = layout.column(align=True)
        column.operator("swag.make_areas", icon="MESH_GRID")
        column.prop(settings, "corrected")
        layout.operator("swag.pick_profile", icon="IPO_LINEAR")
        column = layout.column(align=True)
        column.operator("swag.make_change", icon="MOD_TIME")
        column.prop(settings, "later")
        column.prop(settings, "free_scale")
        draw_outcome(layout, context, maps.JOB)


class SWAG_PT_made_maps(SwagPanel):
    """Panel that lists the maps of the active splats with what was measured."""

    bl_label = "Made Maps"
    bl_parent_id = "SWAG_PT_maps"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active splats have maps."""
        return bool(maps.shown_maps(context.active_object))

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout = present(self.layout)
        for shown in maps.shown_maps(context.active_object):
            row = layout.row(align=True)
            row.label(text=maps.TITLES[shown[maps.MAP_KEY]])
            set_button(row.operator("wm.path_open", text="", icon="FILE_FOLDER"), filepath=shown[maps.FILE_KEY])
            row.prop(shown, "hide_viewport", text="", emboss=False)
            table = layout.column(align=True)
            table.scale_y = 0.8
            for line in json.loads(shown[maps.LINES_KEY]):
                cells = table.row()
                for text in line:
                    cells.label(text=text, translate=False)


register, unregister = bpy.utils.register_classes_factory((SWAG_PT_maps, SWAG_PT_made_maps))
