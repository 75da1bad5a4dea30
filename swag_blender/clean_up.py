"""Clean Up: propose splats that are no part of the scene, by kinds that the user switches; the selection shows them.

The kinds of each splat are stored in the attribute `swag:clean_up` (INT, a sum of bits) from Clean Up until Remove or
Cancel, so that switching a kind only selects again.
"""

from collections.abc import Sequence
from typing import Annotated, Any, cast

import bpy
import numpy as np
from bpy.props import BoolProperty, PointerProperty
from bpy.types import PropertyGroup

from . import floaters, labels, splat_selection, splats
from .blender_types import present, set_button, with_properties
from .engine_process import engine_problem
from .properties import status_of
from .runs import RUN_KEY
from .sidebar import draw_job, draw_outcome
from .splat_selection import edited_objects

ATTRIBUTE = "swag:clean_up"
HAZE = "swag:haze"
"""FLOAT, 0..1: how sure it is that a splat is open water, for splats of runs that know it."""
OPEN_WATER = "open water"
"""Label that stands for HAZE in its place."""
FLOATER, OPEN, FUZZY = 1, 2, 4
"""Bits of the kinds."""
IN_FRONT = 0.9
"""Smallest fraction of a floater that lies in front of the surface, the default of Find Floaters. Splats that few
photos see are no floaters here: without the 461 seen by less than two photos, the demo loses 0.3 dB, without the 334
floaters 0.06 dB."""
SURE_OF_WATER = 0.5
"""Smallest HAZE of open water: it is more likely than not."""
FUZZY_PHOTOS = 0.1
"""A splat of the border is seen by a smaller fraction of the cameras."""
FUZZY_OPACITY = 0.5
"""Largest opacity of a fuzzy splat."""
FUZZY_SIZE = 4.0
"""Smallest size of a fuzzy splat, in medians of the largest standard deviation. With these three limits the demo loses
0.03 dB and 147 of 29 095 splats; with twice the photos 0.08 dB, with half the size 0.07 dB, with any opacity 0.3 dB."""


def _select_again(settings: Any, context: bpy.types.Context) -> None:
    for obj in proposed_objects(context):
        labels.select(obj, wanted(obj, settings))
    status_of(context).forget("PSNR")  # it was of another selection


@with_properties
class SwagCleanUp(PropertyGroup):
    """`scene.swag_clean_up`: kinds of splats that Clean Up proposes."""

    floaters: Annotated[
        bool,
        BoolProperty(
            name="Floaters", default=True, update=_select_again,
            description="Splats in front of the surfaces that the photos show",
        ),
    ]  # fmt: skip
    open_water: Annotated[
        bool,
        BoolProperty(
            name="Open Water", default=True, update=_select_again,
            description="Splats that stand for the haze of open water",
        ),
    ]  # fmt: skip
    border: Annotated[
        bool,
        BoolProperty(
            name="Fuzzy Border", default=True, update=_select_again,
            description="Large, faint splats where few photos look",
        ),
    ]  # fmt: skip


KINDS = {"floaters": FLOATER, "open_water": OPEN, "border": FUZZY}
"""Bits by the names of the switches."""


def settings_of(context: bpy.types.Context) -> SwagCleanUp:
    """Kinds that are proposed in the scene."""
    return cast(Any, context.scene).swag_clean_up


def proposed_objects(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The selected splat objects for which there is a proposal."""
    return [obj for obj in edited_objects(context) if ATTRIBUTE in splats.pointcloud_of(obj).attributes]


def propose(context: bpy.types.Context, obj: bpy.types.Object) -> int:
    """Find the kinds of all splats of an object and select what is proposed; returns how many are selected.

    Raises:
        InputError: there is no camera.
    """
    kinds = np.zeros(splats.count(obj), np.int32)
    seen, drawn = floaters.observe(context, obj), labels.drawn(obj)
    kinds[floaters.find(context, obj, IN_FRONT, 0)] |= FLOATER
    haze = labels.attribute(obj, HAZE)
    if haze is not None:
        kinds[drawn & (haze >= SURE_OF_WATER)] |= OPEN
    elif numbers := labels.numbers_named(obj, OPEN_WATER):
        kinds[drawn & np.isin(present(labels.attribute(obj, labels.LABEL)), numbers)] |= OPEN
    sizes = splat_selection.world_sizes(obj).max(axis=1)
    faint = splat_selection.opacities(obj) <= FUZZY_OPACITY
    large = sizes >= FUZZY_SIZE * np.median(sizes)
    kinds[drawn & faint & large & (seen.photos < FUZZY_PHOTOS * seen.cameras)] |= FUZZY
    labels.set_attribute(obj, ATTRIBUTE, "INT", kinds)
    return labels.select(obj, wanted(obj, settings_of(context)))


def can_score(context: bpy.types.Context) -> bool:
    """Whether the engine can compute the PSNR without the selected splats of the active object now."""
    obj = context.active_object
    return (
        obj is not None
        and obj in proposed_objects(context)
        and bool(obj.get(RUN_KEY))
        and status_of(context).find("PSNR") is None
        and not engine_problem()
        and splat_selection.selected_count(obj) > 0
    )


def wanted(obj: bpy.types.Object, settings: SwagCleanUp) -> np.ndarray:
    """Mask (N,) bool of the proposed splats of the kinds that are switched on."""
    bits = sum(bit for name, bit in KINDS.items() if getattr(settings, name))
    return present(labels.attribute(obj, ATTRIBUTE)) & bits > 0


def counts(objects: Sequence[bpy.types.Object]) -> dict[str, int]:
    """Number of proposed splats by kind; a splat of two kinds counts for both."""
    found = [present(labels.attribute(obj, ATTRIBUTE)) for obj in objects]
    return {name: sum(int((kinds & bit > 0).sum()) for kinds in found) for name, bit in KINDS.items()}


def finish(objects: Sequence[bpy.types.Object], remove: bool) -> int:
    """End the proposal, and delete the selected splats or deselect them; returns how many were deleted.

    Raises:
        InputError: nothing is selected, or all splats of an object; the proposal stays then.
    """
    count = splat_selection.delete(objects) if remove else 0
    for obj in objects:
        attributes = splats.pointcloud_of(obj).attributes
        attributes.remove(attributes[ATTRIBUTE])
        splat_selection.select_all(obj, "DESELECT")
    return count


def draw_clean_up(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the button, or the kinds that it found, what removing them costs, and how to end."""
    objects = proposed_objects(context)
    if not objects:
        row = layout.row()
        row.scale_y = 1.4
        row.operator("swag.clean_up", icon="BRUSH_DATA")
        return
    box = layout.box()
    found = counts(objects)
    column = box.column(align=True)
    for name in KINDS:
        row = column.row()
        row.prop(settings_of(context), name)
        value = row.row()
        value.alignment = "RIGHT"
        value.label(text=f"{found[name]:,}", translate=False)
    draw_score(box, context)
    row = box.row(align=True)
    set_button(row.operator("swag.finish_clean_up", text="Remove", icon="TRASH"), remove=True)
    set_button(row.operator("swag.finish_clean_up", text="Cancel", icon="X"), remove=False)


def draw_score(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the button that computes the PSNR without the selection, the job, or its outcome."""
    if not draw_job(layout, context, "PSNR"):
        layout.operator("swag.score_selection", icon="IMAGE_DATA")
        draw_outcome(layout, context, "PSNR")


def register() -> None:
    """Register the switches with scenes."""
    bpy.utils.register_class(SwagCleanUp)
    cast(Any, bpy.types.Scene).swag_clean_up = PointerProperty(type=SwagCleanUp)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.Scene).swag_clean_up
    bpy.utils.unregister_class(SwagCleanUp)
