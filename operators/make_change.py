"""Compare the run of the splats with a later one, and show what changed."""

from ..swag_blender.map_job import MapJob


class SWAG_OT_make_change(MapJob):
    """Align a later run of the same place to this one, and map what changed"""

    bl_idname = "swag.make_change"
    bl_label = "Change"
    kind = "change"


CLASSES = (SWAG_OT_make_change,)
