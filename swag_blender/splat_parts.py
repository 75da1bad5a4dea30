"""All splats of an object, those that are shown, or those that are selected."""

import bpy
import numpy as np

from ..swag_engine.formats.select import inside_box
from ..swag_engine.splats.splats import Splats
from . import splats
from .crop_box import world_to_box
from .labels import SELECTED
from .nodes.splat_colors import HIDDEN


def part_of(obj: bpy.types.Object, placement: np.ndarray, part: str) -> Splats:
    """Splats of an object in its own frame, with its modifiers applied.

    Args:
        obj: a splat object.
        placement: matrix (4, 4) from its own frame to Blender's world.
        part: "ALL", "VISIBLE" (neither hidden nor outside the object's crop box) or "SELECTED" (of those).

    Raises:
        InputError: the modifiers leave no splats.
    """
    own, (hidden, selected) = splats.read_modified_splats(obj, HIDDEN, SELECTED)
    if part == "ALL":
        return own
    to_box = world_to_box(obj)
    wanted = ~hidden if to_box is None else ~hidden & inside_box(own.positions, to_box @ placement)
    if part == "SELECTED":
        wanted &= selected
    return own if wanted.all() else own.subset(wanted)
