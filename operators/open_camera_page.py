"""Open the page about the cameras of the photos."""

import bpy

from ..swag_blender import find_cameras
from ..swag_blender.operator_base import ReportingOperator


class SWAG_OT_open_camera_page(ReportingOperator):
    """Open the report of the cameras in the web browser: their path, the points that photos share, doubtful places"""

    bl_idname = "swag.open_camera_page"
    bl_label = "Open Camera Report"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the chosen photos have a page."""
        if find_cameras.camera_page(context) is None:
            cls.poll_message_set("The chosen photos have no camera report: Find Cameras writes it")
            return False
        return True

    def work(self, context: bpy.types.Context) -> str:
        """Open the page."""
        find_cameras.open_camera_page(context)
        return ""


CLASSES = (SWAG_OT_open_camera_page,)
