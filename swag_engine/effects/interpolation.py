"""Interpolation: frames are made between images that are far apart."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..evidence.decision import Decision
from ..evidence.scene_evidence import SceneEvidence
from ..priors.interpolate import interpolation_test, neighbour_pairs
from ..scene.split import split_views
from .effect import Effect

MOST_IMAGES = 40
"""Images up to which a scene may have too few."""
MOST_SHARED = 0.5
"""Fraction of their points that neighbouring images share, below which they are far apart."""


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from the points that neighbouring images share.

    The network is asked only where the images call for it: it takes seconds a frame.
    """
    views = evidence.scene.views
    names = [view.name for view in views]
    pairs = neighbour_pairs(names, split_views(names).train)
    seen = {view.name: view.point_indices for view in views}
    shared = [len(np.intersect1d(seen[a], seen[b])) / max(min(len(seen[a]), len(seen[b])), 1) for a, b in pairs]
    shared_fraction = float(np.median(shared)) if shared else float("nan")
    figures: dict[str, Any] = {
        "images": len(views),
        "images_most": MOST_IMAGES,
        "shared_points": shared_fraction,
        "shared_points_most": MOST_SHARED,
    }
    if not pairs:
        return Decision("off", figures, "No two training photos follow each other.")
    if len(views) > MOST_IMAGES:
        return Decision("off", figures, f"There are {len(views)} photos; up to {MOST_IMAGES} may be too few.")
    if shared_fraction >= MOST_SHARED:
        reason = f"Neighbouring photos share {shared_fraction:.0%} of their points (threshold {MOST_SHARED:.0%})."
        return Decision("off", figures, reason)
    sparse = f"Neighbouring photos share only {shared_fraction:.0%} of their points (threshold {MOST_SHARED:.0%})"
    if evidence.interpolator is None:
        return Decision("unknown", figures, f"{sparse}; an interpolation network is needed to judge frames.")
    judged = interpolation_test(evidence.interpolator, {image.camera.name: image for image in evidence.images}, pairs)
    figures |= {"psnr": judged.psnr, "gain": judged.gain, "consistent": judged.consistent}
    if judged.accepted:
        return Decision("on", figures, f"{sparse}, and made frames match left-out ones at {judged.psnr:.1f} dB.")
    return Decision("off", figures, judged.reason)


EFFECT = Effect("Interpolation", "training images", decide, needs_network=True)
