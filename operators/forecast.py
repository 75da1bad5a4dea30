"""Ask what each quality would take here, before a training begins."""

from typing import Any

import bpy

from ..swag_blender.engine_process import Engine, EngineError
from ..swag_blender.job import Job


class SWAG_OT_forecast(Job, bpy.types.Operator):
    """Train for some seconds and say what each quality would take on this machine: time, PSNR, memory; Escape stops"""

    bl_idname = "swag.forecast"
    bl_label = "Forecast"
    bl_options = {"REGISTER", "UNDO"}
    job = "Forecast"

    def start(self, context: bpy.types.Context) -> Engine:
        swag = context.scene.swag
        if not swag.scene_folder:
            raise EngineError("Choose the folder with the photographs and their COLMAP model first.")
        self._scene, self._asked = context.scene.name, swag.forecast_question()
        engine = Engine()
        engine.send({"request": "forecast", "scene": swag.scene_path, "settings": swag.train_settings()})
        return engine

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        scene = bpy.data.scenes.get(self._scene)
        if not scene:
            raise EngineError(f"The scene {self._scene} is gone; forecast again.")
        scene.swag.keep_forecast(self._asked, event["presets"])
        return "; ".join(" ".join(line) for line in scene.swag.forecast_lines())


CLASSES = (SWAG_OT_forecast,)
