"""Tools that select splats around the one under the pointer: Sphere and Flood."""

from collections.abc import Sequence
from typing import Annotated

import bpy
import numpy as np
from bpy.props import BoolProperty, FloatProperty, FloatVectorProperty

from ..swag_engine.base.errors import InputError
from . import labels, similar_splats
from .blender_types import OperatorResult, with_properties
from .point_tools import PointTool
from .region_selection import mode_of_keys
from .splat_selection import Mode, change_selection, edited_objects, unit_circle, world_positions
from .viewport_tool import Pixel, view_of

FIRST_RADIUS = 40.0
"""Radius of the first sphere, in pixels of the view."""
LEAST_DRAG = 6.0
"""Pixels from which on a drag gives the radius; a click may shake."""
WHEEL = 1.15
"""Factor of the radius for a step of the mouse wheel."""


@with_properties
class PointSelection(PointTool):
    """Tool that selects splats around one that the user clicks; it gives `select`.

    A script calls it with `point`; in a viewport it is the splat under the pointer.
    """

    bl_options = {"REGISTER", "UNDO"}

    point: Annotated[
        Sequence[float],
        FloatVectorProperty(
            name="Point", description="Place of the splat in the world", size=3, options={"HIDDEN", "SKIP_SAVE"}
        ),
    ]
    mode: Mode

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there are splats to select from."""
        cls.poll_message_set("Select an object with splats first")
        return bool(edited_objects(context))

    def objects(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """The objects whose splats are selected."""
        return edited_objects(context)

    def select(self, context: bpy.types.Context) -> int:
        """Select splats by the properties; returns how many are selected. Raises InputError."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Wait for a click."""
        self._pressed: Pixel | None = None
        return super().invoke(context, event)

    def on_event(
        self, context: bpy.types.Context, event: bpy.types.Event, region: bpy.types.Region, position: Pixel
    ) -> OperatorResult:
        """Take the splat under the pointer by a press, and select when the button is released."""
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            found = self.pick(context, region, position)
            if found is None:
                self.report({"WARNING"}, "There is no splat here.")
                return {"RUNNING_MODAL"}
            self._pressed, self.captured = position, region
            self.point, self.mode = found.position[:], mode_of_keys(event, self.mode)
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            if self._pressed is not None:
                return self.execute(context)
            return {"RUNNING_MODAL"} if self.wait_for_input else {"CANCELLED"}
        else:
            return {"PASS_THROUGH"}
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Select by the properties; Blender calls this for scripts, and after a change in Adjust Last Operation."""
        try:
            count = self.select(context)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{count} splats selected.")
        return {"FINISHED"}


@with_properties
class SphereSelection(PointSelection):
    """Tool that selects the splats in a sphere around one."""

    hint = "Click a splat; wheel or drag: radius, Shift: extend, Ctrl: subtract, Escape: cancel"

    radius: Annotated[
        float,
        FloatProperty(name="Radius", description="Radius of the sphere", subtype="DISTANCE", min=0, precision=4),
    ]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Wait for a click."""
        self._over_splat = False
        return super().invoke(context, event)

    def select(self, context: bpy.types.Context) -> int:
        """Select what is in the sphere."""
        centre, count = np.array(self.point), 0
        for obj in edited_objects(context):
            inside = np.linalg.norm(world_positions(obj) - centre, axis=1) <= self.radius
            count += change_selection(obj, inside & labels.drawn(obj), self.mode)
        return count

    def on_event(
        self, context: bpy.types.Context, event: bpy.types.Event, region: bpy.types.Region, position: Pixel
    ) -> OperatorResult:
        """Show the sphere at the pointer; the wheel and a drag change its radius."""
        result = super().on_event(context, event, region, position)
        moved = event.type in {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE"}
        if self._pressed:
            self._over_splat = True
        elif moved:
            found = self.pick(context, region, position)
            self._over_splat = found is not None
            if found is not None:
                self.point = found.position[:]
        self.overlay.lines = []
        if not self._over_splat:
            return result
        view, centre = view_of(region), np.array([self.point])
        unit = float(view.pixels_per_unit(view.project(centre)[1])[0])  # pixels
        self.radius = self.radius or FIRST_RADIUS / unit
        if event.type in {"WHEELUPMOUSE", "WHEELDOWNMOUSE"}:
            self.radius *= WHEEL if event.type == "WHEELUPMOUSE" else 1 / WHEEL
            result = {"RUNNING_MODAL"}
        elif moved and self._pressed:
            dragged = float(np.linalg.norm(np.subtract(position, self._pressed)))
            if dragged > LEAST_DRAG:
                self.radius = dragged / unit
        circle = unit_circle() * self.radius
        for axis in range(3):
            pixels, _, seen = view.project(np.insert(circle, axis, 0.0, axis=1) + centre)
            if seen.all():
                self.overlay.lines.append(pixels)
        return result


@with_properties
class FloodSelection(PointSelection):
    """Tool that selects the splats of similar color that are connected with one."""

    hint = "Click a splat to select those of its color around it; Shift: extend, Ctrl: subtract, Escape: cancel"

    tolerance: Annotated[
        float,
        FloatProperty(
            name="Tolerance", description="Largest difference from the color around the splat", subtype="FACTOR",
            default=0.1, min=0, max=1,
        ),
    ]  # fmt: skip
    distance: Annotated[
        float,
        FloatProperty(
            name="Gap", description="Longest gap between connected splats; 0: by their sizes", subtype="DISTANCE",
            min=0, precision=4, options={"SKIP_SAVE"},
        ),
    ]  # fmt: skip
    same_label: Annotated[
        bool,
        BoolProperty(name="Same Label", description="Select only splats with the label of the splat", default=True),
    ]

    def select(self, context: bpy.types.Context) -> int:
        """Select the connected splats of the object whose splat is nearest to the point."""
        objects, nearest = edited_objects(context), []
        for obj in objects:
            away = np.linalg.norm(world_positions(obj) - np.array(self.point), axis=1)
            away[~labels.drawn(obj)] = np.inf
            nearest.append((float(away.min()), int(away.argmin())))
        chosen = min(range(len(objects)), key=lambda index: nearest[index][0])
        if not np.isfinite(nearest[chosen][0]):
            raise InputError("All splats are hidden: show them with Show Hidden Splats.")
        count = 0
        for index, obj in enumerate(objects):
            if index == chosen:
                mask, self.distance = similar_splats.flood(
                    obj, nearest[index][1], self.tolerance, self.distance, self.same_label
                )
                count += change_selection(obj, mask, self.mode)
            elif self.mode == "SET":
                change_selection(obj, np.zeros(len(world_positions(obj)), bool), "SET")
        return count
