"""The water and the lamp of a run, fitted once more to the light of Gaussians in all training images.

Training follows every pixel. At edges, and where Gaussians are in the wrong place, pixels show other surfaces from near
than from far, which looks like water. This fit takes only Gaussians that are at the range that is rendered, and gives
little weight to those whose light no water explains. docs/method.md, section 1, has the formulas.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..base.transfer import srgb_to_linear
from ..effects.lamp import Lamp
from ..effects.scene_effects import SceneEffects
from ..evidence.noise import MAD_TO_SD
from ..gaussians.cloud import GaussianCloud
from ..gaussians.contributions import contribution_sums
from ..kernels.reference.harmonics import C0
from ..kernels.reference.transfer import to_display, to_light
from ..rendering.model import SceneModel
from ..rendering.render import render
from ..rendering.restoration import WIDTH, transmission_and_backscatter
from ..scene.compression import change_by_compression
from ..scene.images import TrainingImage
from ..water.medium import BRIGHTEST, Medium

MOST_GAUSSIANS = 10_000
"""Gaussians that are observed, at most about twice as many."""
MOST_IMAGES = 60
"""Images that are observed, at most about twice as many."""
LEAST_WEIGHT = 0.3
"""Sum of T alpha over the pixels of an image, from which it shows a Gaussian."""
SURFACE_ALPHA = 0.98
"""Alpha from which a pixel shows a surface."""
OPEN_ALPHA = 0.02
"""Alpha up to which it shows open water."""
RANGE_APART = 0.03
"""Relative difference of a Gaussian's range from the rendered one, at most."""
RANGE_SPREAD = 0.05
"""Relative standard deviation of the rendered range over a Gaussian's pixels, at most."""
FEWEST_IMAGES = 3
"""Images that show a Gaussian, at least."""
FEWEST = 1000
"""Observations, at least."""
HEAVIEST = 20.0
"""Weight of an observation, at most, pixels."""
LIGHT_ERROR = 2e-3
"""Standard deviation of light that has nothing to do with a surface's color."""
COLOR_ERROR = 0.1
"""Relative standard deviation of a surface's light between images."""
CUT = 1.5
"""Errors, in standard deviations, from which observations count little (Geman and McClure)."""
PRIOR_ERROR = 0.3
"""Relative standard deviation of the coefficients that training has found: they count where images show little."""
PRIOR_BACKGROUND_ERROR = 0.05
"""Relative standard deviation of the background light that it has found, which is 2 % wrong on the mean. Where no open
water is seen, a brighter one with less backscatter looks nearly the same, and would stand for light that is scattered
several times."""
PRIOR_TAU_ERROR = 1.0
"""Standard deviation of the log of the lamp's tau that training has found."""
STEPS = 15
"""Steps of Levenberg and Marquardt."""
DAMPING = 1e-3
"""Initial damping, relative to the diagonal."""
LEAST = 1e-12
"""Least denominator."""


@dataclass
class GaussianLight:
    """Light of Gaussians in images: M observations, all float64 on the CPU.

    Attributes:
        gaussian: (M,) number of the Gaussian, int64.
        range: (M,) its distance from the camera, scene units.
        light: (M, 3) mean linear light of the pixels that show it, without image effects.
        weight: (M,) sum of T alpha over these pixels, at most HEAVIEST.
        background: (M, 3) background light in its direction.
        open_pixels: Number of pixels that show open water.
        open_ratio: (3,) their mean light over the background light.
    """

    gaussian: Tensor
    range: Tensor
    light: Tensor
    weight: Tensor
    background: Tensor
    open_pixels: float
    open_ratio: Tensor


@torch.no_grad()
def observe_gaussians(
    model: SceneModel,
    images: Sequence[TrainingImage],
    photos: Mapping[str, Path],
    sh_degree: int,
    backend: str = "auto",
) -> GaussianLight:
    """Observe the light of Gaussians in images, where they are the surface that is rendered.

    What compression has changed in a photo is taken as what it changes in a render of it.

    Args:
        model: The Gaussians and the effects, with water.
        images: Training images.
        photos: Their files by the names of their cameras.
        sh_degree: Degree of the Gaussians' colors.
        backend: What renders, as in `kernels_for`.

    Returns:
        The observations.
    """
    cloud, medium = model.cloud, model.effects.medium
    assert isinstance(medium, Medium)
    stride = max(1, len(cloud) // MOST_GAUSSIANS)
    parts: list[tuple[Tensor, ...]] = []
    open_pixels, open_sum = 0.0, torch.zeros(3, dtype=torch.float64)
    for image in images:
        camera = image.camera
        picture = render(cloud, camera, sh_degree, medium, with_range=True, backend=backend, lamp=model.effects.lamp)
        assert picture.range is not None
        plain = to_light(picture.color.clamp(0, 1))
        display = model.effects.apply_to_image(picture.color, camera.name).clamp(0, 1)
        shown = to_light(display)
        change = torch.from_numpy(change_by_compression(photos[camera.name], display.cpu().numpy())).to(plain)
        compressed = to_light((display + change).clamp(min=0))
        photo = torch.from_numpy(srgb_to_linear(image.pixels / np.float32(255))).to(plain)
        light = (photo - compressed + shown) * plain.clamp(min=LEAST) / shown.clamp(min=LEAST)
        valid = torch.from_numpy(image.valid).to(plain.device)
        surface = (valid & (picture.alpha > SURFACE_ALPHA)).to(plain)[..., None]
        seen = picture.range[..., None]
        sums = contribution_sums(
            cloud, camera, torch.cat([light, seen, seen.square(), torch.ones_like(seen)], -1) * surface, backend
        )[::stride]
        offsets = cloud.means[::stride] - torch.from_numpy(camera.centre).to(cloud.means)
        ranges, weight = offsets.norm(dim=1), sums[:, 5]
        mean = sums[:, :5] / weight.clamp(min=LEAST)[:, None]
        spread = (mean[:, 4] - mean[:, 3].square()).clamp(min=0).sqrt()
        chosen = (
            (weight > LEAST_WEIGHT)
            & ((mean[:, 3] - ranges).abs() < RANGE_APART * ranges)
            & (spread < RANGE_SPREAD * mean[:, 3])
        )
        directions = offsets[chosen] / ranges[chosen, None]
        found = ranges[chosen], mean[chosen, :3], weight[chosen], medium.background_light(directions)
        parts.append((torch.nonzero(chosen)[:, 0].cpu(), *(values.double().cpu() for values in found)))
        if picture.behind is not None:
            empty = valid & (picture.alpha < OPEN_ALPHA)
            open_pixels += float(empty.sum())
            open_sum += (light / to_light(picture.behind).clamp(min=LEAST))[empty].double().sum(0).cpu()
    gaussian, ranges, light, weight, background = (torch.cat(column) for column in zip(*parts, strict=True))
    enough = torch.bincount(gaussian, minlength=1)[gaussian] >= FEWEST_IMAGES
    return GaussianLight(
        gaussian[enough],
        ranges[enough],
        light[enough],
        weight[enough].clamp(max=HEAVIEST),
        background[enough],
        open_pixels,
        open_sum / max(open_pixels, 1.0),
    )


@torch.no_grad()
def fit_water(observed: GaussianLight, medium: Medium, lamp: Lamp | None = None) -> tuple[Medium, Lamp | None]:
    """Fit attenuation, backscatter, background light and the fall-off of a lamp to observations.

    The light J of each Gaussian is eliminated (variable projection, Golub and Pereyra 1973).

    Args:
        observed: The observations.
        medium: The water that training has found.
        lamp: The lamp that training has found.

    Returns:
        The water and the lamp; the change of the background light by direction stays.
    """
    start = medium.to(torch.device("cpu"))
    light = Lamp.starting(start.unit_range, 1.0) if lamp is None else lamp
    # beta_D, beta_B, a factor of the background light, and the log of tau, which is that of all channels.
    log_tau = light.log_tau.detach().cpu().expand(3)
    values = torch.stack([start.beta_D, start.beta_B, torch.ones(3), log_tau]).double()
    directions = _directions(start, lamp)
    gaussian = observed.gaussian.unique(return_inverse=True)[1]
    count = int(gaussian.max()) + 1
    r, background = observed.range[:, None], observed.background
    squared = (r / light.unit_range).square()

    def summed(each: Tensor) -> Tensor:
        return each.new_zeros((count, *each.shape[1:])).index_add(0, gaussian, each)

    def terms(at: Tensor) -> tuple[Tensor, Tensor]:
        transmission = torch.exp(-at[0] * r)
        if lamp:
            tau = at[3].exp()
            transmission = transmission * (tau + 1) / (tau + squared)
        return transmission, at[2] * background * -torch.expm1(-at[1] * r)

    def surfaces(at: Tensor, weight: Tensor) -> Tensor:
        transmission, added = terms(at)
        information = summed(weight * transmission.square()).clamp(min=LEAST)
        return (summed(weight * transmission * (observed.light - added)) / information).clamp(min=0)

    def misfit(at: Tensor, J: Tensor) -> Tensor:
        transmission, added = terms(at)
        return observed.light - transmission * J[gaussian] - added

    def cost(at: Tensor, J: Tensor, weight: Tensor, precision: Tensor, known: Tensor) -> Tensor:
        return (weight * misfit(at, J).square()).sum() + (precision * (at - known).square()).sum()

    prior_error = PRIOR_ERROR * values
    prior_error[2] = PRIOR_BACKGROUND_ERROR
    prior_error[3] = PRIOR_TAU_ERROR * 3**0.5  # it counts in each channel
    prior = values.clone()
    weight = observed.weight[:, None].expand(-1, 3)
    J, damping = surfaces(values, weight), DAMPING
    for _ in range(STEPS):
        error = misfit(values, J)
        variance = LIGHT_ERROR**2 + (COLOR_ERROR * terms(values)[0] * J[gaussian]).square()
        scale = MAD_TO_SD * (error.abs() / variance.sqrt()).median(0).values.clamp(min=LEAST)
        variance = variance * scale.square()
        weight = observed.weight[:, None] / variance / (1 + error.square() / variance / CUT**2).square()
        # What is known beside the light of Gaussians: what training has found, and the light of open water.
        precision, known = 1 / prior_error.square(), prior.clone()
        open_weight = observed.open_pixels * background.square().mean(0) / (LIGHT_ERROR * scale).square()
        known[2] = (precision[2] * prior[2] + open_weight * observed.open_ratio) / (precision[2] + open_weight)
        precision[2] += open_weight
        J = surfaces(values, weight)
        error = misfit(values, J)
        transmission, added = terms(values)
        by_beta_B = values[2] * background * r * torch.exp(-values[1] * r)
        tau = values[3].exp()
        by_log_tau = transmission * J[gaussian] * (tau / (tau + 1) - tau / (tau + squared))
        slopes = torch.stack([-r * transmission * J[gaussian], by_beta_B, added / values[2], by_log_tau], -1)
        information = summed(weight * transmission.square()).clamp(min=LEAST)
        of_J = summed((weight * transmission)[..., None] * slopes) / information[..., None]
        slopes = slopes - transmission[..., None] * of_J[gaussian]
        normal = torch.einsum("mc,mcr,mcs->crs", weight, slopes, slopes) + torch.diag_embed(precision.T)
        right = torch.einsum("mc,mcr,mc->rc", weight, slopes, error) + precision * (known - values)
        normal = torch.einsum("prc,crs,qsc->pq", directions, normal, directions)
        right = torch.einsum("prc,rc->p", directions, right)
        step = torch.linalg.solve(normal + damping * normal.diagonal().diag(), right)
        tried = values + torch.einsum("p,prc->rc", step, directions)
        tried[:3] = torch.maximum(tried[:3], LEAST * prior[:3])
        J_tried = surfaces(tried, weight)
        better = cost(tried, J_tried, weight, precision, known) < cost(values, J, weight, precision, known)
        values, J, damping = (tried, J_tried, damping / 5) if better else (values, J, damping * 10)
    fitted = Medium.starting(start.unit_range, start.light, values[0].float(), values[1].float())
    fitted.background_sh = start.background_sh
    if start.background_sh is not None:
        B = (start.background_sh[0] * C0).sigmoid() * values[2].float()
        fitted.background_sh = torch.cat([torch.logit(B, eps=1e-3)[None] / C0, start.background_sh[1:]])
    if start.backscatter is None:
        fitted.backscatter = None
    return fitted, lamp and Lamp(values[3, 0].float(), lamp.unit_range)


def _directions(medium: Medium, lamp: Lamp | None) -> Tensor:
    """Return the directions (P, 4, 3) in which beta_D, beta_B, the background light's factor and log tau can change."""
    each = torch.eye(12, dtype=torch.float64).reshape(4, 3, 4, 3)
    # Without a coefficient of its own backscatter rises with beta_D.
    water = [*each[:3]] if medium.backscatter is not None else [each[0] + each[1], each[2]]
    return torch.cat(water + ([each[3].sum(0, keepdim=True)] if lamp else []))


@torch.no_grad()
def colors_through(
    cloud: GaussianCloud,
    images: Sequence[TrainingImage],
    before: SceneEffects,
    after: SceneEffects,
    backend: str = "auto",
) -> Tensor:
    """Find the colors that look the same through another water and under another lamp, by least squares over images.

    Args:
        cloud: The N Gaussians.
        images: Images whose cameras count.
        before: The water and the lamp that their colors were found with.
        after: The others.
        backend: What computes, as in `kernels_for`.

    Returns:
        (N, 3) display values; those of Gaussians that no image shows stay.
    """
    assert isinstance(before.medium, Medium) and isinstance(after.medium, Medium)
    colors = 0.5 + C0 * cloud.sh0[:, 0]
    J = to_light(colors.clamp(min=0))
    numerator, information = torch.zeros_like(colors), torch.zeros_like(colors)
    for image in images:
        camera = image.camera
        weight = contribution_sums(cloud, camera, colors.new_ones(camera.height, camera.width, 1), backend)
        shown = weight[:, 0].nonzero()[:, 0]
        weight = weight[shown]
        offsets = cloud.means[shown] - torch.from_numpy(camera.centre).to(cloud.means)
        passed, added = transmission_and_backscatter(offsets, before.medium, before.lamp, backend)
        transmission, backscatter = transmission_and_backscatter(offsets, after.medium, after.lamp, backend)
        numerator[shown] += weight * transmission * (passed * J[shown] + added - backscatter)
        information[shown] += weight * transmission.square()
    found = to_display((numerator / information.clamp(min=LEAST)).clamp(min=0)).clamp(max=BRIGHTEST)
    return torch.where(information > LEAST, found, colors)


@torch.no_grad()
def fit_again(
    model: SceneModel,
    images: Sequence[TrainingImage],
    photos: Mapping[str, Path],
    sh_degree: int,
    backend: str = "auto",
) -> bool:
    """Fit water and lamp of a model again, and give its Gaussians the colors that look the same with them, in place.

    Args:
        model: The Gaussians and the effects, with water.
        images: Training images.
        photos: Their files by the names of their cameras.
        sh_degree: Degree of the Gaussians' colors.
        backend: What computes, as in `kernels_for`.

    Returns:
        Whether there were enough observations; otherwise nothing changes.
    """
    cloud, effects = model.cloud, model.effects
    assert isinstance(effects.medium, Medium)
    some = [image.resized(min(image.camera.width, WIDTH)) for image in images[:: max(1, len(images) // MOST_IMAGES)]]
    observed = observe_gaussians(model, some, photos, sh_degree, backend)
    if len(observed.gaussian) < FEWEST:
        return False
    medium, lamp = fit_water(observed, effects.medium, effects.lamp)
    fitted = SceneEffects({"medium": medium} | ({"lamp": lamp} if lamp else {})).to(cloud.means.device)
    colors = colors_through(cloud, some, effects, fitted, backend)
    for name, tensor in fitted.parameters().items():
        effects.parameters()[name].copy_(tensor)
    cloud.sh0[:, 0] = (colors - 0.5) / C0
    return True
