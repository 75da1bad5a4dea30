"""Base class of tools that the user works with in a 3D viewport by the pointer, and what they draw over it."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import blf
import bpy
import gpu
import numpy as np
from bpy.props import BoolProperty
from bpy_extras import view3d_utils
from gpu_extras.batch import batch_for_shader
from mathutils import Vector

from .blender_types import OperatorResult, present, with_properties
from .visibility import View

LINE_COLOR, SHADOW_COLOR = (1.0, 0.55, 0.1, 1.0), (0.0, 0.0, 0.0, 0.7)
LINE_WIDTH = 1.5
"""Pixels at an interface scale of 1."""
TEXT_SIZE = 13
"""Points."""
TEXT_OFFSET = 16
"""Pixels from a point to the text beside it, at an interface scale of 1."""

Pixel = tuple[float, float]
"""A place in a region, in pixels from its lower left corner."""


@dataclass
class Overlay:
    """What a tool draws over one region of a 3D viewport; it holds no operator, which Blender may free before it.

    Attributes:
        region: Address of the region; 0 for none.
        lines: Paths (P, 2) in pixels of the region.
        segments: Paths of points in the world.
        texts: Points of the world with the text that is written beside them.
    """

    region: int = 0
    lines: list[np.ndarray] = field(default_factory=list)
    segments: list[list[Vector]] = field(default_factory=list)
    texts: list[tuple[Vector, str]] = field(default_factory=list)

    def draw(self) -> None:
        """Draw it; Blender calls this after drawing a region of a 3D viewport."""
        region = bpy.context.region
        if region is None or region.as_pointer() != self.region:
            return
        scale = present(bpy.context.preferences).system.ui_scale
        view: Any = region.data

        def in_pixels(point: Vector) -> Vector | None:
            return view3d_utils.location_3d_to_region_2d(region, view, point)

        paths: list[list[Pixel]] = [[(x, y) for x, y in line.tolist()] for line in self.lines]
        for segment in self.segments:
            placed = [(place.x, place.y) for point in segment if (place := in_pixels(point)) is not None]
            paths.append(placed)
            for x, y in placed:
                paths.append([(x - 4 * scale, y), (x + 4 * scale, y)])
                paths.append([(x, y - 4 * scale), (x, y + 4 * scale)])
        for color, width in ((SHADOW_COLOR, 3 * LINE_WIDTH), (LINE_COLOR, LINE_WIDTH)):
            for path in paths:
                _draw_path(path, color, width * scale, region)
        blf.size(0, TEXT_SIZE * scale)
        blf.enable(0, blf.SHADOW)
        blf.shadow(0, 3, *SHADOW_COLOR)
        for point, text in self.texts:
            place = in_pixels(point)
            if place is None:
                continue
            for row, line in enumerate(text.splitlines()):
                y = place.y - (TEXT_OFFSET + 1.4 * TEXT_SIZE * row) * scale
                blf.position(0, place.x + TEXT_OFFSET * scale, y, 0)
                blf.color(0, 1, 1, 1, 1)
                blf.draw(0, line)
        blf.disable(0, blf.SHADOW)


def _draw_path(path: list[Pixel], color: tuple[float, ...], width: float, region: bpy.types.Region) -> None:
    if len(path) < 2:
        return
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    gpu.state.blend_set("ALPHA")
    shader.uniform_float("viewportSize", (region.width, region.height))
    shader.uniform_float("lineWidth", width)
    shader.uniform_float("color", color)
    points = [(x, y, 0.0) for x, y in path]
    batch_for_shader(shader, "LINE_STRIP", {"pos": points}).draw(shader)
    gpu.state.blend_set("NONE")


_handlers: list[Any] = []
"""Draw handlers of the tools that are in use."""


@with_properties
class ViewportTool(bpy.types.Operator):
    """Operator that the user works with by the pointer in a 3D viewport until it ends.

    It gives `hint` (for the status bar) and `on_event`, and may give `on_escape` and `on_end`. A press of the left
    mouse button ends no selection tool: Blender must not free an operator while it is called. Events outside the
    viewport, and those that `on_event` passes through, reach Blender: the view can be turned and the sidebar used
    meanwhile.
    """

    wait_for_input: Annotated[
        bool,
        BoolProperty(
            name="Wait for Input",
            description="Wait for a click; otherwise the event that calls the tool is its first, as in the toolbar",
            default=True,
            options={"HIDDEN", "SKIP_SAVE"},
        ),
    ]
    hint: str
    cursor: Any = "CROSSHAIR"
    captured: bpy.types.Region | None
    """Region that gets all events, wherever the pointer is, as while the user drags from it; None for none."""

    def on_event(
        self,
        context: bpy.types.Context,
        event: bpy.types.Event,
        region: bpy.types.Region,
        position: Pixel,
    ) -> OperatorResult:
        """Handle an event over the region at a position in its pixels.

        Returns:
            {"RUNNING_MODAL"} where the event was used, {"PASS_THROUGH"} where not, else how the tool ended.
        """
        raise NotImplementedError

    def on_escape(self, context: bpy.types.Context) -> OperatorResult:
        """Handle Escape or the right mouse button; returns how the tool ended."""
        return {"CANCELLED"}

    def on_end(self) -> None:
        """Put back what the tool changed for as long as it is used."""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Start the tool in the viewport that the button belongs to."""
        if context.area is None or context.area.type != "VIEW_3D":
            self.report({"ERROR"}, "This tool works in a 3D viewport: start it there.")
            return {"CANCELLED"}
        self.overlay, self.captured = Overlay(), None
        self._handler = bpy.types.SpaceView3D.draw_handler_add(self.overlay.draw, (), "WINDOW", "POST_PIXEL")
        _handlers.append(self._handler)
        present(context.window_manager).modal_handler_add(self)
        present(context.window).cursor_modal_set(self.cursor)
        present(context.workspace).status_text_set(bpy.app.translations.pgettext_iface(self.hint))
        if not self.wait_for_input:
            self.modal(context, event)  # a press, which ends no tool
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Handle one event; Blender calls this."""
        if context.area is None:
            return self._finish(context, {"CANCELLED"})
        if event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            return self._finish(context, self.on_escape(context))
        region = self.captured or region_under_pointer(context.area, event)
        if region is None:
            return {"PASS_THROUGH"}
        self.overlay.region = region.as_pointer()
        result = self.on_event(context, event, region, (event.mouse_x - region.x, event.mouse_y - region.y))
        region.tag_redraw()
        return result if result & {"RUNNING_MODAL", "PASS_THROUGH"} else self._finish(context, result)

    def cancel(self, context: bpy.types.Context) -> None:
        """End; Blender calls this when it removes the operator, as for another file."""
        self._finish(context, {"CANCELLED"})

    def _finish(self, context: bpy.types.Context, result: OperatorResult) -> OperatorResult:
        self.on_end()
        if self._handler in _handlers:
            _handlers.remove(self._handler)
            bpy.types.SpaceView3D.draw_handler_remove(self._handler, "WINDOW")
        if context.workspace is not None:
            context.workspace.status_text_set(None)
        if context.window is not None:
            context.window.cursor_modal_restore()
        if context.area is not None:
            context.area.tag_redraw()
        return result


def region_under_pointer(area: bpy.types.Area, event: bpy.types.Event) -> bpy.types.Region | None:
    """The viewport of an area that the pointer is over; None over its sidebar, toolbar and headers, and outside."""

    def is_over(region: bpy.types.Region) -> bool:
        return 0 <= event.mouse_x - region.x < region.width and 0 <= event.mouse_y - region.y < region.height

    over = [region for region in area.regions if is_over(region)]
    if any(region.type != "WINDOW" and region.width > 1 and region.height > 1 for region in over):
        return None
    return next((region for region in over if region.type == "WINDOW"), None)


def view_of(region: bpy.types.Region) -> View:
    """What a region of a 3D viewport shows."""
    region_3d: Any = region.data
    planes = np.array(region_3d.clip_planes) if region_3d.use_clip_planes else np.zeros((0, 4))
    return View(np.array(region_3d.perspective_matrix, np.float64), region.width, region.height, planes)


def register() -> None:
    """Nothing to register: tools add their draw handlers when they start."""


def unregister() -> None:
    """Remove the draw handlers of tools that are in use."""
    while _handlers:
        bpy.types.SpaceView3D.draw_handler_remove(_handlers.pop(), "WINDOW")
