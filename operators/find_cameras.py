"""Find the cameras of photos or of a video, and import them."""

from ..swag_blender.find_cameras import JOB, PhotosJob


class SWAG_OT_find_cameras(PhotosJob):
    """Find out from which place each photo was taken, and import the cameras"""

    bl_idname = "swag.find_cameras"
    bl_label = "Find Cameras"
    job = JOB
    heavy = True


CLASSES = (SWAG_OT_find_cameras,)
