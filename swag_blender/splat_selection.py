"""Selecting splats by a region of a view; inverting, hiding, deleting."""

from collections.abc import Callable, Sequence
from typing import Annotated

import bpy
import numpy as np
from bpy.props import EnumProperty

from ..swag_engine.base.errors import InputError
from . import labels, splats
from .crop_box import crop_of, inside_crop
from .nodes.formulas import SH_0
from .visibility import CELL, View, blend

SURFACE_CELLS = 2.0
"""Thickness of a surface, in edges of a cell: splats this far behind where it begins are visible too."""

Mode = Annotated[
    str,
    EnumProperty(
        name="Mode",
        description="What happens to the splats that are selected already",
        items=[
            ("SET", "Set", "Select these alone"),
            ("EXTEND", "Extend", "Select these too"),
            ("SUBTRACT", "Subtract", "Deselect these"),
        ],
        options={"SKIP_SAVE"},
    ),
]


def edited_objects(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The visible splat objects that are selected or active; without any, those that a selected crop box crops."""
    chosen = list(context.selected_objects)
    active = context.active_object
    if active is not None and active not in chosen and active.visible_get():
        chosen.append(active)
    found = [obj for obj in chosen if splats.is_splats(obj)]
    return found or [obj for obj in context.visible_objects if splats.is_splats(obj) and crop_of(obj) in chosen]


def selected_count(obj: bpy.types.Object) -> int:
    """Number of selected splats that are drawn."""
    mask = labels.mask_of(obj, labels.SELECTED)
    return int((mask & labels.drawn(obj)).sum()) if mask.any() else 0


def world_positions(obj: bpy.types.Object) -> np.ndarray:
    """Centres (N, 3) float64 of the splats in Blender's world."""
    matrix = np.array(obj.matrix_world, np.float64)
    return splats.positions(obj) @ matrix[:3, :3].T + matrix[:3, 3]


def world_sizes(obj: bpy.types.Object) -> np.ndarray:
    """Standard deviations (N, 3) float64 along the splats' axes in Blender's world, for an evenly scaled object."""
    scale = np.cbrt(abs(np.linalg.det(np.array(obj.matrix_world, np.float64)[:3, :3])))
    return splats.scales(obj) * scale


def opacities(obj: bpy.types.Object) -> np.ndarray:
    """Opacities (N,) 0..1 of the splats."""
    return splats.base(obj)[:, 3]


def colors(obj: bpy.types.Object) -> np.ndarray:
    """Colors (N, 3), sRGB values 0..1, of the splats without what depends on the direction of view."""
    return np.clip(splats.base(obj)[:, :3] * SH_0 + 0.5, 0, 1)


# -- selecting -----------------------------------------------------------------------------------------------------


def change_selection(obj: bpy.types.Object, mask: np.ndarray, mode: str) -> int:
    """Select the splats of a mask (N,) bool by a mode ("SET", "EXTEND", "SUBTRACT"); returns how many are selected."""
    before = labels.mask_of(obj, labels.SELECTED)
    return labels.select(obj, {"SET": mask, "EXTEND": before | mask, "SUBTRACT": before & ~mask}[mode])


def select_all(obj: bpy.types.Object, action: str) -> int:
    """Select all splats, none, or those that are not selected ("SELECT", "DESELECT", "INVERT"); returns how many."""
    before = labels.mask_of(obj, labels.SELECTED)
    return labels.select(
        obj, {"SELECT": np.ones_like(before), "DESELECT": np.zeros_like(before), "INVERT": ~before}[action]
    )


class Projection:
    """The splats of an object in a view, from which regions of the view are selected.

    Args:
        obj: a splat object.
        view: the view; splats behind the viewer or clipped are never selected.
        through: whether splats behind others can be selected.
    """

    def __init__(self, obj: bpy.types.Object, view: View, through: bool) -> None:
        positions, drawn = world_positions(obj), labels.drawn(obj)
        pixels, depths, seen = view.project(positions)
        seen &= drawn
        if not through:
            blended = blend(view, positions, world_sizes(obj).mean(axis=1), opacities(obj), drawn)
            seen &= blended.visible(depths, SURFACE_CELLS * CELL / view.pixels_per_unit(depths))
        self._seen, self._pixels = seen, pixels[seen]

    def inside(self, region: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Mask (N,) bool of the splats with their centre in a region, which tells of pixels (M, 2) which are in it."""
        found = np.zeros(len(self._seen), bool)
        found[self._seen] = region(self._pixels)
        return found


def in_box(pixels: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Mask (N,) bool of the pixels (N, 2) in the box whose corners are the first and the last point of a path."""
    lower, upper = np.minimum(path[0], path[-1]), np.maximum(path[0], path[-1])
    return ((pixels >= lower) & (pixels <= upper)).all(axis=1)


def in_lasso(pixels: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Mask (N,) bool of the pixels (N, 2) inside a closed path (P, 2), by the even-odd rule."""
    found = in_box(pixels, np.stack([path.min(axis=0), path.max(axis=0)]))
    x, y = pixels[found].T
    inside = np.zeros(len(x), bool)
    for (x0, y0), (x1, y1) in zip(path, np.roll(path, -1, axis=0), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    found[found] = inside
    return found


def in_stroke(pixels: np.ndarray, path: np.ndarray, radius: float) -> np.ndarray:
    """Mask (N,) bool of the pixels (N, 2) that a circle of this radius touches on its way along a path (P, 2)."""
    found = np.zeros(len(pixels), bool)
    starts = path[:-1] if len(path) > 1 else path
    ends = path[1:] if len(path) > 1 else path
    for start, end in zip(starts, ends, strict=True):
        step = end - start
        length = max(float(step @ step), 1e-12)
        along = np.clip((pixels - start) @ step / length, 0, 1)
        found |= ((start + along[:, None] * step - pixels) ** 2).sum(axis=1) <= radius**2
    return found


def unit_circle() -> np.ndarray:
    """Closed path (49, 2) around a circle of radius 1 at the origin."""
    angles = np.linspace(0, 2 * np.pi, 49)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


# -- hiding and deleting -------------------------------------------------------------------------------------------


def hide(objects: Sequence[bpy.types.Object], unselected: bool) -> int:
    """Hide the selected splats of objects, or all others; returns how many were hidden. They are deselected.

    Raises:
        InputError: no splats are selected.
    """
    parts = [(obj, labels.mask_of(obj, labels.SELECTED) & labels.drawn(obj)) for obj in objects]
    if not any(chosen.any() for _, chosen in parts):
        raise InputError("No splats are selected.")
    count = 0
    for obj, chosen in parts:
        hidden = labels.drawn(obj) & ~chosen if unselected else chosen
        labels.set_attribute(obj, labels.MASKED, "BOOLEAN", labels.mask_of(obj, labels.MASKED) | hidden)
        labels.set_attribute(obj, labels.SELECTED, "BOOLEAN", chosen & ~hidden)
        labels.show(obj)
        count += int(hidden.sum())
    return count


def reveal(obj: bpy.types.Object) -> int:
    """Show the splats again that `hide` hid, and select them; returns how many. Hidden labels stay hidden."""
    masked = labels.mask_of(obj, labels.MASKED)
    if masked.any():
        labels.set_attribute(obj, labels.MASKED, "BOOLEAN", np.zeros_like(masked))
        labels.show(obj)
        labels.select(obj, masked)
    return int(masked.sum())


def delete(objects: Sequence[bpy.types.Object]) -> int:
    """Remove the selected splats of objects; returns how many there were.

    Raises:
        InputError: nothing is selected, or all splats of an object; nothing is removed then.
    """
    return _remove([(obj, labels.mask_of(obj, labels.SELECTED) & labels.drawn(obj)) for obj in objects], "selected")


def delete_outside_crop(objects: Sequence[bpy.types.Object]) -> int:
    """Remove the splats outside the crop boxes of objects; returns how many there were. Raises as `delete`."""
    return _remove([(obj, ~inside_crop(obj)) for obj in objects], "outside the crop box")


def _remove(parts: Sequence[tuple[bpy.types.Object, np.ndarray]], what: str) -> int:
    """Remove the splats of the masks; `what` describes them in messages."""
    if not any(mask.any() for _, mask in parts):
        raise InputError(f"No splats are {what}.")
    for obj, mask in parts:
        if mask.all():
            raise InputError(f"All splats of {obj.name} are {what}: delete the object instead.")
    for obj, mask in parts:
        if mask.any():
            splats.keep_splats(obj, ~mask)
            labels.list_again(obj)
    return sum(int(mask.sum()) for _, mask in parts)
