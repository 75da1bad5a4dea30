"""Read position, range, label and opacity of the splat under the pointer."""

from ..swag_blender.point_tools import ReadTool


class SWAG_OT_read_point(ReadTool):
    """Show position, range, label and opacity of the splat under the pointer"""

    bl_idname = "swag.read_point"
    bl_label = "Read Point"


CLASSES = (SWAG_OT_read_point,)
