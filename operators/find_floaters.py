"""Select splats that float in front of surfaces, or that few photos see."""

from typing import Annotated

import bpy
from bpy.props import FloatProperty, IntProperty

from ..swag_blender import floaters
from ..swag_blender.blender_types import present, with_properties
from ..swag_blender.operator_base import SteppedOperator
from ..swag_blender.splat_selection import Mode, change_selection, edited_objects
from ..swag_blender.steps import Steps


@with_properties
class SWAG_OT_find_floaters(SteppedOperator):
    """Select splats in front of the surfaces that the photos show, and splats that few photos see"""

    bl_idname = "swag.find_floaters"
    bl_label = "Find Floaters"

    in_front: Annotated[
        float,
        FloatProperty(
            name="In Front",
            description="Select splats of which at least this part, as the photos see it, is in front of the surface",
            subtype="FACTOR", default=0.9, min=0.01, max=1,
        ),
    ]  # fmt: skip
    photos: Annotated[
        int,
        IntProperty(
            name="Fewer Photos Than", description="Select splats that fewer photos than this see; 0 for none",
            default=2, min=0, soft_max=10,
        ),
    ]  # fmt: skip
    mode: Mode

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the thresholds; Blender calls this."""
        layout = present(self.layout)
        layout.use_property_split = True
        for name in ("in_front", "photos", "mode"):
            layout.prop(self, name)

    def steps(self, context: bpy.types.Context) -> Steps[None]:
        """Compute what the cameras see."""
        objects = edited_objects(context)
        for index, obj in enumerate(objects):
            for fraction in floaters.observing(context, obj):
                yield (index + fraction) / len(objects)

    def work(self, context: bpy.types.Context) -> str:
        """Select them."""
        lines = []
        for obj in edited_objects(context):
            mask = floaters.find(context, obj, self.in_front, self.photos)
            change_selection(obj, mask, self.mode)
            lines.append(floaters.describe(obj, mask, floaters.observe(context, obj)))
        return " ".join(lines)


CLASSES = (SWAG_OT_find_floaters,)
