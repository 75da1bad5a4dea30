"""Select the splats in a circle of the view."""

from ..swag_blender.region_selection import CircleSelection


class SWAG_OT_select_circle(CircleSelection):
    """Select splats by dragging a circle from its middle in the viewport; Shift adds, Ctrl removes"""

    bl_idname = "swag.select_circle"
    bl_label = "Select Circle"


CLASSES = (SWAG_OT_select_circle,)
