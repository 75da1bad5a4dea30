"""Remove what Clean Up has proposed, or keep it."""

from typing import Annotated

import bpy
from bpy.props import BoolProperty

from ..swag_blender import clean_up
from ..swag_blender.blender_types import with_properties
from ..swag_blender.operator_base import SplatsOperator


@with_properties
class SWAG_OT_finish_clean_up(SplatsOperator):
    """Delete the selected splats, or keep them, and end the proposal of Clean Up"""

    bl_idname = "swag.finish_clean_up"
    bl_label = "Finish Clean Up"

    remove: Annotated[
        bool, BoolProperty(name="Remove", description="Delete the selected splats instead of deselecting them")
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a proposal."""
        cls.poll_message_set("Press Clean Up first")
        return bool(clean_up.proposed_objects(context))

    def work(self, context: bpy.types.Context) -> str:
        """Delete or deselect them."""
        count = clean_up.finish(clean_up.proposed_objects(context), self.remove)
        return f"{count} splats deleted." if self.remove else ""


CLASSES = (SWAG_OT_finish_clean_up,)
