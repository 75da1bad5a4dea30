"""The panel Film: camera moves, what is rendered and where to, and the film while it is rendered."""

import bpy

from . import scene_import
from .blender_types import present
from .film import film_of
from .sidebar import SwagPanel, draw_job, draw_outcome


class SWAG_PT_film(SwagPanel):
    """Panel that moves a camera and renders films."""

    bl_label = "Film"
    bl_order = 35
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, scene = present(self.layout), present(context.scene)
        if draw_job(layout, context, "Film"):
            return
        column = layout.column(align=True)
        column.operator("swag.add_turntable", icon="FILE_REFRESH")
        column.operator("swag.camera_path", icon="CON_FOLLOWPATH")
        if scene_import.roots(scene):
            column.operator("swag.compare_photos", icon="IMAGE_DATA")
        layout.operator("swag.prepare_render", icon="RESTRICT_RENDER_OFF")

        layout.use_property_split = True
        layout.use_property_decorate = False
        film, render = film_of(scene), scene.render
        layout.prop(scene, "camera")
        column = layout.column(align=True)
        column.prop(render, "resolution_x")
        column.prop(render, "resolution_y", text="Y")
        column.prop(render, "resolution_percentage", text="%")
        column = layout.column(align=True)
        column.prop(scene, "frame_start")
        column.prop(scene, "frame_end")
        column.prop(film, "kind")
        if film.kind == "VIDEO":
            column.prop(render, "fps")
        column = layout.column(align=True)
        column.prop(render, "film_transparent", text="Alpha")
        column.prop(film, "depth")
        column.prop(render, "use_overwrite", text="Overwrite")
        layout.prop(film, "output")
        row = layout.row()
        row.scale_y = 1.4
        row.operator("swag.render_film", icon="RENDER_ANIMATION")
        draw_outcome(layout, context, "Film")


register, unregister = bpy.utils.register_classes_factory((SWAG_PT_film,))
