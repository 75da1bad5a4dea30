"""Select splats by what they are like."""

from collections.abc import Sequence
from typing import Annotated

import bpy
from bpy.props import EnumProperty, FloatProperty, FloatVectorProperty, StringProperty

from ..swag_blender import similar_splats
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.operator_base import SplatsOperator
from ..swag_blender.splat_selection import Mode, change_selection, edited_objects


@with_properties
class SWAG_OT_select_by(SplatsOperator):
    """Select splats by their size, opacity, color, label or distance; the threshold can be changed afterwards"""

    bl_idname = "swag.select_by"
    bl_label = "Select By"

    kind: Annotated[
        str, EnumProperty(name="Kind", description="What splats are selected by", items=similar_splats.KINDS)
    ]
    side: Annotated[
        str,
        EnumProperty(
            name="Side",
            description="Which splats are selected",
            items=[
                ("ABOVE", "Above", "Select splats above the threshold"),
                ("BELOW", "Below", "Select splats below the threshold"),
            ],
        ),
    ]
    length: Annotated[
        float,
        FloatProperty(
            name="Threshold", description="Size or distance to compare with", subtype="DISTANCE", min=0, precision=4,
            options={"SKIP_SAVE"},
        ),
    ]  # fmt: skip
    fraction: Annotated[
        float,
        FloatProperty(
            name="Threshold", description="Opacity, difference of color or certainty to compare with", subtype="FACTOR",
            default=0.1, min=0, max=1,
        ),
    ]  # fmt: skip
    color: Annotated[
        Sequence[float],
        FloatVectorProperty(
            name="Color", description="Color that splats are compared with; at first that of the selected splats",
            subtype="COLOR_GAMMA", size=3, min=0, max=1, default=(0.5, 0.5, 0.5), options={"SKIP_SAVE"},
        ),
    ]  # fmt: skip
    label: Annotated[str, StringProperty(name="Label", description="Name of the label, or a part of it")]
    mode: Mode

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Start with values that fit the splats."""
        obj = edited_objects(context)[0]
        if self.kind in similar_splats.LENGTHS and not self.properties.is_property_set("length"):
            self.length = similar_splats.usual_length(context, obj, self.kind)
        if self.kind == "HAZE" and not self.properties.is_property_set("fraction"):
            self.fraction = 0.5
        if self.kind == "COLOR" and not self.properties.is_property_set("color"):
            self.color = similar_splats.selected_color(obj)
        if self.kind == "LABEL" and not self.label:
            self.label = similar_splats.active_label(obj)
        return self.execute(context)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the properties that the kind uses; Blender calls this."""
        layout = present(self.layout)
        layout.use_property_split = True
        for name in ("kind", *similar_splats.properties_of(self.kind), "mode"):
            layout.prop(self, name)

    def work(self, context: bpy.types.Context) -> str:
        """Select them."""
        count = 0
        for obj in edited_objects(context):
            threshold = self.length if self.kind in similar_splats.LENGTHS else self.fraction
            mask = similar_splats.find(
                context, obj, self.kind, threshold, self.side == "ABOVE", self.color[:], self.label
            )
            count += change_selection(obj, mask, self.mode)
        return f"{count} splats selected."


CLASSES = (SWAG_OT_select_by,)
