"""Plan which effects a training should model."""

from typing import Any

import bpy

from ..swag_blender.job import SceneJob, can_work_on_photos
from ..swag_blender.properties import SwagScene, swag_of


class SWAG_OT_plan(SceneJob):
    """Analyse the photos and list which effects training should model, with evidence and cost"""

    bl_idname = "swag.plan"
    bl_label = "Plan Effects"
    job = "Plan"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether photos are chosen, the engine is there and no job writes to their folder."""
        return can_work_on_photos(cls, context, swag_of(context.scene).scene_path)

    def question(self, swag: SwagScene) -> dict[str, Any]:
        """The request for a plan."""
        return {"request": "plan"}

    def take(self, swag: SwagScene, event: dict[str, Any]) -> str:
        """Show the plan."""
        swag.plan.take(event["plan"], swag.scene_path)
        on = [line.title for line in swag.plan.lines if line.state == "on"]
        return f"Effects to model: {', '.join(on).lower() or 'none'}."


CLASSES = (SWAG_OT_plan,)
