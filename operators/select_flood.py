"""Select connected splats of similar color."""

from ..swag_blender.point_selection import FloodSelection


class SWAG_OT_select_flood(FloodSelection):
    """Select the connected splats of similar color and the same label around the one that you click"""

    bl_idname = "swag.select_flood"
    bl_label = "Select Flood"


CLASSES = (SWAG_OT_select_flood,)
