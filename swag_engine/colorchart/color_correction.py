"""White balance, exposure and a matrix that bring measured patches of a chart to their known colors."""

from dataclasses import dataclass

import numpy as np

from ..base.color_difference import delta_e_2000, lab
from ..base.transfer import LUMINANCE, linear_to_srgb
from .chart_kinds import ChartKind

RIDGE = 0.005
"""Weight that pulls the matrix to no change, in weights of the patches, so that few patches change colors little."""
DARK = 0.03
"""Linear light that is added before patches are weighted: errors of dark patches are seen more, down to this."""
ZERO_SUMS = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, -2.0]]) / np.sqrt([[2.0], [6.0]])
"""Orthonormal rows whose numbers sum to 0: a matrix changed by multiples of these keeps grey grey."""


@dataclass(frozen=True, eq=False)
class ColorCorrection:
    """A linear correction: light becomes 2^exposure times white times (matrix @ light).

    Attributes:
        exposure: Stops.
        white: Gains (3,) of red, green and blue; their luminance is 1.
        matrix: (3, 3), rows sum to 1.
    """

    exposure: float
    white: np.ndarray
    matrix: np.ndarray

    def apply(self, light: np.ndarray) -> np.ndarray:
        """Correct linear light (..., 3)."""
        return 2.0**self.exposure * self.white * (light @ self.matrix.T)


def fit_correction(measured: np.ndarray, used: np.ndarray, kind: ChartKind) -> ColorCorrection | None:
    """Fit a correction to the patches of a chart.

    The gains are fitted to the grey patches (to all patches where no grey one is used), then the matrix to all patches:
    by least squares, with rows that keep grey, and with a weight for no change.

    Args:
        measured: Linear light (V, N, 3) of the patches in V images.
        used: Patches (V, N) to use.
        kind: The chart.

    Returns:
        The correction, None where no patches are used, or they are black.
    """
    known = np.broadcast_to(kind.light, measured.shape)
    grey = used & kind.neutral
    chosen = grey if grey.any() else used
    power = (measured[chosen] ** 2).sum(0)
    gains = (measured[chosen] * known[chosen]).sum(0) / np.maximum(power, 1e-12)
    if not chosen.any() or (gains <= 0).any() or (power < 1e-10).any():
        return None
    balanced, target = measured[used] * gains, known[used]
    weight = (1 / (target @ LUMINANCE + DARK))[:, None] ** (2 / 3)
    weight /= np.sqrt((weight**2).mean())
    design = weight * (balanced @ ZERO_SUMS.T)
    normal = design.T @ design / len(design) + RIDGE * (target**2).mean() * np.eye(2)
    change = np.linalg.solve(normal, design.T @ (weight * (target - balanced)) / len(design)).T @ ZERO_SUMS
    total = (np.eye(3) + change) * gains
    sums = total.sum(1)
    if (sums <= 0).any():
        total, sums = np.diag(gains), gains
    brightness = float(sums @ LUMINANCE)
    return ColorCorrection(float(np.log2(brightness)), sums / brightness, total / sums[:, None])


def differences(light: np.ndarray, kind: ChartKind) -> np.ndarray:
    """Return the CIE delta E 2000 (V, N) of patches of linear light (V, N, 3) from their known colors."""
    shown, known = (lab(linear_to_srgb(np.clip(values, 0, 1))) for values in (light, kind.light))
    return delta_e_2000(shown, np.broadcast_to(known, shown.shape))


def left_out_patches(measured: np.ndarray, used: np.ndarray, kind: ChartKind) -> np.ndarray:
    """Return delta E (V, N) of each patch by the correction that all other patches give; NaN where not used."""
    result = np.full(used.shape, np.nan)
    for patch in np.flatnonzero(used.any(0)):
        others = used.copy()
        others[:, patch] = False
        if correction := fit_correction(measured, others, kind):
            result[:, patch] = differences(correction.apply(measured), kind)[:, patch]
    return np.where(used, result, np.nan)


def left_out_images(measured: np.ndarray, used: np.ndarray, kind: ChartKind) -> np.ndarray:
    """Return delta E (V, N) of the patches of each image by the correction that all other images give; else NaN."""
    result = np.full(used.shape, np.nan)
    for image in range(len(measured)):
        others = used.copy()
        others[image] = False
        if correction := fit_correction(measured, others, kind):
            result[image] = differences(correction.apply(measured[image : image + 1]), kind)[0]
    return np.where(used, result, np.nan)
