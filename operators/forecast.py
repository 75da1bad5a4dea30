"""Ask what each quality would take here, before a training begins."""

from typing import Any

import bpy

from ..swag_blender.job import SceneJob


class SWAG_OT_forecast(SceneJob, bpy.types.Operator):
    """Train for some seconds and say what each quality would take on this machine: time, PSNR, memory; Escape stops"""

    bl_idname = "swag.forecast"
    bl_label = "Forecast"
    bl_options = {"REGISTER", "UNDO"}
    job = "Forecast"

    def question(self, swag: bpy.types.PropertyGroup) -> dict[str, Any]:
        self._asked = swag.forecast_question()
        return {"request": "forecast", "settings": swag.train_settings()}

    def take(self, swag: bpy.types.PropertyGroup, event: dict[str, Any]) -> str:
        swag.keep_forecast(self._asked, event["presets"])
        return "; ".join(" ".join(line) for line in swag.forecast_lines())


CLASSES = (SWAG_OT_forecast,)
