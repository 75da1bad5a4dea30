"""Relocation: Gaussians of least importance are removed and those of largest error cloned; their number stays.

After SWAGSplatting (docs/method.md, section 6), with scores that the water does not dim and clones that do not change
the image.
"""

import math

import torch
from torch import Tensor

from .cloud import GaussianCloud
from .densify import PER_GAUSSIAN, rotation_matrices

CLONE_OPACITY = 0.02
"""Largest opacity of a clone: faint enough not to change the image, large enough to get a gradient."""
CLONE_OFFSET = 0.25
"""Distance of a clone from its parent, standard deviations along the longest axis."""


@torch.no_grad()
def relocate(
    cloud: GaussianCloud, S: Tensor, E: Tensor, fraction: float = 0.1, identical: bool = False
) -> tuple[GaussianCloud, Tensor]:
    """Remove the floor(fraction N) Gaussians of lowest importance and clone as many of highest error among the others.

    Args:
        cloud: The N Gaussians; not changed.
        S: (N,) importance.
        E: (N,) error.
        fraction: Fraction of the Gaussians that are relocated, at most 1/2.
        identical: Whether clones are copies, which change the image (SWAGSplatting); otherwise a clone is faint and
            takes its opacity from its parent (`parents_and_clones`).

    Returns:
        The cloud of N Gaussians, and for each the index (N,) of the Gaussian whose optimiser state it keeps, -1 for
        clones and their parents.
    """
    n = int(fraction * len(cloud))
    # Stable sorts break ties by index: the same run always relocates the same Gaussians.
    by_importance = torch.sort(S, stable=True).indices
    survivors = by_importance[n:].sort().values
    place = torch.sort(E[survivors], descending=True, stable=True).indices[:n]
    kept = {name: getattr(cloud, name)[survivors] for name in PER_GAUSSIAN}
    clones = {name: values[place] for name, values in kept.items()}
    if not identical:
        parents, clones = parents_and_clones(GaussianCloud(**clones, background=cloud.background))
        for name, values in kept.items():
            values[place] = parents[name]
    source = survivors.clone()
    source[place] = -1
    moved = GaussianCloud(
        **{name: torch.cat([values, clones[name]]) for name, values in kept.items()}, background=cloud.background
    )
    assert len(moved) == len(cloud), f"relocation made {len(moved)} Gaussians of {len(cloud)}"
    return moved, torch.cat([source, torch.full_like(place, -1)])


def parents_and_clones(
    cloud: GaussianCloud, opacity: float = CLONE_OPACITY, offset: float = CLONE_OFFSET
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Divide each Gaussian into a parent and a clone that together look as it did.

    The clone gets `opacity`, half of the optical depth -log(1 - o) at most, and the parent what keeps the centre as
    opaque; both shrink so that the integral along a line through the centre stays: for halves that is the formula of
    3DGS-MCMC (arXiv 2404.09591) with N = 2. The clone moves along the longest axis and shrinks along it to what then
    fits inside; the parent stays where it is, in the same order of depth.

    Args:
        cloud: The Gaussians.
        opacity: Largest opacity of a clone, 0..1.
        offset: Distance of the clone from its parent, standard deviations along the longest axis.

    Returns:
        Tensors of the parents and of the clones, by name.
    """
    o = cloud.opacities.double().clamp(max=1 - 1e-6)
    b = (1 - (1 - o).sqrt()).clamp(max=opacity)
    a = 1 - (1 - o) / (1 - b)
    shrink = (o / (a + b - a * b / 2**0.5)).log()[:, None].to(cloud.means)
    parents = {name: getattr(cloud, name).clone() for name in PER_GAUSSIAN}
    parents["log_scales"] = cloud.log_scales + shrink
    clones = {name: values.clone() for name, values in parents.items()}
    parents["opacity_logits"], clones["opacity_logits"] = (torch.logit(t).to(cloud.means) for t in (a, b))
    scales = cloud.scales
    longest, rows = scales.argmax(dim=1), torch.arange(len(cloud), device=scales.device)
    axis = rotation_matrices(cloud.quats)[rows, :, longest]
    clones["means"] += offset * scales[rows, longest, None] * axis
    clones["log_scales"][rows, longest] += 0.5 * math.log(1 - offset**2)
    return parents, clones
