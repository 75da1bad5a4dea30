"""A time budget: the size of the run that fits it, and when it has to end."""

import time
from dataclasses import dataclass, replace

from ...base.errors import InputError
from ...scene.colmap import Scene
from ...scene.resolved_width import resolved_width
from ...settings.presets import LADDER, Size, size_at
from ...settings.recipes import recipe_of
from ...settings.settings import TrainSettings
from .preset_size import suited
from .speed import Extent, Speed, measure_speed, predicted_milliseconds, predicted_seconds


@dataclass
class Budget:
    """The time budget of a run.

    Attributes:
        seconds: Time of the whole run, s.
        started: time.monotonic() that it counts from.
        speed: Measured speed of this machine on this scene.
        extent: Size of the scene.
        size: Size of the run that should fit.
        densify_until: Fraction of the run at which densification ends.
        closing: Time kept for writing results and their report, s.
        held_out: Time that scoring the held-out images took last, s.
    """

    seconds: float
    started: float
    speed: Speed
    extent: Extent
    size: Size
    densify_until: float
    closing: float
    held_out: float = 0.0

    @property
    def iterations(self) -> int:
        """How many iterations are expected to fit."""
        return self.size.iterations

    def left(self) -> float:
        """Return how long may still be trained, s."""
        return self.seconds - (time.monotonic() - self.started) - self.closing - self.held_out

    def shorten(self, seconds: float) -> None:
        """Let the run train only `seconds` more, where it had more time."""
        self.seconds -= max(0.0, self.left() - seconds)

    def predicted(self, fraction: float) -> float:
        """Return the predicted time of an iteration at a fraction of the run, s."""
        return predicted_milliseconds(self.speed, self.extent, self.size, fraction, self.densify_until) / 1000


def fit_budget(
    scene: Scene, settings: TrainSettings, started: float, closing: float
) -> tuple[TrainSettings, Budget | None]:
    """Choose the size of the run that fits a time budget.

    Args:
        scene: The scene.
        settings: What the user chose.
        started: time.monotonic() that the budget counts from.
        closing: Time to keep for writing results and their report, s.

    Returns:
        The settings with the size filled in, and the budget; None where the settings have none.

    Raises:
        InputError: If the time is too short even for the smallest run.
    """
    if not settings.budget:
        return settings, None
    speed, extent = measure_speed(scene, settings), Extent.of(scene)
    densify_until = recipe_of(settings.recipe, settings.effects).densify_until
    left = settings.budget - (time.monotonic() - started) - closing

    widest = resolved_width(scene, LADDER[-1].width)

    def size(rung: float) -> Size:
        return suited(settings, size_at(rung), extent, widest)

    low, high = 0.0, float(len(LADDER) - 1)
    needed = predicted_seconds(speed, extent, size(low), densify_until)
    if needed > left:
        least = needed + settings.budget - left
        raise InputError(
            f"{settings.time_budget} is too short for this scene on this machine: it needs {least:.0f}s at least."
        )
    for _ in range(30):
        middle = (low + high) / 2
        fits = predicted_seconds(speed, extent, size(middle), densify_until) <= left
        low, high = (middle, high) if fits else (low, middle)
    chosen = size(low)
    budget = Budget(settings.budget, started, speed, extent, chosen, densify_until, closing)
    return replace(settings, width=chosen.width, max_gaussians=chosen.max_gaussians), budget
