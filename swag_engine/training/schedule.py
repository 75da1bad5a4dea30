"""Learning rates of a run, and when things happen in it."""

from dataclasses import dataclass

SETTLED_BY = 2000
"""Iterations up to which the step size of the means is not reduced."""


@dataclass(frozen=True)
class LearningRates:
    """Adam's step sizes by parameter; those of the means in units of the median range.

    Up to eight times those of 3DGS (arXiv 2308.04079), whose runs are ten times as long. In runs of more than
    SETTLED_BY iterations the steps of the means are smaller by the square root of the ratio.
    """

    means: float = 1.28e-3
    """At the start of the run; falls geometrically."""
    means_end: float = 1.28e-5
    """At the end of the run."""
    quats: float = 4e-3
    log_scales: float = 2e-2
    opacity_logits: float = 5e-2
    sh0: float = 1.5e-2
    shN: float = 5e-4
    background: float = 1e-2
    features: float = 2e-2


@dataclass(frozen=True)
class Schedule:
    """When things happen, as fractions of all iterations unless said otherwise, and the learning rates."""

    coarse: tuple[tuple[float, int], ...] = ((0.2, 4), (0.5, 2))
    """(until, factor): images are reduced to 1/factor of their size until that fraction."""
    sh_degrees: tuple[float, ...] = (0.2, 0.35, 0.5)
    """From where spherical harmonics of degree 1, 2 and 3 are used."""
    densify_from: float = 0.04
    """From where Gaussians are added."""
    densify_every: int = 50
    """Iterations between two densifications."""
    relocate_every: float = 0.1
    """Between two relocations; the last one is that long before stage two."""
    validate_every: float = 0.1
    """Between two validations."""
    checkpoint_seconds: float = 30.0
    """Seconds between two checkpoints."""
    preview_seconds: float = 2.0
    """Seconds between two previews."""
    closing_seconds: float = 3.0
    """Seconds of a time budget that are kept for writing results and their report."""
    learning_rates: LearningRates = LearningRates()
    """Step sizes of the Gaussians' parameters."""
    hardly_shown: float = 1.7e-3
    """Gradient of the sum of an image's errors, display values, below which a Gaussian's steps get smaller. Otherwise
    Adam makes steps of the same size where images hardly show anything, and long runs end with glaring colors there."""


STANDARD = Schedule()
"""The schedule of every run that users start."""

CONTINUED = Schedule(
    coarse=(),
    sh_degrees=(0.0, 0.0, 0.0),
    densify_from=1.0,
    relocate_every=1.0,
    learning_rates=LearningRates(means=1.28e-4),
)
"""The schedule of runs that start from trained Gaussians: like the second half of a run, with no other Gaussians."""
