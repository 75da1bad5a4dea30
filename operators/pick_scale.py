"""Pick two points of the splats whose distance is known, and scale the scene by it."""

import bpy
from mathutils import Vector

from ..swag_blender import scale
from ..swag_blender.blender_types import OperatorResult, call_operator, present
from ..swag_blender.picking import splat_at


class SWAG_OT_pick_scale(bpy.types.Operator):
    """Click two points of the splats whose distance you know; the scene is then scaled by it"""

    bl_idname = "swag.pick_scale"
    bl_label = "Pick Two Points"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the scene can be scaled, from a 3D viewport."""
        in_viewport = context.area is not None and context.area.type == "VIEW_3D"
        return scale.can_scale(cls, context) and in_viewport

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Wait for two clicks."""
        self._picked: list[Vector] = []
        present(context.window_manager).modal_handler_add(self)
        present(context.window).cursor_modal_set("EYEDROPPER")
        self._show_step(context)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Handle clicks and Escape; Blender calls this for every event."""
        if event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            return self._end(context, {"CANCELLED"})
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"PASS_THROUGH"}
        region = next(region for region in present(context.area).regions if region.type == "WINDOW")
        point = splat_at(context, region, (event.mouse_x - region.x, event.mouse_y - region.y))
        if point is None:
            self.report({"WARNING"}, "There is no splat here.")
            return {"RUNNING_MODAL"}
        self._picked.append(point)
        present(context.scene).cursor.location = point  # shows what was picked
        self._show_step(context)
        if len(self._picked) < 2:
            return {"RUNNING_MODAL"}
        call_operator("set_scale", "INVOKE_DEFAULT", start=self._picked[0], end=self._picked[1])
        return self._end(context, {"FINISHED"})

    def cancel(self, context: bpy.types.Context) -> None:
        """End; Blender calls this when it removes the operator."""
        self._end(context, set())

    def _show_step(self, context: bpy.types.Context) -> None:
        step = ("first", "second", "second")[len(self._picked)]
        present(context.workspace).status_text_set(
            f"Click the {step} of two points whose distance you know; Escape: cancel"
        )

    def _end(self, context: bpy.types.Context, result: OperatorResult) -> OperatorResult:
        present(context.workspace).status_text_set(None)
        present(context.window).cursor_modal_restore()
        return result


CLASSES = (SWAG_OT_pick_scale,)
