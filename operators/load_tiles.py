"""Load tiles of a survey: the finest for a view or a box, or one level of all of it."""

from collections.abc import Sequence
from typing import Annotated

import bpy
from bpy.props import FloatVectorProperty, IntVectorProperty

from ..swag_blender import survey
from ..swag_blender.blender_types import OperatorResult, with_properties
from ..swag_blender.operator_base import SplatOperator
from ..swag_blender.viewport_tool import view_of
from ..swag_blender.visibility import View


class TileOperator(SplatOperator):
    """Operator on the splats of a survey. Tiles that stay loaded keep what was done to their splats."""

    # Without REGISTER: Adjust Last Operation has nothing to adjust, and would read the tiles again.
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object is the splats of a survey."""
        cls.poll_message_set("Select the splats of a survey first")
        return survey.holds_tiles(context.active_object)


@with_properties
class SWAG_OT_load_view(TileOperator):
    """Load finer tiles for what the 3D viewport shows, and the coarsest elsewhere"""

    bl_idname = "swag.load_view"
    bl_label = "Load View"

    matrix: Annotated[
        Sequence[float],
        FloatVectorProperty(
            name="Matrix",
            description="Rows of the matrix from the world to the clip space of the view",
            size=16,
            options={"HIDDEN", "SKIP_SAVE"},
        ),
    ]
    size: Annotated[
        Sequence[int],
        IntVectorProperty(
            name="Size", description="Width and height of the view in pixels", size=2, options={"HIDDEN", "SKIP_SAVE"}
        ),
    ]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Take the view of the 3D viewport that the button belongs to."""
        regions = context.area.regions if context.area is not None and context.area.type == "VIEW_3D" else ()
        region = next((region for region in regions if region.type == "WINDOW"), None)
        if region is None:
            self.report({"ERROR"}, "There is no 3D viewport here: start Load View in one.")
            return {"CANCELLED"}
        view = view_of(region)
        self.matrix, self.size = [value for row in view.matrix.tolist() for value in row], (view.width, view.height)
        return self.execute(context)

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Load them."""
        return survey.load_view(context, obj, View.of_matrix(self.matrix, *self.size))


class SWAG_OT_load_box(TileOperator):
    """Load the finest tiles in the bounds of the chosen box, and the coarsest elsewhere"""

    bl_idname = "swag.load_box"
    bl_label = "Load Box"

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Load them."""
        return survey.load_box(context, obj)


class SWAG_OT_load_overview(TileOperator):
    """Load the finest level of detail that fits the number of splats for the whole survey, as when it was opened"""

    bl_idname = "swag.load_overview"
    bl_label = "Load Overview"

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Load it."""
        return survey.load_overview(context, obj)


CLASSES = (SWAG_OT_load_view, SWAG_OT_load_box, SWAG_OT_load_overview)
