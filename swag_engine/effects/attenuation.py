"""Attenuation: the water takes light, of one color more than of another."""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.observations import LEAST_CHANGE
from ..evidence.scene_evidence import SceneEvidence
from ..evidence.water_terms import CHANNELS, GREY, LEAST_COLOR, LEAST_WATER_BIC, SURE_COLOR, WIDEST_INTERVAL, WaterTerm
from ..water.medium import SETTINGS, Medium, through_water
from ..water.network import WaterNetwork
from .effect import CostProbe, Effect
from .range_limits import limited_by_ranges, too_few_observations


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from the colors of points seen at several ranges."""
    terms = evidence.water_terms
    if terms is None:
        return too_few_observations(evidence)
    decision, family = decide_by_color(terms.water), terms.lamp_family
    if family:
        decision.evidence.update(loss_with_lamp=family.loss.tolist(), error_under_lamp=family.beta_error)
        together = ", ".join(f"{name} {loss:.0%}" for name, loss in zip(CHANNELS, family.loss, strict=True))
        decision = replace(
            decision,
            reason=f"{decision.reason} Lamp and water together take {together}. How much of it the water takes is less "
            f"certain: the attenuation may be {family.beta_error:.3f} per unit higher or lower, alike in all colors.",
        )
    return limited_by_ranges(decision, terms)


def decide_by_color(water: WaterTerm) -> Decision:
    """Decide from the loss of light with range, wherever the ranges are.

    Args:
        water: The water term of the evidence.

    Returns:
        The decision.
    """
    decision = Decision(
        "on" if water.attenuates else "off",
        {
            "bic_gain": water.bic_gain,
            "bic_gain_least": LEAST_WATER_BIC,
            "change": water.change.tolist(),
            "change_least": water.change_needed,
            "color": water.color,
            "color_least": LEAST_COLOR,
            "sure_color": water.sure_color,
            "sure_color_least": SURE_COLOR,
            "color_of_loss": water.grey,
            "color_of_loss_least": GREY,
            "interval": water.interval,
            "interval_most": WIDEST_INTERVAL,
            "resolution": water.resolution,
            "resolution_most": LEAST_CHANGE,
        },
        _reason(water),
    )
    lost = f"{water.channel} loses {water.change.max():.0%} between the nearest and the farthest points"
    if water.loses and not water.attenuates:
        return decision.undetermined(
            f"Cannot be distinguished from a lamp, the lens, shine or blur, which affect all colors alike: {lost} "
            f"(threshold {water.change_needed:.0%}) and fades beside another color by {water.color:.0%}, at least "
            f"{max(water.sure_color, 1e-9):.0%} (thresholds {LEAST_COLOR:.0%} and {SURE_COLOR:.0%})."
        )
    if not water.attenuates and water.resolution > LEAST_CHANGE:
        return decision.undetermined(
            f"Cannot be determined: a loss of {LEAST_CHANGE:.0%} between the nearest and the farthest points would be "
            f"known to +-{water.resolution:.0%} only."
        )
    if water.attenuates and water.interval > WIDEST_INTERVAL and not water.sure and water.sure_color < LEAST_COLOR:
        return decision.undetermined(
            f"Cannot be determined: the loss of {water.channel} is known to +-{water.interval:.0%} only "
            f"(+-{WIDEST_INTERVAL:.0%} at most)."
        )
    return decision


def _reason(water: WaterTerm) -> str:
    sentence = (
        f"{water.channel.capitalize()} loses {water.change.max():.0%} between the nearest and the farthest points "
        f"(threshold {water.change_needed:.0%}), BIC gain {water.bic_gain:,.0f} (threshold {LEAST_WATER_BIC:.0f})"
    )
    if water.attenuates and water.colored:
        return (
            f"{sentence}; it fades beside another color by {water.color:.0%} (threshold {LEAST_COLOR:.0%}), at least "
            f"{water.sure_color:.0%}."
        )
    if water.attenuates:
        return f"{sentence}; the background light that the darkest places show agrees."
    return f"{sentence}."


def _load(tensors: dict[str, Tensor], settings: Any) -> Medium | WaterNetwork:
    if "weights" in tensors:
        return WaterNetwork(**tensors, unit_range=settings["unit_range"])
    known = (tensors.get(entry.name) for entry in fields(Medium) if entry.name not in SETTINGS)
    return Medium(*known, **settings)  # type: ignore[arg-type]


def _cost(probe: CostProbe) -> Callable[[], Tensor]:
    medium = Medium.starting(2.0).to(probe.device)
    for parameter in medium.parameters().values():
        parameter.requires_grad_()
    colors, offsets = probe.random(probe.gaussians, 3), probe.random(probe.gaussians, 3).detach() + 1
    return lambda: through_water(colors, offsets, medium, backend=probe.backend).sum()


EFFECT = Effect("Attenuation", "medium", decide, model_name="medium", load=_load, cost=_cost)
