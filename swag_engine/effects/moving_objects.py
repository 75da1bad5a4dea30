"""What moved between photographs, by what training leaves unexplained.

Where everything that stands still has been learned, a fish leaves a patch of large residual in one photograph. Noise
and edges leave single pixels and lines, which opening takes away.
"""

import cv2
import numpy as np

LEAST_RESIDUAL, LEAST_EXCESS = 0.08, 4.0
"""Display value that a residual must exceed, and how many times the photograph's usual residual."""
GRAIN = 0.01
"""Share of the width below which nothing counts as an object."""
LEAST_AREA, LEAST_IMAGES = 0.01, 0.10
"""Share of a photograph that must be covered, and share of the photographs in which it is."""


def moving_mask(photograph: np.ndarray, picture: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool of a photograph that the picture of all that stands still does not explain.

    photograph and picture (H, W, 3) display values 0..1, valid (H, W) bool; invalid pixels are never in the mask. The
    brightness of the whole is not compared, for exposure is no object.
    """
    difference = (photograph - picture).astype(np.float32)
    if not valid.any():
        return np.zeros(valid.shape, bool)
    difference -= np.median(difference[valid], axis=0)
    residual = np.where(valid, np.abs(difference).mean(2), 0).astype(np.float32)
    grain = max(3, round(GRAIN * valid.shape[1]) | 1)
    smooth = cv2.blur(residual, (grain, grain))
    usual = float(np.median(smooth[valid]))
    large = (smooth > max(LEAST_RESIDUAL, LEAST_EXCESS * usual)).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (grain, grain))
    whole = cv2.morphologyEx(cv2.morphologyEx(large, cv2.MORPH_CLOSE, disc), cv2.MORPH_OPEN, disc, iterations=2)
    return (cv2.dilate(whole, disc) > 0) & valid


def share_with_objects(masks: list[np.ndarray]) -> float:
    """Share of the photographs whose mask covers LEAST_AREA of them; LEAST_IMAGES of them make the effect count."""
    return float(np.mean([mask.mean() > LEAST_AREA for mask in masks])) if masks else 0.0
