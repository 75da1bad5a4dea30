"""Hypotheses about the cameras of a set of images: which are tried, and which one is kept.

Incremental structure from motion depends on initial values: a focal length, an initial pair of images, an order. On
images with little parallax, wrong initial values can lead to a wrong model with a small reprojection error. So a
doubtful model is not accepted at once: other initial values are tried, and the models are compared.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

_AGREEMENT = 0.05
"""Largest relative difference of focal lengths and of numbers of registered images at which two hypotheses agree."""
_DISAGREEMENT = 0.15
"""Relative difference of the focal lengths of credible hypotheses from which the focal length is not known."""
_DOUBT_FACTOR = 0.75
"""Factor on the number of registered images for each doubt, when models are compared."""
_WRONG = frozenset({"field_of_view", "focal_prior", "reprojection_error"})
"""Kinds of doubts (`model_quality.Doubt`, and those of `mapping`) of models that are probably wrong."""
_OF_THE_PHOTOS = frozenset({"few_points", "rolling_shutter"})
"""Kinds of doubts that no other hypothesis will change."""
_UNDETERMINED = frozenset({"focal_error", "focal_held", "plane_solutions", "triangulation_angle"})
"""Kinds of doubts that models have when the photos do not determine the focal length."""
_FEWEST_IMAGES = 3
"""Registered images that a model must have: two determine neither the ratio of motions nor the focal length."""
_SMALLEST_SHARE = 0.1
"""Fraction of the images that a model must have to be worth using."""


@dataclass(frozen=True)
class Hypothesis:
    """A way to map.

    Attributes:
        name: What the user reads.
        hold_focal_length: Keep the focal lengths from EXIF, else 1.2 times the longest side, until all images are
            placed, and for good when they cannot be determined then.
        calibrate_view_graph: Initialise the focal lengths with those that agree best with all pairs of images.
        global_mapping: Place all images at once instead of one after another.
        widest_pair: Use the pair of images with the largest triangulation angle as the initial pair.
    """

    name: str
    hold_focal_length: bool = False
    calibrate_view_graph: bool = False
    global_mapping: bool = False
    widest_pair: bool = False


HYPOTHESES = (
    Hypothesis("free focal length"),
    Hypothesis("all at once", calibrate_view_graph=True, global_mapping=True),
    Hypothesis("held focal length", hold_focal_length=True),
    Hypothesis("other first pair", calibrate_view_graph=True, hold_focal_length=True, widest_pair=True),
)
"""In the order in which they are tried: the first is right for most scenes."""


@dataclass(frozen=True)
class Outcome:
    """The largest model that a hypothesis led to.

    Attributes:
        name: Name of the hypothesis.
        groups: Image names of each model, the largest first; empty without a model.
        points: Number of its sparse points.
        track_length: Mean number of images that observe a point.
        reprojection_error: Mean, pixels.
        triangulation_angle: Median, degrees.
        focal_lengths: Pixels by camera id.
        fields_of_view: Horizontal degrees by camera id.
        doubts: Kind and sentence of each doubt.
        notes: Sentences about other poses or another lens model that were taken (see `model_alternatives`).
    """

    name: str
    groups: list[list[str]]
    points: int = 0
    track_length: float | None = None
    reprojection_error: float | None = None
    triangulation_angle: float | None = None
    focal_lengths: dict[str, float] = field(default_factory=dict)
    fields_of_view: dict[str, float] = field(default_factory=dict)
    doubts: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def registered(self) -> int:
        """Number of images with a pose."""
        return len(self.groups[0]) if self.groups else 0

    @property
    def doubtful(self) -> frozenset[str]:
        """Kinds of doubts that another hypothesis may not have."""
        return frozenset(kind for kind, _ in self.doubts) - _OF_THE_PHOTOS

    @property
    def score(self) -> tuple[float, bool, float]:
        """Value by which models are compared: registered images, reduced for each doubt; then the observations.

        A model with a held focal length is better than one whose focal length has a large error, and worse than one
        without doubts.
        """
        observations = self.points * (self.track_length or 0.0) / max(self.reprojection_error or 1.0, 0.1)
        doubts = len(self.doubtful - {"focal_held"})
        return round(self.registered * _DOUBT_FACTOR**doubts, 1), not self.doubtful, observations


def choose_model(run: Callable[[Hypothesis], Outcome]) -> tuple[Outcome, list[Outcome]]:
    """Try hypotheses until one leads to a model without doubts, or two agree.

    Args:
        run: Maps with a hypothesis.

    Returns:
        The best outcome and all outcomes. Where two agree, what is doubtful is due to the photos.
    """
    outcomes: list[Outcome] = []
    for hypothesis in HYPOTHESES:
        outcomes.append(run(hypothesis))
        best = max(outcomes, key=lambda outcome: outcome.score)
        if best.registered and (not best.doubtful or any(_agree(best, other) for other in outcomes if other != best)):
            break
    return best, outcomes


def is_usable(outcome: Outcome, image_count: int) -> bool:
    """Return whether a model has enough of the images to be worth using."""
    return outcome.registered >= max(min(_FEWEST_IMAGES, image_count), _SMALLEST_SHARE * image_count)


def disagreement(best: Outcome, outcomes: list[Outcome]) -> str | None:
    """Return a warning when models of as many images as the best one differ in their focal length, else None."""
    credible = [
        outcome
        for outcome in outcomes
        if outcome.registered >= (1 - _AGREEMENT) * best.registered
        and not {kind for kind, _ in outcome.doubts} & _WRONG
    ]
    for camera, focal in best.focal_lengths.items():
        others = [outcome for outcome in credible if camera in outcome.focal_lengths]
        if any(abs(other.focal_lengths[camera] / focal - 1) > _DISAGREEMENT for other in others):
            fields = [other.fields_of_view[camera] for other in [best, *others]]
            return (
                f"The focal length cannot be known from these photos: models of as many photos have horizontal "
                f"fields of view from {min(fields):.0f}° to {max(fields):.0f}°. Photos with the camera turned by 90°, "
                "or that look at the same place from more directions, would determine it."
            )
    return None


def _agree(first: Outcome, second: Outcome) -> bool:
    """Return whether two models have about as many images, and the same focal lengths or none that is determined."""
    if abs(first.registered - second.registered) > _AGREEMENT * first.registered:
        return False
    if all(doubtful and doubtful <= _UNDETERMINED for doubtful in (first.doubtful, second.doubtful)):
        return True
    return all(
        abs(second.focal_lengths.get(camera, 0.0) / focal - 1) <= _AGREEMENT
        for camera, focal in first.focal_lengths.items()
    )
