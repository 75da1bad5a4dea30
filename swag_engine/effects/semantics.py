"""Semantics: Gaussians get labels."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.image_cells import open_water_cells
from ..evidence.scene_evidence import SceneEvidence
from ..gaussians.init import gaussians_from_points
from ..scene.colmap import Points
from ..semantics.assign import FEATURES_EVERY, labels_in_view, semantic_loss
from ..semantics.embed import DIMENSIONS
from .effect import CostProbe, Effect

LEAST_OPEN_WATER = 0.05
"""Fraction of the images that open water must cover for labels to be worth their time."""
PROBE_LABELS = 8
"""Labels of the image on which the cost is measured."""


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from the user's wish, or from open water, which counts where there is backscatter."""
    backscatter = earlier["backscatter"].state == "on"
    covered = float(np.mean(open_water_cells(evidence.images, evidence.scene))) if backscatter else 0.0
    figures: dict[str, Any] = {
        "wanted": evidence.labels_wanted,
        "open_water": covered,
        "open_water_least": LEAST_OPEN_WATER,
    }
    if evidence.labels_wanted:
        return Decision("on", figures, "Labels were asked for.")
    return Decision(
        "on" if covered > LEAST_OPEN_WATER else "off",
        figures,
        f"Open water covers {covered:.0%} of the photos (threshold {LEAST_OPEN_WATER:.0%})"
        + ("." if backscatter else ": there is no backscatter."),
    )


def _cost(probe: CostProbe) -> Callable[[], Tensor]:
    camera, count = probe.camera, probe.gaussians
    height, width = camera.height, camera.width
    features, targets = probe.random(count, DIMENSIONS), probe.random(count, DIMENSIONS).detach()
    places = np.random.default_rng(0).uniform(-1, 1, (count, 3)) * [1, height / width, 0.01] + [0, 0, 2]
    unseen = np.zeros(count)
    points = Points(places, np.zeros(places.shape, np.uint8), unseen, unseen)
    cloud = gaussians_from_points(points, count, 0, 0, np.zeros(3)).to(probe.device)
    labels = np.arange(width) * PROBE_LABELS // width + np.ones((height, 1), int)
    return lambda: semantic_loss(features, targets, labels_in_view(cloud, camera, labels, probe.backend) > 0)


EFFECT = Effect("Semantics", "labels", decide, cost=_cost, cost_every=FEATURES_EVERY, needs_network=True)
