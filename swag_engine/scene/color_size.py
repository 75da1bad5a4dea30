"""The width at which photos keep color: JPEG files usually have it at half the size of brightness."""

from pathlib import Path

from PIL import Image, JpegImagePlugin

from .cameras import Camera
from .colmap import Scene

LOOKED_AT = 6
"""Photos that are looked at, evenly spaced."""
NEARLY_FULL = 0.75
"""Fraction of a photo's width from which color at half the size is noticed in what is trained."""


def small_jpeg_note(scene: Scene, cameras: list[Camera]) -> str:
    """Say that the colors of photos that are JPEG files are less true, where training sees them at nearly full size.

    Details of red follow those of green there, so that red seems to fade less with range than it does (docs/colors.md).

    Args:
        scene: The scene.
        cameras: Cameras of the training images, at the width that they are trained at.

    Returns:
        A sentence for the user, empty where at most half of the photos are such files.
    """
    views = {view.name: view for view in scene.views}
    chosen = cameras[:: max(1, -(-len(cameras) // LOOKED_AT))]
    small = [camera for camera in chosen if _halves_color(views[camera.name].path, camera.width / NEARLY_FULL)]
    if 2 * len(small) <= len(chosen):
        return ""
    return (
        f"The photos are JPEG files, which keep color at half the size, and are trained at {small[0].width} pixels, "
        "nearly their full width: red then seems to fade less with range than it does. Larger photos give truer colors."
    )


def _halves_color(path: Path, narrower_than: float) -> bool:
    """Whether a file is a JPEG file of less than this width that keeps color at half of it."""
    try:
        with Image.open(path) as image:
            halved = isinstance(image, JpegImagePlugin.JpegImageFile) and JpegImagePlugin.get_sampling(image) in (1, 2)
            return halved and image.width < narrower_than
    except (OSError, ValueError, SyntaxError):  # PIL raises SyntaxError for damaged data
        return False
