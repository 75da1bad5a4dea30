"""Separate backscatter: the light that the water adds grows with range by a coefficient of its own."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..evidence.decision import Decision
from ..evidence.scene_evidence import SceneEvidence
from ..evidence.water_terms import LEAST_BIC_GAIN
from .effect import Effect
from .range_limits import too_few_observations


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide together with backscatter.

    Water has two coefficients (Akkaynak and Treibitz 2018) even where points cannot distinguish them, and one in place
    of two costs colors: delta E 13.6 against 10.8 on the demo scene.
    """
    terms = evidence.water_terms
    if terms is None:
        return too_few_observations(evidence)
    found = terms.water.backscatters and terms.separate_bic > LEAST_BIC_GAIN
    ratio = terms.separate.beta_B / np.maximum(terms.separate.beta_D, 1e-12)
    decision = Decision(
        "on" if found else "off",
        {"bic_gain": terms.separate_bic, "bic_gain_least": LEAST_BIC_GAIN, "ratio": ratio.tolist()},
        f"A coefficient of its own explains the colors with a BIC gain of {terms.separate_bic:,.0f} (threshold "
        f"{LEAST_BIC_GAIN:.0f})" + ("." if terms.water.backscatters else "; there is no backscatter."),
    )
    if earlier["backscatter"].state == "on" and not found:
        return replace(
            decision, state="on", reason=f"Water has two coefficients, and the second costs nothing. {decision.reason}"
        )
    return decision


EFFECT = Effect("Separate backscatter", "medium", decide)
