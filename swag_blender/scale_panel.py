"""The panel that scales an imported scene to metres."""

import bpy

from ..swag_engine.georeference.families import FAMILIES
from ..swag_engine.scene.georeference import describe_scale
from . import scale, scene_import
from .blender_types import present
from .georeference import georeference_of
from .properties import status_of
from .sidebar import SwagPanel, draw_job, draw_outcome, draw_wrapped

FAMILY_ITEMS = [(family, family, text) for family, text in FAMILIES.items()]
"""Families of coded targets for a menu, under the names that are printed on the sheets."""


class SWAG_PT_scale(SwagPanel):
    """Panel that scales the scene by targets, points or objects."""

    bl_label = "Scale"
    bl_parent_id = "SWAG_PT_scene"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is something to scale, or its targets are looked for."""
        return scale.scaled_object(context) is not None or status_of(context).find(scale.JOB) is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, width = present(self.layout), present(context.region).width
        if draw_job(layout, context, scale.JOB):
            return
        obj = scale.scaled_object(context)
        measured = georeference_of(scene_import.find_root(obj))
        metres = scale.metres_per_unit(obj) if obj else 0.0
        if measured and abs(metres / measured.metres_per_unit - 1) < 1e-6:
            draw_wrapped(layout, describe_scale(measured.to_json()), width, icon="CHECKMARK")
            for note in measured.notes:
                draw_wrapped(layout, note, width, icon="INFO")
        elif metres:
            layout.label(text=f"1 unit = {metres:.5g} m", icon="CHECKMARK")
        else:
            translate = bpy.app.translations.pgettext_iface
            unknown = translate("The length of a unit is not known.")
            root = scene_import.find_root(obj)
            if root and abs((factor := root.matrix_world.median_scale) - 1) > 1e-3:
                larger = translate("The scene is shown {factor} times as large as its coordinates.")
                unknown += " " + larger.format(factor=f"{factor:.3g}")
            draw_wrapped(layout, unknown, width, icon="INFO")
        layout.operator("swag.scale_from_targets", icon="TEXTURE")
        row = layout.row(align=True)
        row.operator("swag.pick_scale", icon="EYEDROPPER")
        row.operator("swag.set_scale", text="From Selection", icon="CON_DISTLIMIT")
        draw_outcome(layout, context, scale.JOB, only_failed=True)


register, unregister = bpy.utils.register_classes_factory((SWAG_PT_scale,))
