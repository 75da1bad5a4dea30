"""Select splats by painting over them with a brush."""

from ..swag_blender.region_selection import BrushSelection


class SWAG_OT_select_brush(BrushSelection):
    """Select splats by painting with a brush in the viewport; the mouse wheel changes its size"""

    bl_idname = "swag.select_brush"
    bl_label = "Select Brush"


CLASSES = (SWAG_OT_select_brush,)
