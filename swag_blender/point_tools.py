"""Tools that read the splats in a 3D viewport: Measure and Read Point."""

import bpy
from mathutils import Vector

from .blender_types import OperatorResult, present
from .lengths import length_text
from .picking import Picker, Reading, splat_objects
from .viewport_tool import Pixel, ViewportTool, view_of


class PointTool(ViewportTool):
    """Tool that works with the splat under the pointer, which it marks."""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Start without a projection."""
        self._picker: Picker | None = None
        self._pictured = b""
        return super().invoke(context, event)

    def pick(self, context: bpy.types.Context, region: bpy.types.Region, position: Pixel) -> Reading | None:
        """The splat at a position of the region; None where there is none."""
        view = view_of(region)
        pictured = view.matrix.tobytes() + bytes(f"{view.width} {view.height}", "ascii")
        if self._picker is None or pictured != self._pictured:
            self._picker, self._pictured = Picker(self.objects(context), view), pictured
        return self._picker.at(position)

    def objects(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """The objects whose splats are found."""
        return splat_objects(context)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the scene shows splats."""
        cls.poll_message_set("Import or train splats first")
        return bool(splat_objects(context))


class MeasureTool(PointTool):
    """Tool that shows the distance between two points that the user clicks; further clicks measure again."""

    hint = "Click two points to measure their distance; Escape: end"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Start without points."""
        self._points: list[Vector] = []
        return super().invoke(context, event)

    def on_event(
        self, context: bpy.types.Context, event: bpy.types.Event, region: bpy.types.Region, position: Pixel
    ) -> OperatorResult:
        """Set a point by a click; the second end follows the pointer until then."""
        clicked = event.type == "LEFTMOUSE" and event.value == "PRESS"
        if not clicked and event.type != "MOUSEMOVE":
            return {"PASS_THROUGH"}
        found = self.pick(context, region, position)
        if clicked and found is None:
            self.report({"WARNING"}, "There is no splat here.")
        elif clicked and found is not None:
            self._points = [*self._points, found.position] if len(self._points) < 2 else [found.position]
            if len(self._points) == 2:
                self.report({"INFO"}, f"Distance: {self._show(context, self._points)}")
        if len(self._points) < 2:
            self._show(context, [*self._points, *([found.position] if found else [])])
        return {"RUNNING_MODAL"}

    def _show(self, context: bpy.types.Context, points: list[Vector]) -> str:
        """Show the points and, for two, their distance, which is returned; "" for fewer."""
        self.overlay.segments, self.overlay.texts = [points], []
        if len(points) < 2:
            return ""
        text = length_text(present(context.scene), (points[1] - points[0]).length)
        self.overlay.texts = [((points[0] + points[1]) / 2, text)]
        return text


class LineTool(MeasureTool):
    """Tool that ends with the second of two points that the user clicks, and gives `on_line`."""

    def on_line(self, context: bpy.types.Context, start: Vector, end: Vector) -> None:
        """Handle the two points, in Blender's world."""
        raise NotImplementedError

    def on_event(
        self, context: bpy.types.Context, event: bpy.types.Event, region: bpy.types.Region, position: Pixel
    ) -> OperatorResult:
        """Set a point by a click, and end with the second."""
        result = super().on_event(context, event, region, position)
        if len(self._points) < 2:
            return result
        self.on_line(context, *self._points)
        return {"FINISHED"}


class ReadTool(PointTool):
    """Tool that shows what is known of the splat under the pointer; a click puts the 3D cursor there."""

    hint = "Point at the splats to read them; click: place the 3D cursor and report, Escape: end"

    def on_event(
        self, context: bpy.types.Context, event: bpy.types.Event, region: bpy.types.Region, position: Pixel
    ) -> OperatorResult:
        """Show the splat under the pointer."""
        clicked = event.type == "LEFTMOUSE" and event.value == "PRESS"
        if not clicked and event.type != "MOUSEMOVE":
            return {"PASS_THROUGH"}
        scene = present(context.scene)
        found = self.pick(context, region, position)
        text = found.describe(scene) if found else ""
        self.overlay.segments = [[found.position]] if found else []
        self.overlay.texts = [(found.position, text)] if found else []
        if clicked and found:
            scene.cursor.location = found.position
            self.report({"INFO"}, text.replace("\n", "; "))
        return {"RUNNING_MODAL"}
