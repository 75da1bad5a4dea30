"""Ranges from which effects that change with range cannot be determined."""

from ..evidence.decision import Decision
from ..evidence.observations import LEAST_OBSERVATIONS, LEAST_RANGE_RATIO
from ..evidence.scene_evidence import SceneEvidence
from ..evidence.water_terms import WaterTerms

MOST_RADIUS_CORRELATION = 0.75
"""Correlation of range with the distance from the image centre above which a lens' fall-off looks like water."""


def too_few_observations(evidence: SceneEvidence) -> Decision:
    """Return the decision where too few sparse points can be used."""
    count = len(evidence.observations)
    return Decision(
        "unknown",
        {"observations": count, "observations_least": LEAST_OBSERVATIONS},
        f"Cannot be determined: only {count} observations of points can be used ({LEAST_OBSERVATIONS} at least).",
    )


def limited_by_ranges(decision: Decision, terms: WaterTerms) -> Decision:
    """Make a decision "unknown" where ranges vary too little, or with the distance from the image centre."""
    ratio, correlation = terms.range_ratio, terms.radius_correlation
    decision.evidence.update(
        range_ratio=ratio,
        range_ratio_least=LEAST_RANGE_RATIO,
        radius_correlation=correlation,
        radius_correlation_most=MOST_RADIUS_CORRELATION,
    )
    if ratio < LEAST_RANGE_RATIO:
        return decision.undetermined(
            f"Cannot be determined: points are seen from ranges of ratio {ratio:.2f} at most ({LEAST_RANGE_RATIO} at "
            "least)."
        )
    if correlation > MOST_RADIUS_CORRELATION:
        return decision.undetermined(
            "Cannot be distinguished from the lens' fall-off: range and distance from the image centre vary together "
            f"(correlation {correlation:.2f}, {MOST_RADIUS_CORRELATION} at most)."
        )
    return decision
