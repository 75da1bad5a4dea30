"""Backscatter: the water adds light of its own."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.observations import LEAST_BACKGROUND_LIGHT
from ..evidence.scene_evidence import SceneEvidence
from ..evidence.water_terms import LEAST_BIC_GAIN
from ..water.medium import Medium, open_water
from .attenuation import decide_by_color
from .effect import CostProbe, Effect
from .range_limits import limited_by_ranges, too_few_observations


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from colors that gain light with range, and from the darkest light, which must rise too."""
    terms = evidence.water_terms
    if terms is None:
        return too_few_observations(evidence)
    water = terms.water
    decision = Decision(
        "on" if water.backscatters else "off",
        {
            "bic_gain": water.background_bic,
            "bic_gain_least": LEAST_BIC_GAIN,
            "background_light": water.background.tolist(),
            "background_light_least": LEAST_BACKGROUND_LIGHT,
            "dark_rise": water.dark_rise,
            "dark_rise_least": water.dark_rise_needed,
        },
        f"The water adds light of {water.background.max():.3f} at the far end (threshold {LEAST_BACKGROUND_LIGHT}), "
        f"BIC gain {water.background_bic:,.0f} (threshold {LEAST_BIC_GAIN:.0f}); the darkest light rises with range by "
        f"{water.dark_rise:.3f}{' beyond what the lamp explains' if terms.lamp.found else ''} "
        f"(threshold {water.dark_rise_needed:.3f})"
        + ("." if water.attenuates else "; without attenuation this is not water."),
    )
    attenuation = decide_by_color(water)
    if attenuation.state == "unknown" and water.adds_light:
        decision = decision.undetermined(attenuation.reason)
    return limited_by_ranges(decision, terms)


def _cost(probe: CostProbe) -> Callable[[], Tensor]:
    medium = Medium.starting(2.0).to(probe.device)
    for parameter in medium.parameters().values():
        parameter.requires_grad_()
    camera, weights = probe.camera, probe.image().detach()
    viewmat, K = (
        torch.as_tensor(matrix, dtype=torch.float32).to(probe.device) for matrix in (camera.world_to_camera, camera.K)
    )

    def work() -> Tensor:
        return (open_water(medium, viewmat, K, camera.width, camera.height, backend=probe.backend) * weights).sum()

    return work


EFFECT = Effect("Backscatter", "medium", decide, cost=_cost)
