"""Depth prior: predicted depth helps where sparse points are few."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.image_cells import points_in_cells
from ..evidence.scene_evidence import SceneEvidence
from ..priors.depth import depth_priors
from .effect import CostProbe, Effect

LEAST_CELLS = 0.5
"""Fraction of the cells of images that sparse points must cover to suffice."""
LEAST_POINTS = 500
"""Sparse points an image must have to suffice."""
LEAST_ACCEPTED = 0.8
"""Fraction of the images whose predicted depth must agree with the sparse points."""
COVERED = 0.5
"""Alpha from which a pixel shows a surface."""


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from the number of sparse points; the network is asked only where they are few."""
    counts = points_in_cells(evidence.images, evidence.scene)
    cells, points = float((counts > 0).mean()), float(np.median(counts.sum((1, 2))))
    figures: dict[str, Any] = {
        "cells": cells,
        "cells_least": LEAST_CELLS,
        "points": points,
        "points_least": LEAST_POINTS,
    }
    found = (
        f"{points:.0f} sparse points a photo (threshold {LEAST_POINTS}) in {cells:.0%} of its cells (threshold "
        f"{LEAST_CELLS:.0%})"
    )
    if cells >= LEAST_CELLS and points >= LEAST_POINTS:
        return Decision("off", figures, f"Sparse points suffice: {found}.")
    if evidence.depth is None:
        return Decision("unknown", figures, f"Sparse points are few: {found}; a depth network is needed.")
    _, alignments = depth_priors(evidence.depth, evidence.images, evidence.scene)
    accepted = float(np.mean([alignment.accepted for alignment in alignments.values()]))
    figures |= {"accepted": accepted, "accepted_least": LEAST_ACCEPTED}
    return Decision(
        "on" if accepted >= LEAST_ACCEPTED else "off",
        figures,
        f"Sparse points are few: {found}; predicted depth agrees with them in {accepted:.0%} of the photos (threshold "
        f"{LEAST_ACCEPTED:.0%}).",
    )


def depth_loss(range_image: Tensor, alpha: Tensor, q: Tensor, median_range: float, pearson: bool = False) -> Tensor:
    """Measure how far a rendered range is from the prior (docs/method.md section 3).

    Args:
        range_image: D (H, W), alpha-weighted and normalised range in scene units.
        alpha: (H, W); pixels with alpha > COVERED count.
        q: (H, W) inverse range of the prior, not finite where there is none.
        median_range: Median range of the scene, scene units.
        pearson: Use 1 - the correlation of 1/D and q in place of mean |1/D - q| median_range.

    Returns:
        The loss, a scalar, 0 where no pixel counts; differentiable in range_image with finite gradients where D is 0.
    """
    counted = (alpha > COVERED) & (range_image > 1e-6 * median_range) & q.isfinite()
    # The denominator is chosen before dividing: 0/0 behind a mask is NaN in the backward pass.
    chosen = torch.where(counted, range_image, torch.ones_like(range_image))
    inverse, target = (
        torch.where(counted, median_range * values, torch.zeros_like(values)) for values in (1 / chosen, q)
    )
    count = counted.sum().clamp(min=1)
    if not pearson:
        return (inverse - target).abs().sum() / count
    x, y = (
        torch.where(counted, values - values.sum() / count, torch.zeros_like(values)) for values in (inverse, target)
    )
    # A spread of a thousandth of the median range is as good as none, and must not blow the gradient up.
    spread = ((x.square().sum() / count + 1e-6) * (y.square().sum() / count + 1e-6)).sqrt()
    return torch.where(counted.any(), 1 - (x * y).sum() / count / spread, spread * 0)


def _cost(probe: CostProbe) -> Callable[[], Tensor]:
    ranges = probe.random(probe.camera.height, probe.camera.width)
    solid = torch.ones_like(ranges)
    return lambda: depth_loss(ranges + 1, solid, solid * 0.5, 2.0)


EFFECT = Effect("Depth prior", "training images", decide, cost=_cost, needs_network=True)
