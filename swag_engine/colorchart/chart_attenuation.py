"""Attenuation of the water from a chart alone: how its patches lose light with range, whatever the run's fit says."""

from dataclasses import dataclass

import numpy as np

from .chart_kinds import ChartKind

LEAST_IMAGES = 3
"""Images from which a slope has an error."""
LEAST_RATIO = 1.15
"""Farthest over nearest range."""


@dataclass(frozen=True, eq=False)
class ChartAttenuation:
    """Attenuation from a chart.

    Attributes:
        beta_D: (3,) per scene unit, None where it cannot be determined.
        error: Standard error (3,) of `beta_D`.
        problem: A sentence that says why it cannot be determined, else "".
    """

    beta_D: np.ndarray | None
    error: np.ndarray | None
    problem: str = ""


def chart_attenuation(measured: np.ndarray, used: np.ndarray, ranges: np.ndarray, kind: ChartKind) -> ChartAttenuation:
    """Estimate attenuation from the patches of one chart in V images.

    In each image the light of the patches is a gain times their known light plus the backscatter. The logarithm of the
    gain falls with range by beta_D.

    Args:
        measured: Linear light (V, N, 3) of the patches in the photos, at one exposure.
        used: Patches (V, N) to use.
        ranges: Ranges (V, N), scene units.
        kind: The chart.

    Returns:
        The attenuation.
    """
    logs, distances = [], []
    for light, chosen, far in zip(measured, used, ranges, strict=True):
        if chosen.sum() < 4:
            continue
        known = kind.light[chosen] - kind.light[chosen].mean(0)
        gain = (known * light[chosen]).sum(0) / (known**2).sum(0)
        logs.append(np.log(np.where(gain > 0, gain, np.nan)))
        distances.append(far[chosen].mean())
    if len(logs) < LEAST_IMAGES:
        return ChartAttenuation(None, None, f"Attenuation needs the chart in {LEAST_IMAGES} photos at least.")
    r, y = np.array(distances), np.array(logs)
    if r.max() / r.min() < LEAST_RATIO:
        return ChartAttenuation(
            None,
            None,
            f"Attenuation needs photos of the chart from different distances: the farthest is {r.max() / r.min():.2f} "
            f"times the nearest (at least {LEAST_RATIO}).",
        )
    centred = r - r.mean()
    slope = centred @ y / (centred @ centred)
    residual = y - y.mean(0) - centred[:, None] * slope
    error = np.sqrt((residual**2).sum(0) / (len(r) - 2) / (centred @ centred))
    return ChartAttenuation(-slope, error)
