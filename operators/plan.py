"""Ask the photographs which effects a training should simulate."""

from typing import Any

import bpy

from ..swag_blender.engine_process import Engine, EngineError
from ..swag_blender.job import Job


class SWAG_OT_plan(Job, bpy.types.Operator):
    """Look at the photographs and list which effects they call for, why, and what each would cost"""

    bl_idname = "swag.plan"
    bl_label = "Plan Effects"
    bl_options = {"REGISTER", "UNDO"}
    job = "Plan"

    def start(self, context: bpy.types.Context) -> Engine:
        swag = context.scene.swag
        if not swag.scene_folder:
            raise EngineError("Choose the folder with the photographs and their COLMAP model first.")
        self._scene = context.scene.name
        engine = Engine()
        engine.send({"request": "plan", "scene": swag.scene_path})
        return engine

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        scene = bpy.data.scenes.get(self._scene)
        if not scene:
            raise EngineError(f"The scene {self._scene} is gone; plan again.")
        scene.swag.plan.take(event["plan"])
        on = [line.title for line in scene.swag.plan.lines if line.state == "on"]
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
