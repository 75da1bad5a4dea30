"""How far a run is: by its iterations or, under a time budget, by how many of them still fit."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

REPLAN_EVERY = 10
"""Iterations after which the rest of the run is planned again."""
FLAT_FRACTION = 0.2
"""Fraction of a run over which its curve is compared."""
FLAT_DB = 0.05
"""A run is flat when that share of it has gained less than that on the validation views."""


@dataclass
class Clock:
    """iterations: how many the run has; under a budget an estimate that follows the machine.

    fraction: 0..1, how far the run is; every schedule follows it. It never falls.
    """

    iterations: int
    fraction: float = 0.0
    skipped: int = 0
    """Iterations that were left out because the curve was flat."""
    slowness: float = 0.0
    """Measured time of an iteration over the predicted one; 0 before it was measured."""

    def advance(self, iteration: int) -> None:
        """So many iterations are done."""
        self.fraction = max(self.fraction, min(1.0, (iteration + self.skipped) / self.iterations))

    def planned(self, iteration: int) -> int:
        """How many iterations there will have been at the end, when so many are done."""
        return iteration + round((1 - self.fraction) * self.iterations)

    @property
    def done(self) -> bool:
        return self.fraction >= 1

    def skip_to(self, fraction: float, iteration: int) -> None:
        """Leave out what lies between here and there."""
        self.skipped = max(self.skipped, round(fraction * self.iterations) - iteration)
        self.advance(iteration)

    def replan(
        self, iteration: int, took: float, left: float, predicted: Callable[[float], float], steps: int = 10
    ) -> None:
        """Fit the rest of the run into the time that is left.

        took: seconds that the last REPLAN_EVERY iterations needed. left: seconds until the run must have ended.
        predicted: seconds of an iteration at a fraction of the run.
        """
        slowness = took / REPLAN_EVERY / predicted(self.fraction)
        self.slowness = 0.8 * self.slowness + 0.2 * slowness if self.slowness else slowness
        rest = [self.fraction + (1 - self.fraction) * (step + 0.5) / steps for step in range(steps)]
        each = self.slowness * sum(map(predicted, rest)) / steps
        fit = max(0.0, left / each)
        # The fraction stays where it is: what is done is that share of the whole, what fits is the rest.
        self.iterations = max(1, round(fit / max(1e-9, 1 - self.fraction)))
        self.skipped = round(self.fraction * self.iterations) - iteration
        if left <= each:
            self.fraction = 1.0


Point = tuple[float, float, float]
"""Of the curve of a run: fraction of the run, seconds, validation PSNR in dB."""


def is_flat(curve: Sequence[Point]) -> bool:
    """Whether the last FLAT_FRACTION of a run brought nothing."""
    last = curve[-1][0]
    earlier = [psnr for fraction, _, psnr in curve if fraction <= last - FLAT_FRACTION + 1e-6]
    return bool(earlier) and max(psnr for *_, psnr in curve) - max(earlier) < FLAT_DB


def next_minute(curve: Sequence[Point]) -> float | None:
    """Decibels that another minute should bring, as quality rose with the logarithm of time over the last three points;
    None before there are two."""
    if len(curve) < 2 or curve[-1][1] <= 0:
        return None
    (_, before, low), (_, now, high) = curve[-3:][0], curve[-1]
    if not 0 < before < now:
        return None
    return max(0.0, (high - low) / math.log(now / before)) * math.log1p(60 / now)
