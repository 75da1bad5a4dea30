"""Progress of a run: by its iterations or, under a time budget, by how many of them still fit."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

REPLAN_EVERY = 10
"""Iterations after which the rest of a run with a time budget is planned again."""
FLAT_FRACTION = 0.2
"""Fraction of a run over which its curve is compared."""
FLAT_DB = 0.05
"""Gain in validation PSNR over that fraction below which a run is flat, dB."""


@dataclass
class Clock:
    """How far a run is.

    Attributes:
        iterations: How many the run has; under a time budget an estimate that follows the machine.
        fraction: How far the run is, 0..1; every schedule follows it. It never falls.
        skipped: Iterations that were skipped because the curve was flat.
        slowness: Measured time of an iteration over the predicted one; 0 before it was measured.
    """

    iterations: int
    fraction: float = 0.0
    skipped: int = 0
    slowness: float = 0.0

    def advance(self, iteration: int) -> None:
        """Set the fraction for so many iterations done."""
        self.fraction = max(self.fraction, min(1.0, (iteration + self.skipped) / self.iterations))

    def planned(self, iteration: int) -> int:
        """Return how many iterations the run will have had at its end, when so many are done."""
        return iteration + round((1 - self.fraction) * self.iterations)

    @property
    def done(self) -> bool:
        """Whether the run has come to its end."""
        return self.fraction >= 1

    def skip_to(self, fraction: float, iteration: int) -> None:
        """Skip the iterations up to a fraction of the run."""
        self.skipped = max(self.skipped, round(fraction * self.iterations) - iteration)
        self.advance(iteration)

    def replan(
        self, iteration: int, took: float, left: float, predicted: Callable[[float], float], steps: int = 10
    ) -> None:
        """Fit the rest of the run into the time that is left.

        Args:
            iteration: Iterations done.
            took: Time of the last REPLAN_EVERY iterations, s.
            left: Time until the run must have ended, s.
            predicted: Gives the predicted time of an iteration at a fraction of the run, s.
            steps: Parts of the rest over which the prediction is averaged.
        """
        slowness = took / REPLAN_EVERY / predicted(self.fraction)
        self.slowness = 0.8 * self.slowness + 0.2 * slowness if self.slowness else slowness
        rest = [self.fraction + (1 - self.fraction) * (step + 0.5) / steps for step in range(steps)]
        each = self.slowness * sum(map(predicted, rest)) / steps
        fit = max(0.0, left / each)
        # The fraction stays: what is done is that part of the whole, what fits is the rest.
        self.iterations = max(1, round(fit / max(1e-9, 1 - self.fraction)))
        self.skipped = round(self.fraction * self.iterations) - iteration
        if left <= each:
            self.fraction = 1.0


Point = tuple[float, float, float]
"""One point of the curve of a run: fraction of the run, seconds, validation PSNR in dB."""


def is_flat(curve: Sequence[Point]) -> bool:
    """Return whether the last FLAT_FRACTION of a run gained less than FLAT_DB."""
    last = curve[-1][0]
    earlier = [psnr for fraction, _, psnr in curve if fraction <= last - FLAT_FRACTION + 1e-6]
    return bool(earlier) and max(psnr for *_, psnr in curve) - max(earlier) < FLAT_DB


def next_minute(curve: Sequence[Point]) -> float | None:
    """Extrapolate what another minute of training should gain.

    Args:
        curve: Points of the run; quality is taken to rise with the logarithm of time over the last three.

    Returns:
        Gain in PSNR, dB; None before there are two points.
    """
    if len(curve) < 2 or curve[-1][1] <= 0:
        return None
    (_, before, low), (_, now, high) = curve[-3:][0], curve[-1]
    if not 0 < before < now:
        return None
    return max(0.0, (high - low) / math.log(now / before)) * math.log1p(60 / now)
