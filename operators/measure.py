"""Measure the distance between points of the splats."""

from ..swag_blender.point_tools import MeasureTool


class SWAG_OT_measure(MeasureTool):
    """Click two points of the splats to see their distance in the scene's unit"""

    bl_idname = "swag.measure"
    bl_label = "Measure"


CLASSES = (SWAG_OT_measure,)
