"""Lengths as text in the unit of a Blender scene."""

from collections.abc import Sequence

import bpy


def length_text(scene: bpy.types.Scene, length: float) -> str:
    """A length, given in Blender units, in the scene's unit."""
    units = scene.unit_settings
    if units.system == "NONE":
        return f"{length:.4g}"
    return bpy.utils.units.to_string(
        units.system, "LENGTH", length * units.scale_length, precision=4, split_unit=units.use_separate
    )


def position_text(scene: bpy.types.Scene, position: Sequence[float]) -> str:
    """The three coordinates of a point of Blender's world in the scene's unit."""
    return ", ".join(length_text(scene, coordinate) for coordinate in position)
