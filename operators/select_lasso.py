"""Select the splats in a lasso of the view."""

from ..swag_blender.region_selection import LassoSelection


class SWAG_OT_select_lasso(LassoSelection):
    """Select splats by drawing around them in the viewport; Shift adds, Ctrl removes"""

    bl_idname = "swag.select_lasso"
    bl_label = "Select Lasso"


CLASSES = (SWAG_OT_select_lasso,)
