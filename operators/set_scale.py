"""Scale a scene to metres by a known distance."""

from collections.abc import Sequence
from typing import Annotated

import bpy
from bpy.props import FloatProperty, FloatVectorProperty
from mathutils import Vector

from ..swag_blender import scale
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.operator_base import ReportingOperator


@with_properties
class SWAG_OT_set_scale(ReportingOperator):
    """Scale the scene by the distance between two selected objects, such as cameras, or two points"""

    bl_idname = "swag.set_scale"
    bl_label = "Set Scale"
    bl_options = {"REGISTER", "UNDO"}

    distance: Annotated[
        float,
        FloatProperty(
            name="Distance",
            description="Distance between the two after scaling",
            default=1.0,
            min=1e-6,
            subtype="DISTANCE",
            options={"SKIP_SAVE"},
        ),
    ]
    start: Annotated[Sequence[float], FloatVectorProperty(name="From", size=3, options={"HIDDEN", "SKIP_SAVE"})]
    end: Annotated[Sequence[float], FloatVectorProperty(name="To", size=3, options={"HIDDEN", "SKIP_SAVE"})]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether it is clear what to scale."""
        return scale.can_scale(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for the distance, beginning with the present one."""
        length = scale.distance_between(self._ends(context))
        if not length:
            self.report({"ERROR"}, scale.SELECT_TWO)
            return {"CANCELLED"}
        if not self.properties.is_property_set("distance"):
            self.distance = length
        return present(context.window_manager).invoke_props_dialog(self)

    def work(self, context: bpy.types.Context) -> str:
        """Scale."""
        metres = scale.scale_to_distance(context, self._ends(context), self.distance)
        return f"One unit of the COLMAP scene is {metres:.4g} m."

    def _ends(self, context: bpy.types.Context) -> list[Vector]:
        """The two points, or the places of the selected objects without them."""
        if self.properties.is_property_set("start"):
            return [Vector(self.start), Vector(self.end)]
        return scale.selected_ends(context)


CLASSES = (SWAG_OT_set_scale,)
