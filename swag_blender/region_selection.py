"""Tools that select splats by a region that the user draws in a 3D viewport: box, lasso, circle, brush."""

from collections.abc import Sequence
from typing import Annotated

import bpy
import numpy as np
from bpy.props import BoolProperty, CollectionProperty, FloatVectorProperty, IntProperty, IntVectorProperty
from bpy.types import OperatorMousePath

from ..swag_engine.base.errors import InputError
from .blender_types import OperatorResult, with_properties
from .splat_selection import (
    Mode,
    Projection,
    change_selection,
    edited_objects,
    in_box,
    in_lasso,
    in_stroke,
    unit_circle,
)
from .viewport_tool import Pixel, ViewportTool, view_of
from .visibility import View


@with_properties
class RegionSelection(ViewportTool):
    """Tool that selects the splats in a region of the view; it gives `contains`, and may give `outline`.

    A script calls it with `path`, `matrix` and `size`; in a viewport these are what the user draws.
    """

    bl_options = {"REGISTER", "UNDO"}

    mode: Mode
    through: Annotated[
        bool,
        BoolProperty(
            name="Select Through",
            description="Select splats behind others too; most of what is seen has splats behind it",
            default=True,
        ),
    ]
    path: Annotated[
        "bpy.types.bpy_prop_collection_idprop[OperatorMousePath]",
        CollectionProperty(
            type=OperatorMousePath,
            name="Path",
            description="Points of the region in pixels of the view, from its lower left corner",
            options={"HIDDEN", "SKIP_SAVE"},
        ),
    ]
    matrix: Annotated[
        Sequence[float],
        FloatVectorProperty(
            name="Matrix",
            description="Rows of the matrix from the world to the clip space of the view",
            size=16,
            options={"HIDDEN", "SKIP_SAVE"},
        ),
    ]
    size: Annotated[
        Sequence[int],
        IntVectorProperty(
            name="Size", description="Width and height of the view in pixels", size=2, options={"HIDDEN", "SKIP_SAVE"}
        ),
    ]

    def contains(self, pixels: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Mask (N,) bool of the pixels (N, 2) in the region of a path (P, 2)."""
        raise NotImplementedError

    def outline(self, path: np.ndarray) -> np.ndarray:
        """Outline (Q, 2) in pixels of the region of a path (P, 2)."""
        return path

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there are splats to select from."""
        cls.poll_message_set("Select an object with splats first")
        return bool(edited_objects(context))

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Let the user draw."""
        self._points: list[tuple[float, float]] = []
        return super().invoke(context, event)

    def on_event(
        self,
        context: bpy.types.Context,
        event: bpy.types.Event,
        region: bpy.types.Region,
        position: Pixel,
    ) -> OperatorResult:
        """Draw while the left mouse button is down, and select when it is released."""
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            self._points, self.captured = [position], region
            self.mode = mode_of_keys(event, self.mode)
        elif self._points and event.type in {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE"}:
            self._points.append(position)
            self.overlay.lines = [self.outline(np.array(self._points))]
        elif self._points and event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self._points.append(position)
            self._keep_drawing(view_of(region))
            return self.execute(context)
        elif not self._points:
            return {"PASS_THROUGH"}
        return {"RUNNING_MODAL"}

    def _keep_drawing(self, view: View) -> None:
        """Store what was drawn in the properties, for the selection and for doing it again."""
        self.path.clear()
        for point in self._points:
            self.path.add().loc = point
        self.matrix, self.size = view.matrix.ravel().tolist(), (view.width, view.height)
        self._planes = view.planes

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Select by the properties; Blender calls this for scripts, and after a change in Adjust Last Operation."""
        try:
            if not len(self.path) or min(self.size) < 1:
                raise InputError("Give path, matrix and size of the view, or draw in a 3D viewport.")
            path = np.array([point.loc for point in self.path])
            planes = getattr(self, "_planes", np.zeros((0, 4)))
            view = View(np.array(self.matrix).reshape(4, 4), self.size[0], self.size[1], planes)
            count = 0
            for obj in edited_objects(context):
                projection = Projection(obj, view, self.through)
                mask = projection.inside(lambda pixels: self.contains(pixels, path))
                count += change_selection(obj, mask, self.mode)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{count} splats selected.")
        return {"FINISHED"}


class BoxSelection(RegionSelection):
    """Tool that selects the splats in a box, between the first and the last point of the path."""

    hint = "Drag a box around splats; Shift: extend, Ctrl: subtract, Escape: cancel"

    def contains(self, pixels: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Pixels in the box."""
        return in_box(pixels, path)

    def outline(self, path: np.ndarray) -> np.ndarray:
        """The box."""
        (x0, y0), (x1, y1) = path[0], path[-1]
        return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)])


class LassoSelection(RegionSelection):
    """Tool that selects the splats inside a closed path."""

    hint = "Draw around splats; Shift: extend, Ctrl: subtract, Escape: cancel"

    def contains(self, pixels: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Pixels inside the closed path."""
        return in_lasso(pixels, path)

    def outline(self, path: np.ndarray) -> np.ndarray:
        """The closed path."""
        return np.concatenate([path, path[:1]])


class CircleSelection(RegionSelection):
    """Tool that selects the splats in a circle around the first point of the path, up to the last."""

    hint = "Drag from the middle of a circle; Shift: extend, Ctrl: subtract, Escape: cancel"

    def contains(self, pixels: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Pixels in the circle."""
        return in_stroke(pixels, path[:1], float(np.linalg.norm(path[-1] - path[0])))

    def outline(self, path: np.ndarray) -> np.ndarray:
        """The circle."""
        return unit_circle() * np.linalg.norm(path[-1] - path[0]) + path[0]


@with_properties
class BrushSelection(RegionSelection):
    """Tool that selects the splats that a circle touches on its way."""

    # Without REGISTER: several strokes are one step, which one path could not repeat.
    bl_options = {"UNDO"}
    hint = "Paint over splats; wheel: size, Shift: extend, Ctrl: subtract, Escape or Enter: finish"

    radius: Annotated[
        int, IntProperty(name="Radius", description="Radius of the brush", default=25, min=1, subtype="PIXEL")
    ]

    def contains(self, pixels: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Pixels that the circle touches."""
        return in_stroke(pixels, path, self.radius)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Let the user paint."""
        self._painted, self._last = False, (0.0, 0.0)
        self._projections: list[tuple[str, Projection]] = []
        return super().invoke(context, event)

    def on_event(
        self,
        context: bpy.types.Context,
        event: bpy.types.Event,
        region: bpy.types.Region,
        position: Pixel,
    ) -> OperatorResult:
        """Paint while the left mouse button is down."""
        used: OperatorResult = {"RUNNING_MODAL"}
        if event.type in {"WHEELUPMOUSE", "WHEELDOWNMOUSE"}:
            self.radius = max(round(self.radius * (1.15 if event.type == "WHEELUPMOUSE" else 1 / 1.15)), 3)
        elif event.type in {"RET", "NUMPAD_ENTER"} and event.value == "PRESS":
            return self.on_escape(context)
        elif event.type == "LEFTMOUSE" and event.value == "PRESS":
            self.captured, self._last, self._painted = region, position, True
            view, mode = view_of(region), mode_of_keys(event, self.mode)
            self._projections = [(obj.name, Projection(obj, view, self.through)) for obj in edited_objects(context)]
            self._paint(context, position, mode)
            self._stroke_mode = "EXTEND" if mode == "SET" else mode
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self.captured = None
            if not self.wait_for_input:
                return self.on_escape(context)
        elif event.type in {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE"}:
            if self.captured:
                self._paint(context, position, self._stroke_mode)
        else:
            used = {"PASS_THROUGH"}
        self.overlay.lines = [unit_circle() * self.radius + position]
        return used

    def on_escape(self, context: bpy.types.Context) -> OperatorResult:
        """Keep what was painted."""
        return {"FINISHED"} if self._painted else {"CANCELLED"}

    def _paint(self, context: bpy.types.Context, position: Pixel, mode: str) -> None:
        path = np.array([self._last, position])
        self._last = position
        for name, projection in self._projections:
            if (obj := bpy.data.objects.get(name)) is not None:
                change_selection(obj, projection.inside(lambda pixels: self.contains(pixels, path)), mode)


def mode_of_keys(event: bpy.types.Event, mode: str) -> str:
    """The mode by the keys that are held: Shift extends, Ctrl subtracts, otherwise `mode`."""
    return "EXTEND" if event.shift else "SUBTRACT" if event.ctrl else mode
