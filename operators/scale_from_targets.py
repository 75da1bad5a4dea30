"""Scale a scene to metres by coded targets in its photos."""

from typing import Annotated, Any

import bpy
from bpy.props import EnumProperty, FloatProperty

from ..swag_blender import scale
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.job import Job, can_run_engine
from ..swag_blender.scale_panel import FAMILY_ITEMS


@with_properties
class SWAG_OT_scale_from_targets(Job):
    """Find coded targets (ArUco, AprilTag) of known size in the photos, and scale the scene to metres by them"""

    bl_idname = "swag.scale_from_targets"
    bl_label = "Scale from Targets"
    job = scale.JOB

    family: Annotated[
        str, EnumProperty(name="Targets", description="Family that the targets belong to", items=FAMILY_ITEMS)
    ]
    size: Annotated[
        float,
        FloatProperty(
            name="Edge Length (m)",
            description="Length of an edge of the black square of a target, in metres",
            default=0.15,
            min=0.001,
            max=100.0,
            precision=4,
            step=1,
        ),
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a scene is imported, the engine is there, and the job may start."""
        return scale.has_scene(cls, context) and can_run_engine(cls, context, scale.scene_folder(context))

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for the targets."""
        return present(context.window_manager).invoke_props_dialog(self)

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request to look for the targets."""
        self._scene = present(context.scene).name
        return scale.targets_request(context, self.family, self.size)

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Scale the scene."""
        return scale.take_scale(self._scene, event)


CLASSES = (SWAG_OT_scale_from_targets,)
