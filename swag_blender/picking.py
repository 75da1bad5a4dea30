"""The splat under the pointer, and what is known of it."""

from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Vector

from . import labels, splat_selection, splats
from .lengths import length_text, position_text
from .viewport_tool import Pixel
from .visibility import View

PICK_RADIUS = 12.0
"""Pixels around the pointer in which a splat is found."""
PICK_MIN_OPACITY = 0.3
"""Fainter splats are hardly visible, so they are not found."""


@dataclass(frozen=True)
class Reading:
    """A splat that was found in a view.

    Attributes:
        position: Its centre in Blender's world.
        distance: Range, the distance from the viewer to the centre in Blender units; None in a view without
            perspective, which has no viewer.
        label: Name of its label; "" without one.
        opacity: 0..1.
        object: Name of its object.
    """

    position: Vector
    distance: float | None
    label: str
    opacity: float
    object: str

    def describe(self, scene: bpy.types.Scene) -> str:
        """What is known, a line each, with lengths in the scene's unit."""
        lines = [f"Position: {position_text(scene, self.position[:])}"]
        if self.distance is not None:
            lines.append(f"Range: {length_text(scene, self.distance)}")
        if self.label:
            lines.append(f"Label: {self.label}")
        return "\n".join([*lines, f"Opacity: {self.opacity:.2f}"])


class Picker:
    """Finds the splat under the pointer in a view, of the splat objects that are visible there.

    What is projected is kept, so that the pointer can move without delay.

    Args:
        objects: the splat objects.
        view: the view.
    """

    def __init__(self, objects: list[bpy.types.Object], view: View) -> None:
        self._view = view
        self._parts = []
        for obj in objects:
            positions = splat_selection.world_positions(obj)
            pixels, depths, seen = view.project(positions)
            seen &= labels.drawn(obj) & (splat_selection.opacities(obj) > PICK_MIN_OPACITY)
            rows = np.flatnonzero(seen)
            self._parts.append((obj.name, rows, pixels[rows], depths[rows], positions[rows]))

    def at(self, position: Pixel) -> Reading | None:
        """The splat at a position, in the surface nearest to the viewer; None where there is none."""
        found: list[tuple[float, float, str, int, Vector]] = []
        for name, rows, pixels, depths, positions in self._parts:
            distances = np.linalg.norm(pixels - np.array(position), axis=1)
            hit = np.flatnonzero(distances < PICK_RADIUS)
            if not len(hit):
                continue
            # Of those as near to the viewer as the first, within what PICK_RADIUS spans there, that nearest to the
            # pointer.
            first = depths[hit].min()
            reach = first + PICK_RADIUS / self._view.pixels_per_unit(np.array([first]))[0]
            hit = hit[depths[hit] <= reach]
            index = hit[distances[hit].argmin()]
            found.append((float(first), float(distances[index]), name, int(rows[index]), Vector(positions[index])))
        return self._read(*min(found)[2:]) if found else None

    def _read(self, name: str, row: int, position: Vector) -> Reading:
        obj = bpy.data.objects[name]
        numbers = labels.attribute(obj, labels.LABEL)
        names = {entry.number: entry.name for entry in labels.labels_of(obj).entries}
        number = 0 if numbers is None else int(numbers[row])
        eye = self._view.eye
        distance = None if eye is None else float(np.linalg.norm(np.array(position) - eye))
        opacity = float(splat_selection.opacities(obj)[row])
        return Reading(position, distance, names.get(number, "") if number else "", opacity, name)


def splat_objects(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The visible splat objects."""
    return [obj for obj in context.visible_objects if splats.is_splats(obj)]
