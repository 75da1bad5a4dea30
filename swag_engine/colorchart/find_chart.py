"""Find a color chart in an image, which way up it is, and which of its patches can be measured.

OpenCV proposes quadrilaterals. One is a chart if the linear light of enough patches is a gain times their known light
plus an offset, for each channel: what water, shadow and exposure make of a flat chart. The rotation that explains most
patches is the way up; patches that do not fit (covered, in shadow, mirroring) are left out.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize

from ..base.transfer import linear_of_bytes
from .chart_kinds import PATCH, ChartKind

SEARCH_SIZES = (1000, 2400)
"""Shorter side in pixels to which OpenCV's detector enlarges an image: the larger one finds small charts."""
MEASURED = 0.5
"""Fraction of a patch's side that is measured, around its centre."""
LEAST_FITTING = 0.4
"""Fraction of a chart's patches that must fit."""
TOLERANCE = (0.15, 0.03)
"""Largest misfit of a patch, as fractions of its own light (a chart is lit unevenly) and of that of a white patch."""
NOISE = 0.004
"""Linear light by which a patch may miss the fit in any case."""
LEAST_CONTRAST = 4.0
"""Standard deviation of the fitted light over that of the misfit, in two channels at least."""
SATURATED = 250
"""8-bit display value from which a channel is taken to be clipped."""


@dataclass(frozen=True, eq=False)
class ChartObservation:
    """A chart in one image.

    Attributes:
        kind: The chart.
        corners: Corners (4, 2) of its outline (`ChartKind.outline`) in pixels, the centre of the first pixel at 0.5.
        light: Mean linear light (N, 3) of the patches.
        spread: Standard deviation (N, 3) of the light within each patch.
        used: Patches (N,) bool that fit and are not clipped.
    """

    kind: ChartKind
    corners: np.ndarray
    light: np.ndarray
    spread: np.ndarray
    used: np.ndarray

    @property
    def centres(self) -> np.ndarray:
        """Centres (N, 2) of the patches in pixels."""
        return _place(self.kind, self.corners, self.kind.centres)

    @property
    def upside_down(self) -> bool:
        """Whether the chart's first row of patches is below its last one."""
        top, bottom = self.corners[:2].mean(0), self.corners[2:].mean(0)
        return bool(top[1] > bottom[1])


def find_chart(pixels: np.ndarray, valid: np.ndarray, kind: ChartKind) -> ChartObservation | None:
    """Find the chart in an image.

    Args:
        pixels: Display values (H, W, 3) uint8 sRGB.
        valid: Pixels to use (H, W) bool.
        kind: The chart to look for.

    Returns:
        The chart; None where none is found.
    """
    for corners in _proposals(pixels, kind):
        observation = chart_at(pixels, valid, kind, corners)
        if observation is not None:
            return observation
    return None


def chart_at(pixels: np.ndarray, valid: np.ndarray, kind: ChartKind, corners: np.ndarray) -> ChartObservation | None:
    """Measure the chart between four corners, and find out which corner is its top left one.

    Args:
        pixels: Display values (H, W, 3) uint8 sRGB.
        valid: Pixels to use (H, W) bool.
        kind: The chart.
        corners: Corners (4, 2) of the outline in pixels, in the order of walking around; good to half a patch.

    Returns:
        The chart with more exact corners; None if its patches are not there.
    """
    (a, b), (c, d) = corners[1] - corners[0], corners[2] - corners[1]
    if a * d < b * c:  # anticlockwise, but a chart is not seen from behind
        corners = corners[::-1]
    light = linear_of_bytes()[pixels].astype(np.float32)
    best: tuple[int, np.ndarray, np.ndarray] | None = None
    for turn in range(4):
        turned = np.roll(corners, -turn, axis=0)
        fitting = _fitting(kind, _samples(light, kind, turned, MEASURED).mean(1))
        if fitting is not None and (best is None or fitting.sum() > best[0]):
            best = int(fitting.sum()), turned, fitting
    if best is None:
        return None
    exact = _exact_corners(light, kind, *best[1:])
    patches = _samples(light, kind, exact, MEASURED)
    means = patches.mean(1)
    found = _fitting(kind, means)
    if found is None or found.sum() < LEAST_FITTING * len(means):
        return None
    clipped = (_samples(pixels.astype(np.float32), kind, exact, MEASURED) >= SATURATED).any((1, 2))
    masked = (_samples(valid[..., None].astype(np.float32), kind, exact, MEASURED) < 0.999).any((1, 2))
    return ChartObservation(kind, exact, means, patches.std(1), found & ~clipped & ~masked)


def measure(light: np.ndarray, observation: ChartObservation) -> np.ndarray:
    """Return the mean linear light (N, 3) of the patches of a chart in another image (H, W, 3) of the same camera."""
    return _samples(light.astype(np.float32), observation.kind, observation.corners, MEASURED).mean(1)


def _proposals(pixels: np.ndarray, kind: ChartKind) -> Iterator[np.ndarray]:
    """Yield corners (4, 2) of what may be a chart, from copies with more contrast: dim and blue photos need them."""
    low, high = np.percentile(pixels, (1, 99), axis=(0, 1))
    stretched = (np.clip((pixels - low) / np.maximum(high - low, 8), 0, 1) * 255).astype(np.uint8)
    lab = cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB)
    lab[..., 0] = cv2.createCLAHE(3.0, (8, 8)).apply(lab[..., 0])
    equalised = cv2.cvtColor(lab, cv2.COLOR_LAB2RGB)
    for size in SEARCH_SIZES:
        for copy in (pixels, stretched, equalised):
            detector = cv2.mcc.CCheckerDetector.create()
            if _detect(detector, copy[..., ::-1].copy(), kind, size):
                for chart in detector.getListColorChecker():
                    yield np.array(chart.getBox(), np.float64) + 0.5


def _detect(detector: Any, pixels: np.ndarray, kind: ChartKind, size: int) -> bool:
    """Search BGR pixels, made no smaller than `size`, for up to three charts, with OpenCV 4 or 5."""
    mcc: Any = cv2.mcc
    opencv5 = hasattr(detector, "setDetectionParams")
    parameters = mcc.DetectorParametersMCC() if opencv5 else mcc.DetectorParameters.create()
    parameters.minImageSize = size
    if not opencv5:
        return detector.process(pixels, kind.opencv_detector, 3, False, parameters)
    detector.setDetectionParams(parameters)
    detector.setColorChartType(kind.opencv_detector)
    return detector.process(pixels, 3)


def _place(kind: ChartKind, corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (..., 2) of a chart as pixels."""
    warp = cv2.getPerspectiveTransform(kind.outline.astype(np.float32), corners.astype(np.float32))
    homogeneous = points @ warp[:, :2].T + warp[:, 2]
    return homogeneous[..., :2] / homogeneous[..., 2:]


def _samples(planes: np.ndarray, kind: ChartKind, corners: np.ndarray, fraction: float) -> np.ndarray:
    """Read 7 x 7 values (N, 49, C) from the middle of each patch of an image (H, W, C)."""
    steps = np.linspace(-1, 1, 7) * fraction * PATCH / 2
    offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    x, y = np.moveaxis(_place(kind, corners, kind.centres[:, None] + offsets), -1, 0) - 0.5
    return np.stack(
        [map_coordinates(plane, (y, x), order=1, mode="nearest") for plane in np.moveaxis(planes, -1, 0)], -1
    )


def _lines(known: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gain and offset (3,) of the least-squares lines from known to measured light (N, 3)."""
    centred = known - known.mean(0)
    gain = (centred * measured).sum(0) / (centred**2).sum(0)
    gain = np.maximum(gain, 0)
    return gain, measured.mean(0) - gain * known.mean(0)


def _fitting(kind: ChartKind, measured: np.ndarray) -> np.ndarray | None:
    """Return which patches (N,) fit one gain and offset for each channel, None where too few do.

    Lines through two patches are tried, the one that most patches fit is then fitted to all these.
    """
    known = kind.light
    neutral = np.flatnonzero(kind.neutral)
    pairs = np.array([pair for pair in combinations(neutral, 2) if np.ptp(known[list(pair)], axis=0).min() > 0.08])
    colored = np.array(
        [pair for pair in combinations(range(len(known)), 2) if np.abs(np.subtract(*known[list(pair)])).min() > 0.1]
    )
    pairs = np.concatenate([pairs, colored])[:: max(1, len(colored) // 400)]
    first, second = pairs.T
    gain = np.maximum((measured[first] - measured[second]) / (known[first] - known[second]), 0)
    offset = measured[first] - gain * known[first]
    fits = _within(known, measured, gain[:, None], offset[:, None])
    # Of a chart that is half in shadow the lit half counts: as many patches fit each, and its gain is larger.
    score = fits.sum(1) * (1 + 0.15 * gain.sum(1) / max(gain.sum(1).max(), 1e-6))
    fitting = fits[score.argmax()]
    for _ in range(5):
        if fitting.sum() < LEAST_FITTING * len(known):
            return None
        line = _lines(known[fitting], measured[fitting])
        fitting = _within(known, measured, *line)
    if fitting.sum() < LEAST_FITTING * len(known):
        return None
    gain, offset = line
    misfit = (measured - gain * known - offset)[fitting].std(0)
    contrast = gain * known[fitting].std(0) / np.maximum(misfit, 1e-6)
    return fitting if (contrast > LEAST_CONTRAST).sum() >= 2 else None


def _within(known: np.ndarray, measured: np.ndarray, gain: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return which patches (..., N) lie on the lines in all channels."""
    allowed = gain * (TOLERANCE[0] * known + TOLERANCE[1]) + NOISE
    return (np.abs(measured - gain * known - offset) < allowed).all(-1)


def _exact_corners(light: np.ndarray, kind: ChartKind, corners: np.ndarray, fitting: np.ndarray) -> np.ndarray:
    """Move the corners so that almost whole patches have one light: their borders are seen."""
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean()
    unit = side / kind.size.mean()

    def unevenness(moves: np.ndarray) -> float:
        patches = _samples(light, kind, corners + moves.reshape(4, 2) * unit, 0.85)[fitting]
        # Square roots, so that dark patches count too.
        return float(np.sqrt(np.maximum(patches, 0)).std(1).mean())

    found = minimize(unevenness, np.zeros(8), method="Powell", bounds=[(-1.2, 1.2)] * 8, options={"maxfev": 600})
    return corners + found.x.reshape(4, 2) * unit
