"""Time of a run: how long it has trained, how much is left, and what pauses take away from neither."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from .budget import Budget
from .clock import REPLAN_EVERY, Clock

LEAST_PAUSE = 0.1
"""Seconds; a shorter wait counts as training."""


class Pacer:
    """Measures the time of one run and keeps it within its budget.

    Args:
        budget: The time budget, None where only iterations limit the run.

    Attributes:
        seconds_before: Time trained before the run was resumed, s.
    """

    def __init__(self, budget: Budget | None) -> None:
        self.budget = budget
        self.seconds_before = 0.0
        self.start(0)

    def start(self, iteration: int) -> None:
        """Begin to measure, with so many iterations done."""
        self._first_iteration = iteration
        self._started = self._replanned = time.monotonic()

    @property
    def seconds(self) -> float:
        """Time trained so far, earlier parts of a resumed run included, s."""
        return self.seconds_before + self._here

    @property
    def _here(self) -> float:
        return time.monotonic() - self._started

    @property
    def budget_spent(self) -> float:
        """Time used of the budget, s; 0 without one."""
        return time.monotonic() - self.budget.started if self.budget else 0.0

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Let what happens inside count neither as training nor against the budget, where it takes a while."""
        asked = time.monotonic()
        yield
        paused = time.monotonic() - asked
        if paused > LEAST_PAUSE:
            self._started, self._replanned = self._started + paused, self._replanned + paused
            if self.budget:
                self.budget.started += paused

    @contextmanager
    def outside_plan(self) -> Iterator[None]:
        """Let what happens inside not count as time of iterations when the rest of the run is planned."""
        asked = time.monotonic()
        yield
        self._replanned += time.monotonic() - asked

    def replan(self, clock: Clock, iteration: int) -> None:
        """Fit the rest of the run into what is left of the budget, every REPLAN_EVERY iterations."""
        if self.budget and iteration % REPLAN_EVERY == 0:
            now = time.monotonic()
            clock.replan(iteration, now - self._replanned, self.budget.left(), self.budget.predicted)
            self._replanned = now

    def finish_early(self, clock: Clock, iteration: int, last: float) -> None:
        """Skip to the fraction `last` of the run, and shorten the budget by as much."""
        clock.skip_to(last, iteration)
        if self.budget:
            self.budget.shorten(self.seconds * (1 - last) / last)

    def iterations_per_second(self, iteration: int) -> float:
        """Return the mean speed since the run was started or resumed."""
        return (iteration - self._first_iteration) / max(self._here, 1e-9)

    def seconds_left(self, clock: Clock, iteration: int) -> float:
        """Return the time until the planned end of training, s."""
        if self.budget:
            return max(0.0, self.budget.left())
        return (clock.planned(iteration) - iteration) / max(self.iterations_per_second(iteration), 1e-9)
