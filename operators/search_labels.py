"""Find splats by words."""

from typing import Annotated

import bpy
from bpy.props import StringProperty

from ..swag_blender import labelling, labels
from ..swag_blender.blender_types import with_properties
from ..swag_blender.operator_base import SplatOperator


@with_properties
class SWAG_OT_search_labels(SplatOperator):
    """Find splats by words: writes swag:similarity and selects the splats above the threshold"""

    bl_idname = "swag.search_labels"
    bl_label = "Search Splats"
    # Without REGISTER: Adjust Last Operation would ask the engine's text network again at each key.
    bl_options = {"UNDO"}

    words: Annotated[str, StringProperty(name="Search", description="What to look for; empty: the words in the panel")]

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Search and select."""
        return f"{labelling.search(obj, self.words or labels.labels_of(obj).words)} splats selected."


CLASSES = (SWAG_OT_search_labels,)
