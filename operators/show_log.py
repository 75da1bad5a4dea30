"""Show what the engine wrote while it worked."""

import bpy

from ..swag_blender import job

NAME = "SWAG Log"


class SWAG_OT_show_log(bpy.types.Operator):
    """Open the engine's log of the last job in a text editor"""

    bl_idname = "swag.show_log"
    bl_label = "Show Log"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("No job has written a log yet")
        return bool(job.last_log)

    def execute(self, context: bpy.types.Context) -> set[str]:
        text = bpy.data.texts.get(NAME) or bpy.data.texts.new(NAME)
        text.from_string("\n".join(job.last_log) + "\n")
        if bpy.app.background:
            print(text.as_string())
            return {"FINISHED"}
        areas = (area for window in context.window_manager.windows for area in window.screen.areas)
        area = next((area for area in areas if area.type == "TEXT_EDITOR"), None)
        if area is None:
            bpy.ops.wm.window_new()
            area = context.window_manager.windows[-1].screen.areas[0]
            area.type = "TEXT_EDITOR"
        area.spaces.active.text = text
        return {"FINISHED"}


CLASSES = (SWAG_OT_show_log,)
