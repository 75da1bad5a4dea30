"""Learning rates and the schedule of a run."""

from dataclasses import dataclass

SETTLED_BY = 2000
"""Iterations up to which the step size of the means is not made smaller."""


@dataclass(frozen=True)
class LearningRates:
    """Adam's step sizes per group of parameters; means in units of the median range.

    Up to eight times those of 3DGS (arXiv 2308.04079), whose runs are ten times as long. What runs for longer than
    SETTLED_BY iterations moves its means by steps that are smaller by the root of that.
    """

    means: float = 1.28e-3
    means_end: float = 1.28e-5
    quats: float = 4e-3
    log_scales: float = 2e-2
    opacity_logits: float = 5e-2
    sh0: float = 1.5e-2
    shN: float = 5e-4
    background: float = 1e-2
    features: float = 2e-2


@dataclass(frozen=True)
class Schedule:
    """When things happen, as fractions of all iterations unless said otherwise."""

    coarse: tuple[tuple[float, int], ...] = ((0.1, 4), (0.3, 2))
    """(until, factor): images are shrunk by `factor` until that fraction."""
    sh_degrees: tuple[float, ...] = (0.2, 0.35, 0.5)
    """Where SH degree 1, 2 and 3 join."""
    grow_from: float = 0.04
    grow_every: int = 50
    """Iterations between two growth events."""
    reallocate_every: float = 0.1
    """Share of the run between two reallocations; that long before stage two is the last."""
    validate: float = 0.1
    """Share of the run between two validations."""
    checkpoint_seconds: float = 30.0
    preview_seconds: float = 2.0
