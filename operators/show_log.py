"""Show the engine's log."""

from typing import Annotated, Any

import bpy
from bpy.props import StringProperty

from ..swag_blender import job
from ..swag_blender.blender_types import OperatorResult, present, with_properties

DRAW_SECONDS = 0.1
"""Time after which a text editor that was just opened is drawn and knows how many lines it shows."""


@with_properties
class SWAG_OT_show_log(bpy.types.Operator):
    """Open the engine's log of the last job in a text editor, at its end"""

    bl_idname = "swag.show_log"
    bl_label = "Show Log"

    job: Annotated[
        str,
        StringProperty(
            name="Job", description="Name of the job; empty: the one that ended last", options={"SKIP_SAVE"}
        ),
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a log."""
        if not job.logs:
            cls.poll_message_set("No job has written a log yet")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Show the log."""
        job.show_log(context, self.job)
        if not bpy.app.background:
            bpy.app.timers.register(_scroll_to_end, first_interval=DRAW_SECONDS)
        return {"FINISHED"}


def _scroll_to_end() -> float | None:
    """Let the last lines of the log fill the text editors that show it; a timer's function, called until it can."""
    for window in present(bpy.context.window_manager).windows:
        for area in window.screen.areas:
            editor: Any = area.spaces.active
            if area.type != "TEXT_EDITOR" or editor.text is None or editor.text.name != job.LOG_NAME:
                continue
            if not editor.visible_lines:
                return DRAW_SECONDS
            editor.top = 0
            region = next(region for region in area.regions if region.type == "WINDOW")
            with bpy.context.temp_override(window=window, area=area, region=region):
                bpy.ops.text.move(type="FILE_BOTTOM")
            # Blender moves a cursor that was not visible, here the one behind the last line, to the middle.
            editor.top = max(0, editor.top - editor.visible_lines // 2 + 1)
    return None


CLASSES = (SWAG_OT_show_log,)
