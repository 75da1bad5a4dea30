"""What changed between two surveys on one grid: which differences of height and color can be told at 95 %."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from .geotiff import NO_LABEL
from .heights import gradients

TOLD = 1.96
"""Standard deviations of a difference told at 95 % (level of detection, Lane et al. 2003, doi 10.1002/esp.483)."""
LEAST_PIXELS = 20
"""Smallest number of pixels of a changed object."""
OPENING = 3
"""Edge, pixels, of what must fit into an object: thinner ones are seams at steps."""
SMOOTHING = 3
"""Edge of the median filter over differences, pixels."""
SCATTER = 0.5
"""Error of horizontal places in pixels: each survey samples a step of the surface differently."""
FLAGS = {0: "no change told", 1: "higher", 2: "lower", 3: "color", 4: "label"}
"""Values of the map of changes."""


@dataclass(frozen=True, eq=False)
class Survey:
    """One survey on the grid.

    Attributes:
        colors: (H, W, 3) display values.
        heights: (H, W) median heights, NaN where nothing was seen.
        labels: (H, W) uint8, NO_LABEL where nothing was seen; None where the survey has no labels.
    """

    colors: np.ndarray
    heights: np.ndarray
    labels: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Changes:
    """Differences between two surveys.

    Attributes:
        height: (H, W) later minus earlier height, NaN where one was not seen.
        height_limit: (H, W) smallest difference that is told at 95 %.
        color: (H, W) difference of color after the light of the later survey is matched to the earlier, NaN likewise.
        color_limit: Smallest difference of color that is told at 95 %.
        flags: (H, W) uint8 values of FLAGS, NO_LABEL where one survey saw nothing.
        objects: A dict for each changed object.
    """

    height: np.ndarray
    height_limit: np.ndarray
    color: np.ndarray
    color_limit: float
    flags: np.ndarray
    objects: list[dict[str, Any]]


def find_changes(before: Survey, after: Survey, pixel: float, residual: float) -> Changes:
    """Compare two surveys.

    The noise of heights is estimated from the differences themselves, robustly: most of a place is static. To it comes
    what an error of place makes of steps and slopes: the range of heights within a pixel and its neighbours.

    Args:
        before: The earlier survey.
        after: The later one, aligned.
        pixel: Edge of a pixel.
        residual: Residual of the alignment, the unit of heights.
    """
    known = np.isfinite(before.heights) & np.isfinite(after.heights)
    height = np.where(known, after.heights - before.heights, np.nan)
    place = np.hypot(SCATTER * pixel, residual)
    slope = np.maximum(_steepness(before.heights, pixel), _steepness(after.heights, pixel))
    noise = _spread(height[known])
    limit = TOLD * np.sqrt(noise**2 + residual**2 + (slope * place) ** 2)
    smooth = _median(height)
    color, color_limit = _color_difference(before, after, known)
    flags = np.where(known, 0, NO_LABEL).astype(np.uint8)
    labels_differ = np.zeros(known.shape, bool)
    if before.labels is not None and after.labels is not None:
        labels_differ = known & (before.labels != after.labels) & (before.labels > 0) & (after.labels > 0)
        labels_differ &= (before.labels != NO_LABEL) & (after.labels != NO_LABEL)
    masks = {
        1: known & (smooth > limit),
        2: known & (smooth < -limit),
        4: labels_differ,
        3: known & (_median(color) > color_limit),
    }
    objects: list[dict[str, Any]] = []
    for flag, mask in masks.items():
        for chosen in _objects(mask & (flags == 0)):
            flags[chosen] = flag
            objects.append(_describe(chosen, flag, before, after, height, color, limit, pixel))
    return Changes(height, limit, color, color_limit, flags, objects)


def label_transitions(before: Survey, after: Survey, pixel: float) -> dict[tuple[int, int], float]:
    """Return the area that went from one label to another, by pairs of labels; empty without labels."""
    if before.labels is None or after.labels is None:
        return {}
    known = (before.labels != NO_LABEL) & (after.labels != NO_LABEL)
    pairs, counts = np.unique(np.stack([before.labels[known], after.labels[known]]), axis=1, return_counts=True)
    return {(int(a), int(b)): float(count) * pixel**2 for (a, b), count in zip(pairs.T, counts, strict=True)}


def _steepness(heights: np.ndarray, pixel: float) -> np.ndarray:
    """Largest slope to a neighbour within two pixels, 0 where it is not known."""
    down, right = gradients(heights, pixel)
    steep = np.nan_to_num(np.hypot(down, right))
    return cv2.dilate(steep, np.ones((3, 3)))


def _spread(values: np.ndarray) -> float:
    """Robust standard deviation about 0 of values of which most are noise."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values)))) if len(values) else 0.0


def _median(values: np.ndarray) -> np.ndarray:
    """Median filter; holes are filled by the nearest rows for it and stay holes."""
    holes = ~np.isfinite(values)
    filtered = cv2.medianBlur(np.where(holes, 0, values).astype(np.float32), SMOOTHING)
    return np.where(holes, np.nan, filtered)


def _color_difference(before: Survey, after: Survey, known: np.ndarray) -> tuple[np.ndarray, float]:
    """Difference (H, W) of colors, the later ones matched to the earlier by a robust affine map, and its limit."""
    first, second = before.colors[known].astype(np.float64), after.colors[known].astype(np.float64)
    color = np.full(known.shape, np.nan)
    if len(first) < LEAST_PIXELS:
        return color, np.inf
    design = np.concatenate([second, np.ones((len(second), 1))], axis=1)
    weights = np.ones(len(first))
    for _ in range(5):
        solution = np.linalg.lstsq(design * weights[:, None], first * weights[:, None], rcond=None)[0]
        distances = np.linalg.norm(design @ solution - first, axis=1)
        weights = (distances <= 2 * np.median(distances) + 1e-9).astype(np.float64)
    color[known] = distances
    middle = float(np.median(distances))
    return color, max(middle + 3 * TOLD * _spread(distances), 0.05)


def _objects(mask: np.ndarray) -> list[np.ndarray]:
    """Masks of the connected parts of a mask that are large and thick enough."""
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((OPENING, OPENING), np.uint8))
    count, numbers = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    sizes = np.bincount(numbers.ravel(), minlength=count)
    cores = np.bincount(numbers.ravel(), opened.ravel(), minlength=count)
    chosen = [n for n in range(1, count) if sizes[n] >= LEAST_PIXELS and cores[n] >= LEAST_PIXELS / 2]
    return [numbers == n for n in chosen]


def _describe(
    chosen: np.ndarray,
    flag: int,
    before: Survey,
    after: Survey,
    height: np.ndarray,
    color: np.ndarray,
    limit: np.ndarray,
    pixel: float,
) -> dict[str, Any]:
    """Describe a changed object; row and column are of its middle."""
    rows, columns = np.nonzero(chosen)
    count = len(rows)
    labels = [
        int(np.bincount(survey.labels[chosen]).argmax()) if survey.labels is not None else None
        for survey in (before, after)
    ]
    return {
        "change": FLAGS[flag],
        "row": float(rows.mean()),
        "column": float(columns.mean()),
        "pixels": count,
        "area": count * pixel**2,
        "height_change": float(height[chosen].mean()),
        "height_limit": float(limit[chosen].mean()),
        "volume_change": float(height[chosen].sum()) * pixel**2,
        "color_change": float(color[chosen].mean()),
        "label_before": labels[0],
        "label_after": labels[1],
    }
