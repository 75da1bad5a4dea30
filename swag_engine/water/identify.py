"""The water of a scene from its sparse points, before anything is trained.

A point seen from several ranges changes colour by the water between: per channel, in the light of the medium,
I = J exp(-beta_D r) + B (1 - exp(-beta_B r)), with a J of its own for every point. J is projected out and B follows in
closed form, so that only the two coefficients are searched, coarse to fine.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize

from ..scene.colmap import Points
from ..scene.images import TrainingImage
from .light import light_of_bytes

FIT_WIDTH = 640
"""Pixels that the photographs should at least be wide."""
FAR_WINDOW = 0.75
"""Half the width in pixels of the patch that a colour is averaged over in the farthest view of a point."""
MAX_WINDOW = 40
DARK_WINDOW = 9
"""Pixels of the square that the darkest light around a point is taken from."""
LEAST_OBSERVATIONS = 200
LEAST_RANGE_RATIO = 1.15
"""Of a point's farthest sighting to its nearest, that one point in twenty must have."""
LEAST_CHANGE = 0.10
"""Share of its colour that the scene's range must take from a channel."""
LEAST_VEIL = 0.02
"""Light that the water must add at the far end of the scene."""
GRID = np.geomspace(0.02, 6.0, 10)
"""Coefficients times the median range that are tried first."""


@dataclass(frozen=True)
class Observations:
    """M sightings of points: track (M,) index of the point, ranges (M,) in scene units, light (M, 3) linear.

    image (M,) index of the photograph; place (M, 2) where in it, from its middle to the right and down, the corners
    being at distance 1; darkest (M, 3) least light in a square of DARK_WINDOW pixels around the point.
    """

    track: np.ndarray
    ranges: np.ndarray
    light: np.ndarray
    image: np.ndarray
    place: np.ndarray
    darkest: np.ndarray

    @property
    def radius(self) -> np.ndarray:
        """(M,) distance from the photograph's middle, 1 at the corners."""
        return np.linalg.norm(self.place, axis=1)

    def __len__(self) -> int:
        return len(self.track)

    def take(self, chosen: np.ndarray) -> "Observations":
        """Those of an index or a mask (M,)."""
        return Observations(
            *(values[chosen] for values in (self.track, self.ranges, self.light, self.image, self.place, self.darkest))
        )


@dataclass(frozen=True)
class WaterFit:
    """beta_D, beta_B (3,) per scene unit and B (3,) in linear light, all (R, G, B).

    found: whether there is water to model; reason: why or why not, in one sentence with the figures behind it.
    """

    beta_D: np.ndarray
    beta_B: np.ndarray
    B: np.ndarray
    found: bool
    reason: str


def observe(images: Sequence[TrainingImage], point_indices: Sequence[np.ndarray], points: Points) -> Observations:
    """Linear light of the points where each image saw them; point_indices (P,) an image: which points.

    A colour is the mean over a patch whose width goes with 1 / range, so that all views average the same part of the
    world: a fixed window would wash far texture out and leave near texture, which looks like water. Points that fewer
    than two images see, and patches that reach beyond the image or over invalid pixels, are left out.
    """
    located = [_project(image, indices, points) for image, indices in zip(images, point_indices, strict=True)]
    farthest = np.zeros(len(points.positions))
    for indices, _, ranges in located:
        np.maximum.at(farthest, indices, ranges)
    parts = []
    for number, (image, (indices, pixels, ranges)) in enumerate(zip(images, located, strict=True)):
        half = np.minimum(FAR_WINDOW * farthest[indices] / ranges, MAX_WINDOW)
        colors, darkest, whole = _patches(image, pixels, half)
        size = np.array(image.valid.shape[::-1])
        place = (pixels - size / 2) / (np.linalg.norm(size) / 2)
        values = (indices, ranges, colors, np.full(len(indices), number), place, darkest)
        parts.append([value[whole] for value in values])
    together = Observations(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    seen = np.bincount(together.track, minlength=len(points.positions))
    return together.take(seen[together.track] > 1)


def _project(image: TrainingImage, indices: np.ndarray, points: Points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the points in front of the camera: index (P,), pixel (P, 2), Euclidean range (P,)."""
    camera = image.camera
    places = points.positions[indices] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    front = places[:, 2] > 0
    indices, places = indices[front], places[front]
    homogeneous = places @ camera.K.T
    return indices, homogeneous[:, :2] / homogeneous[:, 2:], np.linalg.norm(places, axis=1)


def _patches(image: TrainingImage, pixels: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean linear light (P, 3) of squares of half width `half` (P,) around pixels (P, 2), the darkest (P, 3) around
    them, and which squares (P,) lie whole in valid pixels."""
    height, width = image.valid.shape
    to_light = light_of_bytes()
    planes = np.concatenate([to_light[image.pixels], image.valid[..., None]], axis=2)
    sums = cv2.integral(planes)
    low = np.round(pixels - half[:, None]).astype(int)
    high = np.maximum(np.round(pixels + half[:, None]).astype(int), low + 1)
    whole = (low >= 0).all(1) & (high[:, 0] <= width) & (high[:, 1] <= height)
    (x0, y0), (x1, y1) = np.where(whole, low.T, 0), np.where(whole, high.T, 1)
    means = (sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0]) / ((x1 - x0) * (y1 - y0))[:, None]
    least = to_light[cv2.erode(image.pixels, np.ones((DARK_WINDOW, DARK_WINDOW), np.uint8))]
    column, row = (np.clip(pixels.astype(int), 0, [width - 1, height - 1])).T
    return means[:, :3], least[row, column], whole & (means[:, 3] > 0.999)


def track_ratio(observations: Observations) -> np.ndarray:
    """Farthest over nearest range of each point that has sightings."""
    _, track = np.unique(observations.track, return_inverse=True)
    nearest, farthest = np.full(track.max() + 1, np.inf), np.zeros(track.max() + 1)
    np.minimum.at(nearest, track, observations.ranges)
    np.maximum.at(farthest, track, observations.ranges)
    return farthest / nearest


def fit_water(observations: Observations) -> WaterFit:
    """Least squares, the worst tenth of the points left out the second time.

    Water is found where it takes LEAST_CHANGE of a channel between the 5th and the 95th percentile of the ranges and
    adds LEAST_VEIL there; light that only falls off, and falls off alike in all channels, is a lamp.
    """
    if len(observations.track) < LEAST_OBSERVATIONS:
        return _nothing(f"The water cannot be told: only {len(observations.track)} sightings of points can be used.")
    ranges, light = observations.ranges, observations.light
    near, unit, far = np.quantile(ranges, (0.05, 0.5, 0.95))
    ratio = np.quantile(track_ratio(observations), 0.95)
    if ratio < LEAST_RANGE_RATIO:
        return _nothing(
            f"The water cannot be told: points are seen from ranges of ratio {ratio:.2f} at most "
            f"({LEAST_RANGE_RATIO} at least)."
        )
    _, track = np.unique(observations.track, return_inverse=True)
    first = [_fit_channel(track, ranges / unit, light[:, c])[3] for c in range(3)]
    worst = sum(np.bincount(track, residual**2) / max(np.sum(residual**2), 1e-30) for residual in first)
    good = (worst <= np.quantile(worst, 0.9))[track]
    _, kept = np.unique(track[good], return_inverse=True)
    channels = [_fit_channel(kept, ranges[good] / unit, light[good, c])[:3] for c in range(3)]
    beta_D, beta_B, B = (np.array(values) for values in zip(*channels, strict=True))
    beta_D, beta_B = beta_D / unit, beta_B / unit
    change = 1 - np.exp(-beta_D * (far - near))
    veil = B * (1 - np.exp(-beta_B * far))
    figures = (
        f"it takes {change.max():.0%} of the light between {near:.3g} and {far:.3g} scene units "
        f"({LEAST_CHANGE:.0%} at least) and adds {veil.max():.2f} of it there ({LEAST_VEIL} at least)."
    )
    found = bool(change.max() >= LEAST_CHANGE and veil.max() >= LEAST_VEIL)
    return WaterFit(beta_D, beta_B, B, found, f"{'Water' if found else 'No water'} is modelled: {figures}")


def _nothing(reason: str) -> WaterFit:
    return WaterFit(np.zeros(3), np.zeros(3), np.zeros(3), False, reason)


def _fit_channel(track: np.ndarray, ranges: np.ndarray, light: np.ndarray) -> tuple[float, float, float, np.ndarray]:
    """beta_D, beta_B (per unit of `ranges`) and B of one channel, and the residuals (M,)."""

    def solve(beta_D: float, beta_B: float) -> tuple[float, np.ndarray]:
        """B and the residuals with every point's J projected out."""
        transmission = np.exp(-beta_D * ranges)
        length = np.bincount(track, transmission**2)

        def without_J(values: np.ndarray) -> np.ndarray:
            return values - transmission * (np.bincount(track, transmission * values) / length)[track]

        seen, veil = without_J(light), without_J(1 - np.exp(-beta_B * ranges))
        B = float(np.clip(veil @ seen / max(veil @ veil, 1e-12), 0, 1))
        return B, seen - B * veil

    def loss(logs: np.ndarray) -> float:
        return float(np.sum(solve(*np.exp(np.clip(logs, -9, 3)))[1] ** 2))

    start = min(itertools.product(np.log(GRID), repeat=2), key=lambda logs: loss(np.array(logs)))
    found = minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 0})
    beta_D, beta_B = np.exp(np.clip(found.x, -9, 3))
    B, residual = solve(beta_D, beta_B)
    return beta_D, beta_B, B, residual
