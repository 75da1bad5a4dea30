"""Select splats by painting over them with a circle."""

from ..swag_blender.region_selection import CircleSelection


class SWAG_OT_select_circle(CircleSelection):
    """Select splats by painting with a circle in the viewport; the mouse wheel changes its size"""

    bl_idname = "swag.select_circle"
    bl_label = "Select Circle"


CLASSES = (SWAG_OT_select_circle,)
