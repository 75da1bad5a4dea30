"""Beam: the lamp lights one part of each photo more than another.

    log gain(x, y) = sum of c_ij x^i y^j over 1 <= i + j <= 4

adds to the log of the linear light of every image, held-out ones too; x and y are to the right of the image's middle
and below it, over half of the image's diagonal. A lamp moves with the camera and is near it, so its beam is at the same
place in every image, as the fall-off of the lens is, which this includes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.scene_evidence import SceneEvidence
from .effect import CostProbe, Effect, InitialContext
from .image_gain import apply_log_gains
from .range_limits import too_few_observations

DEGREE = 4
"""Of the polynomial: on photographs of a robot with lamps of its own, degree 2 gains .6 dB and degree 4 .8 dB."""
POWERS = tuple((total - j, j) for total in range(1, DEGREE + 1) for j in range(total + 1))
"""Powers of x and y, in the order of the coefficients."""
MOST_LOG_GAIN = 3.0
"""Bound of the log gain either way, so that the gain stays finite whatever is learned."""
LEAST_FALLOFF = 0.1
"""Fraction of light that the darkest part of the images lacks of that of the brightest."""
LEAST_BIC = 500.0
"""BIC gain by light that varies over the images: beside a lamp without a beam, at most 350 on 23 of 24 generated
scenes, since errors of the lamp's formula look alike in all images; with a beam or a lens, 690 and more on all 48."""


@dataclass
class Beam:
    """Beam of a lamp at the camera.

    Attributes:
        coefficients: (14,) of the polynomial, in the order of POWERS.
    """

    coefficients: Tensor

    def parameters(self) -> dict[str, Tensor]:
        """Return what is learned, by attribute name."""
        return {"coefficients": self.coefficients}

    def settings(self) -> None:
        """Return nothing: a checkpoint needs the coefficients alone."""

    def log_gain(self, image: str, height: int, width: int) -> Tensor:
        """Return the log gain (height, width, 1), the same for every image; 0 in the middle."""
        c = self.coefficients
        half = (width**2 + height**2) ** 0.5 / 2
        places = (torch.arange(size, dtype=c.dtype, device=c.device) + 0.5 - size / 2 for size in (width, height))
        powers = torch.arange(DEGREE + 1, device=c.device)
        x, y = ((place / half)[:, None] ** powers for place in places)
        # The product of matrices needs no term of the size of the image.
        i, j = torch.tensor(POWERS, device=c.device).T
        of_powers = c.new_zeros(DEGREE + 1, DEGREE + 1).index_put((i, j), c)
        return (y @ of_powers.T @ x.T).clamp(-MOST_LOG_GAIN, MOST_LOG_GAIN)[..., None]


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from light that varies over the images in the same way, fitted beside every other term."""
    terms = evidence.water_terms
    if terms is None:
        return too_few_observations(evidence)
    if not terms.lamp.found:
        return Decision("off", {}, "There is no lamp.")
    camera = terms.camera
    falloff = float(-np.expm1(-camera.unevenness))
    figures = {
        "falloff": falloff,
        "falloff_least": LEAST_FALLOFF,
        "bic_gain": camera.lens_bic,
        "bic_gain_least": LEAST_BIC,
    }
    found = falloff >= LEAST_FALLOFF and camera.lens_bic > LEAST_BIC
    return Decision(
        "on" if found else "off",
        figures,
        f"The darkest part of the photos gets {falloff:.0%} less light than the brightest (threshold "
        f"{LEAST_FALLOFF:.0%}), BIC gain {camera.lens_bic:,.0f} (threshold {LEAST_BIC:.0f}).",
    )


def _initial(context: InitialContext) -> Beam:
    # The fit's own values are not a start: along a straight path, a slope of the beam and exposures that change evenly
    # explain the same photos.
    return Beam(torch.zeros(len(POWERS)))


def _load(tensors: dict[str, Tensor], settings: Any) -> Beam:
    return Beam(**tensors)


def _cost(probe: CostProbe) -> Callable[[], Tensor]:
    beam = Beam(torch.zeros(len(POWERS), device=probe.device, requires_grad=True))
    image, weights = probe.image(), probe.image().detach()
    size = probe.camera.height, probe.camera.width
    return lambda: (apply_log_gains(image, [beam.log_gain("", *size)]) * weights).sum()


EFFECT = Effect(
    "Lamp beam",
    "image",
    decide,
    initial=_initial,
    load=_load,
    learning_rate=1e-2,
    cost=_cost,
    tried_at=0.1,
    determined_by_ranges=True,
)
