"""The width at which photos still show all that they resolve: soft or enlarged photos show no more at full size."""

from collections.abc import Sequence

import cv2
import numpy as np

from .colmap import Scene
from .images import load_images

LOOKED_AT = 6
"""Photos that are looked at, evenly spaced."""
REDUCTIONS = (0.25, 0.35, 0.5, 0.7)
"""Fractions of the width that are tried."""
LOST = 1.0
"""Root mean square of the detail that a reduced photo may lose, in steps of 8 bits: less is not visible."""
SECOND_DIFFERENCE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
"""Of white noise of standard deviation 1 it leaves one of 6 (Immerkaer 1996)."""
LEAST_SIDE = 3
"""Pixels of the shorter side of a reduced photo, below which there is no pixel with neighbours on all sides."""
MAD_TO_SD = 1.4826
"""Standard deviation of normal values over their median absolute value."""


def resolved_width(scene: Scene, most: int) -> int:
    """Find the width from which on photos show no more detail.

    Args:
        scene: The scene.
        most: Width in pixels above which the answer does not matter.

    Returns:
        Pixels, at most `most` and at most the width of the photos.

    Raises:
        InputError: If a photo cannot be read.
    """
    full = max(view.camera.width for view in scene.views)
    side = min(min(view.camera.width, view.camera.height) for view in scene.views)
    parts = [part for part in REDUCTIONS if part * side >= LEAST_SIDE]
    candidates = [width for part in parts if (width := round(part * full)) < min(most, full)]
    if not candidates:
        return min(most, full)
    chosen = scene.views[:: max(1, -(-len(scene.views) // LOOKED_AT))]
    photos = [cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY) for image in load_images(scene, chosen, full)]
    return next((width for width in candidates if lost_detail(photos, width / full) <= LOST), min(most, full))


def lost_detail(photos: Sequence[np.ndarray], part: float) -> float:
    """Measure what photos lose when they are reduced and enlarged again, without their noise.

    Args:
        photos: (H, W) uint8 each.
        part: Width of the reduced photo as a fraction of its own.

    Returns:
        Root mean square of the difference, the median over the photos, in steps of 8 bits.
    """
    return float(np.median([_lost(photo.astype(np.float32), part) for photo in photos]))


def _lost(photo: np.ndarray, part: float) -> float:
    size = photo.shape[1], photo.shape[0]
    reduced = cv2.resize(photo, None, fx=part, fy=part, interpolation=cv2.INTER_AREA)
    lost = np.mean((photo - cv2.resize(reduced, size, interpolation=cv2.INTER_CUBIC)) ** 2)
    noise = MAD_TO_SD / 6 * np.median(np.abs(cv2.filter2D(photo, -1, SECOND_DIFFERENCE)[1:-1, 1:-1]))
    return float(np.sqrt(max(0.0, lost - noise**2 * (1 - part**2))))  # reducing averages that part of the noise away
