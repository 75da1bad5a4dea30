"""Forecast time, quality and memory of each preset before a training."""

from typing import Any

from ..swag_blender.job import SceneJob
from ..swag_blender.properties import SwagScene


class SWAG_OT_forecast(SceneJob):
    """Train for some seconds and forecast the time, PSNR and memory of each quality on this machine"""

    bl_idname = "swag.forecast"
    bl_label = "Forecast"
    job = "Forecast"
    heavy = True  # it measures the time of this machine

    def question(self, swag: SwagScene) -> dict[str, Any]:
        """The request with the scene's settings."""
        settings = swag.train_settings()
        self._asked, self._sized_by = swag.forecast_question(), swag.sized_by(settings)
        return {"request": "forecast", "settings": settings}

    def take(self, swag: SwagScene, event: dict[str, Any]) -> str:
        """Store the forecast with the scene."""
        swag.keep_forecast(self._asked, event["presets"])
        swag.keep_sizes(self._sized_by, event["sizes"])
        return "; ".join(" ".join(line) for line in swag.forecast_lines())


CLASSES = (SWAG_OT_forecast,)
