"""Write the orthomosaic of the run of the splats, and show it."""

from ..swag_blender.map_job import MapJob


class SWAG_OT_make_orthomosaic(MapJob):
    """Write a GeoTIFF of the run of the splats along parallel rays, with the water that the viewport shows"""

    bl_idname = "swag.make_orthomosaic"
    bl_label = "Orthomosaic"
    kind = "ortho"


CLASSES = (SWAG_OT_make_orthomosaic,)
