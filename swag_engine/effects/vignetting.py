"""Vignetting: a lens images less light towards the corners of a photo.

    gain(r) = 1 + k1 r^2 + k2 r^4 + k3 r^6

multiplies the linear light of every image, held-out ones too; r is the distance from the principal point over half of
the image's diagonal (even polynomial: Goldman, Vignette and Exposure Calibration and Compensation, IEEE TPAMI 2010).
One lens serves all images, as in the fit (evidence/fit.py).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.fit import lens_terms
from ..evidence.observations import Observations
from ..evidence.scene_evidence import SceneEvidence
from .effect import CostProbe, Effect, InitialContext
from .image_gain import apply_log_gains
from .range_limits import too_few_observations

TERMS = 3
"""Even powers of the radius in the polynomial."""
LEAST_GAIN, MOST_GAIN = 0.05, 2.0
"""Bounds of the gain, so that its logarithm stays finite whatever is learned."""
LEAST_FALLOFF = 0.1
"""Fraction of light lost from the centre to the corners; trials decide where it is within a factor 1.5 of this."""
LEAST_RADIAL = 0.5
"""Fraction of the variance of the fitted light over the images that is radial: on generated scenes a lens gives 0.8 and
more; shine, waves and errors of the fit give 0.4 and less."""
LEAST_BIC = 100.0
"""BIC gain by light that varies over the images: shine and phone processing gain some tens by it."""
MOST_RADIUS_CORRELATION = 0.9
"""Multiple correlation, over the observations of each point, of the squared radius with functions of range above which
water or a lamp explain a fall-off as well: about 0.75 in a room, 0.99 in a survey straight down at constant height."""


@dataclass
class Vignetting:
    """Vignetting of the camera.

    Attributes:
        coefficients: (TERMS,) k1, k2, ... of the polynomial.
        centre: Principal point, fractions of the width and the height.
    """

    coefficients: Tensor
    centre: tuple[float, float] = (0.5, 0.5)

    def parameters(self) -> dict[str, Tensor]:
        """Return what is learned, by attribute name."""
        return {"coefficients": self.coefficients}

    def settings(self) -> list[float]:
        """Return the principal point, for a checkpoint."""
        return list(self.centre)

    def log_gain(self, image: str, height: int, width: int) -> Tensor:
        """Return the log gain (height, width, 1), the same for every image; 0 at the principal point."""
        k = self.coefficients
        x, y = (
            torch.arange(size, dtype=k.dtype, device=k.device) + 0.5 - centre * size
            for size, centre in zip((width, height), self.centre, strict=True)
        )
        squared = (x.square() + y.square()[:, None]) * (4 / (width**2 + height**2))
        change = torch.zeros_like(squared)
        for coefficient in k.flip(0):
            change = (change + coefficient) * squared
        return (1 + change).clamp(LEAST_GAIN, MOST_GAIN).log()[..., None]


@dataclass(frozen=True)
class Falloff:
    """Radial part of the light that a fit has over the images.

    Attributes:
        log_corner: Log light at the corners relative to the centre.
        radial: Fraction of the variance of that light that is radial.
        radius_correlation: Multiple correlation of the squared radius with functions of range.
    """

    log_corner: float
    radial: float
    radius_correlation: float

    @classmethod
    def of(cls, observations: Observations, lens: np.ndarray) -> "Falloff":
        """Measure the radial part of a fitted lens.

        To first order, the fit with a radial lens alone is the projection of the fitted light on the squared radius,
        each without what the colors of the points and functions of range explain (Frisch-Waugh-Lovell theorem).

        Args:
            observations: Observations of the scene.
            lens: (5,) coefficients of lens_terms.

        Returns:
            The radial part.
        """
        relative = observations.ranges / np.median(observations.ranges)
        _, track = np.unique(observations.track, return_inverse=True)
        counts = np.bincount(track)
        columns = (observations.radius**2, lens_terms(observations.place) @ lens, relative, np.log(relative))
        varying = np.stack([column - (np.bincount(track, column) / counts)[track] for column in columns], 1)
        explained = varying[:, 2:] @ np.linalg.lstsq(varying[:, 2:], varying[:, :2], rcond=None)[0]
        radius, light = (varying[:, :2] - explained).T
        left, together = float(radius @ radius), float(radius @ light)
        return cls(
            together / max(left, 1e-12),
            together**2 / max(left * float(light @ light), 1e-12),
            float(np.sqrt(max(1 - left / max(float(varying[:, 0] @ varying[:, 0]), 1e-12), 0))),
        )


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from the radial part of the light over the images, fitted beside every other term."""
    terms = evidence.water_terms
    if terms is None:
        return too_few_observations(evidence)
    camera = terms.camera
    measured = Falloff.of(evidence.observations, camera.lens_fit.lens)
    falloff = max(0.0, float(-np.expm1(measured.log_corner)))
    figures = {
        "falloff": falloff,
        "falloff_least": LEAST_FALLOFF,
        "radial": measured.radial,
        "radial_least": LEAST_RADIAL,
        "bic_gain": camera.lens_bic,
        "bic_gain_least": LEAST_BIC,
        "radius_correlation": measured.radius_correlation,
        "radius_correlation_most": MOST_RADIUS_CORRELATION,
    }
    found = falloff >= LEAST_FALLOFF and measured.radial >= LEAST_RADIAL and camera.lens_bic > LEAST_BIC
    decision = Decision(
        "on" if found else "off",
        figures,
        f"Light falls off by {falloff:.1%} from the centre of the photos to their corners (threshold "
        f"{LEAST_FALLOFF:.0%}), {measured.radial:.0%} of its variance is radial (threshold {LEAST_RADIAL:.0%}), BIC "
        f"gain {camera.lens_bic:,.0f} (threshold {LEAST_BIC:.0f}).",
    )
    if measured.radius_correlation > MOST_RADIUS_CORRELATION:
        return decision.undetermined(
            "Cannot be distinguished from light that changes with range: range and distance from the image centre vary "
            f"together (correlation {measured.radius_correlation:.2f}, {MOST_RADIUS_CORRELATION} at most)."
        )
    if terms.lamp.found:
        return decision.undetermined(
            "Cannot be distinguished from the beam of the lamp, which falls off from its axis as a lens does (by "
            f"{falloff:.1%} from the centre of the photos to their corners) and is part of the effect beam."
        )
    return decision


def _fitted(evidence: SceneEvidence) -> dict[str, Any]:
    if evidence.water_terms is None:
        return {}
    log_corner = Falloff.of(evidence.observations, evidence.water_terms.camera.lens_fit.lens).log_corner
    cameras = [image.camera for image in evidence.images]
    centre = np.mean([(camera.cx / camera.width, camera.cy / camera.height) for camera in cameras], axis=0)
    # The Taylor series of exp(log_corner * r^2), which is what the fit has.
    coefficients = [log_corner**n / factorial(n) for n in range(1, TERMS + 1)]
    return {"coefficients": np.round(coefficients, 5).tolist(), "centre": np.round(centre, 5).tolist()}


def _initial(context: InitialContext) -> Vignetting:
    start = {"coefficients": [0.0] * TERMS, "centre": [0.5, 0.5]} | dict(context.fitted)
    return Vignetting(torch.tensor(start["coefficients"], dtype=torch.float32), tuple(start["centre"]))


def _load(tensors: dict[str, Tensor], settings: Any) -> Vignetting:
    return Vignetting(**tensors, centre=tuple(settings))


def _cost(probe: CostProbe) -> Callable[[], Tensor]:
    height, width = probe.camera.height, probe.camera.width
    vignetting = Vignetting(torch.zeros(TERMS, device=probe.device, requires_grad=True))
    image, weights = probe.image(), probe.image().detach()
    return lambda: (apply_log_gains(image, [vignetting.log_gain("", height, width)]) * weights).sum()


EFFECT = Effect(
    "Vignetting",
    "image",
    decide,
    fitted=_fitted,
    initial=_initial,
    load=_load,
    learning_rate=5e-3,
    cost=_cost,
    tried_at=0.1,
    determined_by_ranges=True,
)
