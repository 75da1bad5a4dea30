"""Write the areas of the labels of the run of the splats, and show the label map."""

from ..swag_blender.map_job import MapJob


class SWAG_OT_make_areas(MapJob):
    """Measure the area of each label of the run: a table with errors, a label map and outlines"""

    bl_idname = "swag.make_areas"
    bl_label = "Areas by Label"
    kind = "areas"


CLASSES = (SWAG_OT_make_areas,)
