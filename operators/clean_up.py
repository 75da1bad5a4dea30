"""Propose splats to remove: floaters, open water, the fuzzy border."""

import bpy

from ..swag_blender import clean_up
from ..swag_blender.blender_types import OperatorResult, call_operator
from ..swag_blender.operator_base import SplatsOperator
from ..swag_blender.splat_selection import edited_objects


class SWAG_OT_clean_up(SplatsOperator):
    """Select floaters, blobs in open water and the fuzzy border, and compute what removing them costs"""

    bl_idname = "swag.clean_up"
    bl_label = "Clean Up"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Select them, and compute the PSNR without them beside the work; Blender calls this for the button."""
        result = self.execute(context)
        if result == {"FINISHED"} and clean_up.can_score(context):
            call_operator("score_selection", "INVOKE_DEFAULT")
        return result

    def work(self, context: bpy.types.Context) -> str:
        """Select them."""
        count = sum(clean_up.propose(context, obj) for obj in edited_objects(context))
        return f"{count} splats are proposed. Remove deletes them, Cancel keeps them."


CLASSES = (SWAG_OT_clean_up,)
