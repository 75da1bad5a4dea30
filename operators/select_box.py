"""Select the splats in a box of the view."""

from ..swag_blender.region_selection import BoxSelection


class SWAG_OT_select_box(BoxSelection):
    """Select splats by dragging a box in the viewport; Shift adds, Ctrl removes"""

    bl_idname = "swag.select_box"
    bl_label = "Select Box"


CLASSES = (SWAG_OT_select_box,)
