"""What photos lose as JPEG files: the details of color at half the size, and some of all details."""

import io
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, JpegImagePlugin

from .cameras import Camera
from .colmap import Scene

LOOKED_AT = 6
"""Photos that are looked at, evenly spaced."""
NEARLY_FULL = 0.75
"""Fraction of a photo's width from which color at half the size is noticed in what is trained."""
ROUNDING_SHARE = 0.2
"""Variance of the error of a coefficient over step^2 / 12, that of rounding what is larger than a step. Most are
smaller and become 0. In detailed parts of four generated scenes it was .03 to 1.9 (files of quality 91)."""
MOST_REDUCED = 2.0
"""Pixels of a photo for one of an image, along each side, up to which `change_by_compression` looks at it: where an
image is reduced more, each of its pixels is the mean of several values of color."""
BLOCK = 8
"""Coefficients that JPEG has along each side of a block, as many as pixels of the channel."""


def compression_variance(path: Path, width: int) -> np.ndarray:
    """Estimate by how much compression changes details of a photo that is reduced to a width.

    JPEG rounds the cosine transform of each block of brightness Y and of the colors Cb and Cr, which are often at half
    the size, to multiples of the steps in the file. Reducing an image averages the changes.

    Args:
        path: The photo.
        width: The width, pixels.

    Returns:
        (3,) variance of Y, Cb and Cr, display values; 0 for files that are not JPEG, or that are damaged.
    """
    image = _jpeg(path)
    if image is None or any(table not in image.quantization for *_, table in image.layer):
        return np.zeros(3)
    reduced = max(1.0, image.width / width)
    variances = [
        _variance(np.array(image.quantization[table], float), reduced, image.layer[0][1:3], (across, down))
        for _, across, down, table in image.layer[:3]
    ]
    return np.array(variances + [0.0] * (3 - len(variances)))


def change_by_compression(path: Path, display: np.ndarray) -> np.ndarray:
    """Compress an image as a photo was compressed, and return what that changes.

    Args:
        path: The photo.
        display: Display values (H, W, 3) in 0..1 of an image that shows the same, at the size of the photo or reduced.

    Returns:
        (H, W, 3) change of the display values; 0 for photos that are not JPEG or that are damaged, and where the image
        is reduced more than MOST_REDUCED.
    """
    height, width = display.shape[:2]
    photo = _jpeg(path)
    if photo is None or photo.width > MOST_REDUCED * width:
        return np.zeros_like(display)
    size = (photo.width, round(height * photo.width / width))
    before = (255 * cv2.resize(display, size)).round().clip(0, 255).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(before).convert(photo.mode).save(
        file, "JPEG", qtables=photo.quantization, subsampling=JpegImagePlugin.get_sampling(photo)
    )
    after = np.asarray(Image.open(file).convert("RGB"))
    change = (after.astype(np.float32) - before) / np.float32(255)
    return cv2.resize(change, (width, height), interpolation=cv2.INTER_AREA)


def _jpeg(path: Path) -> JpegImagePlugin.JpegImageFile | None:
    """Read the header of a JPEG file; None for other and for damaged files."""
    try:
        with Image.open(path) as image:
            return image if isinstance(image, JpegImagePlugin.JpegImageFile) else None
    except (OSError, ValueError, SyntaxError):  # PIL raises SyntaxError for damaged data
        return None


def _variance(steps: np.ndarray, reduced: float, whole: Sequence[int], sampled: Sequence[int]) -> float:
    """Variance of a channel in a reduced image.

    Args:
        steps: (64,) of the coefficients, 8-bit steps.
        reduced: Pixels of the photo for one of the image, along each side.
        whole: Samples of brightness along x and y in a block of all channels.
        sampled: Those of this channel.
    """
    passed = [  # the fraction of a wave that is left in the mean over a pixel of the image
        np.sinc(reduced * np.arange(BLOCK) * part / (2 * BLOCK * full)) ** 2
        for full, part in zip(whole, sampled, strict=True)
    ]
    rounding = np.square(steps.reshape(BLOCK, BLOCK) / 255) / 12
    return float(ROUNDING_SHARE * (passed[1] @ rounding @ passed[0]) / BLOCK**2)


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
    image = _jpeg(path)
    return image is not None and JpegImagePlugin.get_sampling(image) in (1, 2) and image.width < narrower_than
