"""Ask the photographs which effects a training should simulate."""

from typing import Any

import bpy

from ..swag_blender.job import SceneJob


class SWAG_OT_plan(SceneJob, bpy.types.Operator):
    """Look at the photographs and list which effects they call for, why, and what each would cost"""

    bl_idname = "swag.plan"
    bl_label = "Plan Effects"
    bl_options = {"REGISTER", "UNDO"}
    job = "Plan"

    def question(self, swag: bpy.types.PropertyGroup) -> dict[str, Any]:
        return {"request": "plan"}

    def take(self, swag: bpy.types.PropertyGroup, event: dict[str, Any]) -> str:
        swag.plan.take(event["plan"])
        on = [line.title for line in swag.plan.lines if line.state == "on"]
        return f"The photographs call for: {', '.join(on).lower() or 'no effect'}."


class SWAG_OT_reset_effects(bpy.types.Operator):
    """Follow the plan in every line again"""

    bl_idname = "swag.reset_effects"
    bl_label = "Follow Plan"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Nothing differs from the plan")
        return bool(context.scene.swag.plan.switches())

    def execute(self, context: bpy.types.Context) -> set[str]:
        for line in context.scene.swag.plan.lines:
            line.choice = "PLAN"
        return {"FINISHED"}


CLASSES = (SWAG_OT_plan, SWAG_OT_reset_effects)
