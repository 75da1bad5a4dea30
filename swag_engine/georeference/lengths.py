"""Scale from lengths that are known in metres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.errors import InputError
from .similarity import leave_one_out

LEAST_ERROR = 0.002
"""Relative error that every length has at least, from printing, tape and poses: no single one decides alone."""
OUTLIER = 4.0
"""Standard deviations from the median beyond which a length is left out."""
LEAST_OUTLIER = 0.03
"""Relative deviation from the median that is never an outlier."""


@dataclass(frozen=True)
class Length:
    """A length in the scene that is known in metres.

    Attributes:
        name: What it is, such as "target 3".
        measured: Length in scene units.
        true: Length in metres.
        error: Relative standard error of `measured`.
    """

    name: str
    measured: float
    true: float
    error: float

    @property
    def ratio(self) -> float:
        """Metres in a unit of the scene."""
        return self.true / self.measured

    @property
    def variance(self) -> float:
        """Relative variance of the ratio."""
        return self.error**2 + LEAST_ERROR**2


def scale_of_lengths(lengths: Sequence[Length]) -> tuple[float, float, dict[str, float], list[str]]:
    """Combine known lengths to one scale.

    Args:
        lengths: At least one; a length of 0 cannot be measured.

    Returns:
        Metres per unit; its relative standard error, from leaving out each length in turn, or that of a single length;
        what each length disagrees by, metres; and sentences about lengths that were left out.

    Raises:
        InputError: If two lengths contradict each other, and nothing shows which is wrong.
    """
    middle = _weighted_median(lengths)
    used, notes = [], []
    for length in lengths:
        deviation = length.ratio / middle - 1
        if abs(deviation) > max(LEAST_OUTLIER, OUTLIER * length.variance**0.5):
            # A ratio above the others': the photos show it too short for its true length.
            kind = "shorter" if deviation > 0 else "longer"
            notes.append(
                f"{length.name.capitalize()} is {abs(1 / (1 + deviation) - 1):.0%} {kind} in the photos than "
                f"{length.true:g} m by the others, and was left out: check its true length."
            )
        else:
            used.append(length)
    if len(lengths) == 2 and len(used) < 2:
        a, b = lengths
        raise InputError(
            f"The {a.name} says {a.ratio:.4g} m per unit and the {b.name} {b.ratio:.4g} m: check their true lengths, "
            "or measure a third one."
        )
    metres = _weighted_mean(used)
    error = leave_one_out(used, _weighted_mean)
    expected = 1 / sum(1 / length.variance for length in used) ** 0.5
    residuals = {length.name: length.measured * metres - length.true for length in lengths}
    # Two or three lengths may agree by chance: the error is at least what the observations allow.
    return metres, max(error or 0.0, expected), residuals, notes


def _weighted_mean(lengths: Sequence[Length]) -> float:
    return float(np.average([length.ratio for length in lengths], weights=[1 / length.variance for length in lengths]))


def _weighted_median(lengths: Sequence[Length]) -> float:
    ordered = sorted(lengths, key=lambda length: length.ratio)
    sums = np.cumsum([1 / length.variance for length in ordered])
    return ordered[int(np.searchsorted(sums, sums[-1] / 2))].ratio
