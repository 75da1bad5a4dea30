"""Plan which effects a training should model."""

from typing import Any

from ..swag_blender.job import SceneJob
from ..swag_blender.properties import SwagScene


class SWAG_OT_plan(SceneJob):
    """Analyse the photos and list which effects training should model, with evidence and cost"""

    bl_idname = "swag.plan"
    bl_label = "Plan Effects"
    job = "Plan"

    def question(self, swag: SwagScene) -> dict[str, Any]:
        """The request for a plan."""
        return {"request": "plan"}

    def take(self, swag: SwagScene, event: dict[str, Any]) -> str:
        """Show the plan."""
        swag.plan.take(event["plan"], swag.scene_path)
        on = [line.title for line in swag.plan.lines if line.state == "on"]
        return f"Effects to model: {', '.join(on).lower() or 'none'}."


CLASSES = (SWAG_OT_plan,)
