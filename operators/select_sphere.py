"""Select the splats in a sphere around one of them."""

from ..swag_blender.point_selection import SphereSelection


class SWAG_OT_select_sphere(SphereSelection):
    """Select the splats in a sphere around the one that you click; a drag or the wheel changes its size"""

    bl_idname = "swag.select_sphere"
    bl_label = "Select Sphere"


CLASSES = (SWAG_OT_select_sphere,)
