"""Scale a scene to metres by a known distance."""

from collections.abc import Sequence
from typing import Annotated

import bpy
from bpy.props import FloatProperty, FloatVectorProperty

from ..swag_blender import scale
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.operator_base import ReportingOperator


@with_properties
class SWAG_OT_set_scale(ReportingOperator):
    """Scale the scene to metres by the distance between two selected objects, such as cameras, or two points"""

    bl_idname = "swag.set_scale"
    bl_label = "Set Scale"
    bl_options = {"REGISTER", "UNDO"}

    distance: Annotated[
        float,
        FloatProperty(
            name="Distance",
            description="Distance between the two, in metres",
            default=1.0,
            min=1e-4,
            soft_max=100,
            precision=3,
        ),
    ]
    start: Annotated[Sequence[float], FloatVectorProperty(name="From", size=3, options={"HIDDEN", "SKIP_SAVE"})]
    end: Annotated[Sequence[float], FloatVectorProperty(name="To", size=3, options={"HIDDEN", "SKIP_SAVE"})]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether it is clear what to scale."""
        if scale.scaled_object(context) is None:
            cls.poll_message_set("Import a scene or open splats; where there are several, select one of them")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for the distance."""
        return present(context.window_manager).invoke_props_dialog(self)

    def work(self, context: bpy.types.Context) -> str:
        """Scale by the two points, or by the selected objects without them."""
        if self.properties.is_property_set("start"):
            metres = scale.scale_to_distance(context, self.start, self.end, self.distance)
        else:
            metres = scale.scale_by_selection(context, self.distance)
        return f"One unit of the COLMAP scene is {metres:.4g} m; a Blender unit is a metre now."


CLASSES = (SWAG_OT_set_scale,)
