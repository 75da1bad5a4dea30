"""Step through the photos with a wipe between photo and splats."""

import bpy

from ..swag_blender.blender_types import OperatorResult, present
from ..swag_blender.photo_wipe import PhotoWipe, photos, stop


class SWAG_OT_compare_photos(bpy.types.Operator):
    """Step through the photos in the camera view, with the photo left of a line that you drag and the splats right"""

    bl_idname = "swag.compare_photos"
    bl_label = "Compare with Photos"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there are photos, in a window's 3D viewport."""
        if bpy.app.background or context.area is None or context.area.type != "VIEW_3D":
            cls.poll_message_set("Photos are compared in a 3D viewport")
            return False
        if not photos(present(context.scene)):
            cls.poll_message_set("Import the scene with the photos first")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Show the first photo; Blender calls this for buttons."""
        self._wipe = PhotoWipe(context)
        present(context.window_manager).modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Move the line, show other photos or end; Blender calls this for every event."""
        return self._wipe.handle(event)

    def cancel(self, context: bpy.types.Context) -> None:
        """End the comparison; Blender calls this when another file is opened or the window closes."""
        self._wipe.end()


CLASSES = (SWAG_OT_compare_photos,)


def unregister() -> None:
    """End a comparison: its draw handler must not outlive the extension."""
    stop()
