"""A time budget: the size of the run that fits it, and when it has to end."""

import time
from dataclasses import dataclass, replace

from ...base.errors import InputError
from ...scene.colmap import Scene
from ...settings.presets import LADDER, Size, size_at
from ...settings.recipes import recipe_of
from ...settings.settings import TrainSettings
from .speed import Extent, Speed, measure_speed, predicted_milliseconds, predicted_seconds

CLOSING = 3.0
"""Seconds kept for writing results and their report."""


@dataclass
class Budget:
    """The time of a run. seconds: all of it, from `started` (time.monotonic()) on.

    held_out: seconds that scoring the held-out views took last.
    """

    seconds: float
    started: float
    speed: Speed
    extent: Extent
    size: Size
    grow_until: float
    held_out: float = 0.0

    @property
    def iterations(self) -> int:
        """How many are expected to fit."""
        return self.size.iterations

    def left(self) -> float:
        """Seconds that may still be trained."""
        return self.seconds - (time.monotonic() - self.started) - CLOSING - self.held_out

    def shorten(self, seconds: float) -> None:
        """Only so many seconds of training more."""
        self.seconds -= max(0.0, self.left() - seconds)

    def predicted(self, fraction: float) -> float:
        """Seconds of an iteration at that fraction of the run."""
        return predicted_milliseconds(self.speed, self.extent, self.size, fraction, self.grow_until) / 1000


def fit_budget(scene: Scene, settings: TrainSettings, started: float) -> tuple[TrainSettings, Budget | None]:
    """The settings with what fits their time budget filled in, and the budget; None where they have none.

    Raises InputError where the time does not even reach for a first look.
    """
    if not settings.budget:
        return settings, None
    speed, extent = measure_speed(scene, settings), Extent.of(scene)
    grow_until = recipe_of(settings.recipe, settings.effects).grow_until
    left = settings.budget - (time.monotonic() - started) - CLOSING

    def size(rung: float) -> Size:
        asked, own = settings, size_at(rung)
        return Size(own.iterations, asked.width or own.width, asked.max_gaussians or own.max_gaussians)

    low, high = 0.0, float(len(LADDER) - 1)
    needed = predicted_seconds(speed, extent, size(low), grow_until)
    if needed > left:
        least = needed + settings.budget - left
        raise InputError(
            f"{settings.time_budget} is too short for this scene on this machine: it needs {least:.0f}s at least."
        )
    for _ in range(30):
        middle = (low + high) / 2
        fits = predicted_seconds(speed, extent, size(middle), grow_until) <= left
        low, high = (middle, high) if fits else (low, middle)
    chosen = size(low)
    budget = Budget(settings.budget, started, speed, extent, chosen, grow_until)
    return replace(settings, width=chosen.width, max_gaussians=chosen.max_gaussians), budget
