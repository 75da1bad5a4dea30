"""Write the heights of the run of the splats, and show them."""

from ..swag_blender.map_job import MapJob


class SWAG_OT_make_heights(MapJob):
    """Write a GeoTIFF of the heights of the run of the splats; places that no photo shows stay empty"""

    bl_idname = "swag.make_heights"
    bl_label = "Heights"
    kind = "dem"


CLASSES = (SWAG_OT_make_heights,)
