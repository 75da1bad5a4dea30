"""Gaussians taken from where they show least and put to where the error is largest; their number stays.

After SWAGSplatting's reallocation, with scores that the water does not dim and clones that do not show.
"""

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from ..effects.lamp import Lamp, lit
from ..rasterize.api import contributions
from ..rasterize.render import render
from ..scene.cameras import Camera
from ..water.medium import MAX_DEGREE, Medium, through_water
from ..water.network import WaterNetwork
from .cloud import GaussianCloud
from .grow import PER_GAUSSIAN, rotation_matrices

CLONE_OPACITY = 0.02
CLONE_OFFSET = 0.25
"""Of a clone from its parent, in standard deviations along the longest axis."""
ENDLESS = 1e6
"""Ranges longer than this many times are through nothing but water."""


def scores(
    cloud: GaussianCloud,
    views: Iterable[tuple[Camera, Callable[[Tensor], Tensor]]],
    sh_degree: int = 3,
    medium: Medium | WaterNetwork | None = None,
    water_degree: int = MAX_DEGREE,
    backend: str = "auto",
    lamp: Lamp | None = None,
) -> tuple[Tensor, Tensor]:
    """Importance S (N,) and error E (N,) of the Gaussians over all `views`, as sums of rasterize.api.Contributions.

    views: cameras, each with the loss (a scalar) of a picture (H, W, 3) seen through it. The other arguments are
    those of rasterize.render. With a medium each view's figures are divided by visibility() squared.
    """
    S, E = torch.zeros_like(cloud.opacity_logits), torch.zeros_like(cloud.opacity_logits)
    for camera, loss in views:
        with torch.no_grad():
            color = render(cloud, camera, sh_degree, medium, water_degree, backend=backend, lamp=lamp).color
        gradient = torch.autograd.grad(loss(color.requires_grad_()), color)[0]
        with torch.no_grad():
            centre, viewmat, K = (
                torch.from_numpy(array).to(cloud.means) for array in (camera.centre, camera.world_to_camera, camera.K)
            )
            offsets = cloud.means - centre
            colors, background = cloud.colors(centre, sh_degree, backend), cloud.background.sigmoid()
            if lamp is not None:
                colors = lit(colors, offsets.norm(dim=1), lamp)
            if isinstance(medium, Medium) and medium.veil is None:
                colors = through_water(colors, offsets, medium, water_degree, 1.0, backend)
            elif isinstance(medium, Medium):
                # Open water has no constant colour, but over one Gaussian it nearly has: taken off both sides of
                # the formula, the colours are differences from it and nothing is behind.
                water = through_water(torch.zeros_like(colors), ENDLESS * offsets, medium, water_degree, 1.0, backend)
                colors = through_water(colors, offsets, medium, water_degree, 1.0, backend) - water
                background = torch.zeros_like(background)
            elif medium is not None:
                colors = medium.through(colors, offsets)
            seen = contributions(
                cloud.means,
                cloud.quats,
                cloud.scales,
                cloud.opacities,
                colors,
                viewmat,
                K,
                camera.width,
                camera.height,
                background,
                image_gradient=gradient,
                backend=backend,
            )
            dimmed = visibility(medium, offsets).square() if medium is not None else 1.0
            S += seen.importance / dimmed
            E += seen.error / dimmed
    return S, E


def visibility(medium: Medium | WaterNetwork, offsets: Tensor) -> Tensor:
    """(N,) part of the light that comes through the water, at least .1, at offsets (N, 3) from the camera.

    What far structure adds to a picture is so much less than the same structure nearby.
    """
    if isinstance(medium, Medium):
        transmission = torch.exp(-medium.beta_D * offsets.norm(dim=1, keepdim=True))
    else:
        transmission = medium.transmission(offsets)
    return transmission.mean(dim=1).clamp(0.1, 1.0)


@torch.no_grad()
def reallocate(
    cloud: GaussianCloud, S: Tensor, E: Tensor, fraction: float = 0.1, identical: bool = False
) -> tuple[GaussianCloud, Tensor]:
    """Take away the floor(fraction N) Gaussians of lowest S (N,) and clone as many of highest E among the others.

    Returns the cloud, of N Gaussians as before, and for each the index (N,) of the Gaussian whose optimiser state it
    continues, -1 for clones and their parents. fraction: at most 1/2. identical: clones are copies and change the
    picture (SWAGSplatting); otherwise a clone begins faint, as a small part of its parent (divided).
    """
    n = int(fraction * len(cloud))
    # Stable sorts break ties by index: the same run always moves the same Gaussians.
    by_importance = torch.sort(S, stable=True).indices
    survivors = by_importance[n:].sort().values
    place = torch.sort(E[survivors], descending=True, stable=True).indices[:n]
    kept = {name: getattr(cloud, name)[survivors] for name in PER_GAUSSIAN}
    clones = {name: values[place] for name, values in kept.items()}
    if not identical:
        parents, clones = divided(GaussianCloud(**clones, background=cloud.background))
        for name, values in kept.items():
            values[place] = parents[name]
    source = survivors.clone()
    source[place] = -1
    moved = GaussianCloud(
        **{name: torch.cat([values, clones[name]]) for name, values in kept.items()}, background=cloud.background
    )
    assert len(moved) == len(cloud), f"a reallocation made {len(moved)} Gaussians of {len(cloud)}"
    return moved, torch.cat([source, torch.full_like(place, -1)])


def divided(
    cloud: GaussianCloud, opacity: float = CLONE_OPACITY, offset: float = CLONE_OFFSET
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Each Gaussian as a parent and a clone that together look as it did: their parameters by name.

    The clone gets `opacity`, half of the optical depth -log(1 - o) at most, and the parent what keeps the centre as
    opaque; both shrink so that the integral along a line through the centre stays: for halves that is the formula of
    3DGS-MCMC (arXiv 2404.09591) with N = 2. The clone moves `offset` standard deviations along the longest axis and
    shrinks along it to what then fits inside; the parent stays where it is, in the same order of depth.
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
