"""Lamp: a light at the camera falls off with the square of the range.

J is lit by L(r) = (tau + r_bar^2) / (tau + r^2) in linear light, 1 at the scene's median range r_bar. A large tau is
daylight; values between stand for a mixture of both.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.scene_evidence import SceneEvidence
from ..evidence.water_terms import GREY, LEAST_FALLOFF, LEAST_LAMP_SHARE
from ..water.light import apply_gain
from .effect import CostProbe, Effect, InitialContext
from .range_limits import limited_by_ranges, too_few_observations


@dataclass
class Lamp:
    """A lamp at the camera.

    Attributes:
        log_tau: () log of tau over the squared median range.
        unit_range: Median range of the scene, scene units.
    """

    log_tau: Tensor
    unit_range: float

    @classmethod
    def starting(cls, unit_range: float, tau: float) -> "Lamp":
        """Return a lamp of tau in squared scene units."""
        return cls(torch.tensor(tau / unit_range**2).log(), unit_range)

    def parameters(self) -> dict[str, Tensor]:
        """Return what is learned, by attribute name."""
        return {"log_tau": self.log_tau}

    def settings(self) -> float:
        """Return the median range, for a checkpoint."""
        return self.unit_range

    @property
    def tau(self) -> float:
        """Tau in squared scene units."""
        return float(self.log_tau.detach().exp()) * self.unit_range**2

    @property
    def relative_tau(self) -> Tensor:
        """Tau over the squared median range, (), differentiable; bounded so that `light` stays finite."""
        return self.log_tau.clamp(-12.0, 12.0).exp()

    def light(self, ranges: Tensor) -> Tensor:
        """Return the factor on linear light at ranges of any shape, scene units; differentiable in both."""
        tau = self.relative_tau
        return (tau + 1) / (tau + (ranges / self.unit_range).square())


def lit(colors: Tensor, ranges: Tensor, lamp: Lamp, amount: float = 1.0) -> Tensor:
    """Light the colors of Gaussians by the lamp.

    Args:
        colors: (N, 3) display colors at the median range.
        ranges: (N,) scene units.
        lamp: The lamp.
        amount: 0 (even light) to 1, the exponent of the fall-off.

    Returns:
        (N, 3) display colors; differentiable.
    """
    return apply_gain(colors, amount * lamp.light(ranges).log()[:, None])


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from light that falls off from the camera beyond what water takes."""
    terms = evidence.water_terms
    if terms is None:
        return too_few_observations(evidence)
    lamp = terms.lamp
    figures = {
        "bic_gain": lamp.bic_gain,
        "bic_gain_least": lamp.bic_needed,
        "inverse_square": lamp.inverse_square,
        "inverse_square_least": LEAST_LAMP_SHARE,
        "falloff": lamp.falloff,
        "falloff_least": LEAST_FALLOFF,
        "color_of_loss": lamp.grey,
        "color_of_loss_most": GREY,
    }
    reason = (
        f"Light falls off from the camera by {lamp.falloff:.0%} over the scene's range (threshold {LEAST_FALLOFF:.0%})"
        + ("" if lamp.colorless else " beyond what water takes")
        + f", BIC gain {lamp.bic_gain:,.0f} (threshold {lamp.bic_needed:.0f})"
        + (f"; the loss has no color (spread {lamp.grey:.0%}, {GREY:.0%} at most)." if lamp.colorless else ".")
    )
    decision = Decision("on" if lamp.found else "off", figures, reason)
    if lamp.tied and not lamp.found:
        decision = decision.undetermined(
            f"Cannot be determined: light that falls off from the camera by {lamp.falloff:.0%} explains the colors as "
            f"well as water does (BIC gain {lamp.bic_gain:,.0f}, threshold {lamp.bic_needed:.0f}). With a lamp the "
            f"attenuation would be {', '.join(f'{value:.3f}' for value in lamp.beta_D)} per unit (red, green, blue)."
        )
    return limited_by_ranges(decision, terms)


def _fitted(evidence: SceneEvidence) -> dict[str, Any]:
    return {"tau": evidence.water_terms.fit.tau} if evidence.water_terms else {}


def _initial(context: InitialContext) -> Lamp:
    tau, unit_range = context.fitted.get("tau"), context.median_range
    return Lamp.starting(unit_range, float(tau) if isinstance(tau, int | float) else unit_range**2)


def _load(tensors: dict[str, Tensor], settings: Any) -> Lamp:
    return Lamp(**tensors, unit_range=settings)


def _cost(probe: CostProbe) -> Callable[[], Tensor]:
    lamp = Lamp(torch.zeros((), device=probe.device, requires_grad=True), 2.0)
    colors, ranges = probe.random(probe.gaussians, 3), probe.random(probe.gaussians).detach() + 1
    return lambda: lit(colors, ranges, lamp).sum()


EFFECT = Effect(
    "Lamp",
    "gaussians",
    decide,
    fitted=_fitted,
    initial=_initial,
    load=_load,
    learning_rate=1e-2,
    cost=_cost,
    tried_at=0.1,
    determined_by_ranges=True,
)
