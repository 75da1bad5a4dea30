"""Limit restored colors where noise and errors of the water exceed what is left of their light.

Restoring divides by the transmission of the water, so that far away it multiplies noise and what is wrong with the
water until only these are seen. docs/method.md, section 1, has the formulas.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from ..effects.lamp import Lamp, lit
from ..evidence.noise import Noise
from ..gaussians.cloud import GaussianCloud
from ..gaussians.contributions import contribution_sums
from ..kernels.reference.harmonics import C0
from ..kernels.reference.transfer import to_display, to_light
from ..rasterize.api import rasterize
from ..scene.cameras import Camera
from ..water.medium import Medium, through_water

BACKSCATTER_ERROR = 0.1
"""Relative standard error of the backscatter, alike in all images: median of B and beta_B (docs/water.md)."""
ATTENUATION_ERROR = 0.1
"""Relative standard error of the attenuation, between median and 90th percentile (docs/water.md)."""
RESTORED_FROM = 0.5
"""Confidence from which a color counts as restored: its variance is below that of the scene's colors."""
CONFIDENCE = "confidence"
"""Property of splats in files: confidence of the least certain channel, 0..1."""
WIDTH = 320
"""Width at which Gaussians are weighed at most, pixels: wider images change confidences by thousandths."""
LEAST_TOLD = 0.005
"""Fraction of what the images show from which the user is told that it cannot be restored."""
STORED = "restoration."
"""Start of the names of the tensors in a checkpoint."""
LEAST = 1e-12
"""Least denominator."""
BRIGHTEST_COLOR = 2.0
"""Largest display value of a color: brighter ones are of Gaussians that images hardly show."""
MOST_ERROR = 1e6
"""Largest variance of an error: keeps matrices of doubles invertible."""
HAZE_FROM = 0.5
"""Score of haze from which a Gaussian is no surface, whose color would count."""
PRIOR_GAUSSIANS = 5000
"""Gaussians, at most about twice as many, that the distribution of the scene's colors is found from."""
PRIOR_STEPS = 30
"""Steps of expectation maximisation: 270 more change display values by less than .001 of 255 (4000 test colors)."""


@dataclass
class RestorationLimit:
    """How far the colors of N Gaussians can be restored, and the colors that are most likely.

    Attributes:
        confidence: (N, 3) in 0..1 of red, green and blue.
        color: (N, 3) display values.
    """

    confidence: Tensor
    color: Tensor

    @classmethod
    def from_checkpoint(cls, tensors: Mapping[str, Tensor]) -> "RestorationLimit | None":
        """Read the limit from the tensors of a checkpoint; None where it has none."""
        stored = {field.name: tensors.get(STORED + field.name) for field in fields(cls)}
        found = {name: tensor for name, tensor in stored.items() if tensor is not None}
        return cls(**found) if len(found) == len(stored) else None

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors, named for a checkpoint, on the CPU."""
        return {STORED + field.name: getattr(self, field.name).cpu() for field in fields(self)}

    @property
    def least_confidence(self) -> Tensor:
        """(N,) confidence of the least certain channel."""
        return self.confidence.min(dim=1).values

    @torch.no_grad()
    def apply(self, cloud: GaussianCloud, water: float = 0.0) -> GaussianCloud:
        """Return the cloud with the likely colors, which change with direction as far as they are certain.

        Through all of the water the colors as trained are right, as they were compared with the photos through it.
        Through a fraction w of it, errors of colors count as 1 - w of what they are without water.

        Args:
            cloud: The Gaussians as trained.
            water: Fraction of the water that they are seen through, 0..1.
        """
        if water == 1:
            return cloud
        confidence, color = (values.to(cloud.means)[:, None] for values in (self.confidence, self.color))
        # A confidence is s / (s + e) of the variances s of colors and e of errors; e becomes (1 - w)^2 e.
        left = (1 - water) ** 2
        certain = confidence / (confidence + left * (1 - confidence))
        sh0 = torch.lerp((color - 0.5) / C0, cloud.sh0, certain * (1 - left))
        return replace(cloud, sh0=sh0, shN=certain * cloud.shN)


@dataclass
class LightSums:
    """Sums over images for each of N Gaussians and each channel, all (N, 3).

    The weight of a Gaussian in an image is the sum of T alpha over the pixels. Least squares on the images determine
    its light J from light = transmission * J + backscatter as sum(weight * transmission * (light - backscatter)) /
    sum(weight * transmission^2); what is wrong with the terms of the numerator is wrong with J in the same way.

    Attributes:
        weight: The weight.
        light: Of weight * light as it reaches the camera.
        information: Of weight * transmission^2.
        backscatter: Of weight * transmission * backscatter.
        optical_depth: Of weight * transmission^2 * (-log transmission).
        noise: Of weight * transmission^2 * variance of a pixel.
    """

    weight: Tensor
    light: Tensor
    information: Tensor
    backscatter: Tensor
    optical_depth: Tensor
    noise: Tensor

    def add(
        self,
        chosen: Tensor,
        weight: Tensor,
        light: Tensor,
        transmission: Tensor,
        backscatter: Tensor,
        variance: Tensor,
    ) -> None:
        """Add an image.

        Args:
            chosen: (M,) index of the Gaussians that it shows.
            weight: (M, 1) pixels.
            light: (M, 3) light that reaches the camera.
            transmission: (M, 3) fraction of J in it; above 1 where a lamp is near.
            backscatter: (M, 3) the rest of it.
            variance: (M, 3) of a pixel of that light.
        """
        information = weight * transmission.square()
        self.weight[chosen] += weight
        self.light[chosen] += weight * light
        self.information[chosen] += information
        self.backscatter[chosen] += weight * transmission * backscatter
        self.optical_depth[chosen] -= information * transmission.clamp(LEAST, 1.0).log()
        self.noise[chosen] += information * variance

    def rows(self, chosen: Tensor) -> "LightSums":
        """Return the sums of the Gaussians where `chosen` (N,) is True."""
        return LightSums(*(getattr(self, entry.name)[chosen] for entry in fields(self)))

    def signal(self, J: Tensor) -> Tensor:
        """Return the mean square (3,) of the light J (N, 3) of the scene.

        Gaussians count by their information, or the noise of the far ones would pass for color.
        """
        return (self.information * J.square()).sum(0) / self.information.sum(0).clamp(min=LEAST)

    def error(self, signal: Tensor) -> Tensor:
        """Return the variance (N, 3) of the error of J, by noise and by errors of the water.

        Args:
            signal: (3,) mean square of the light of the scene.
        """
        information = self.information.clamp(min=LEAST)
        error = (
            self.noise / information.square()
            + (BACKSCATTER_ERROR * self.backscatter / information).square()
            + signal * (ATTENUATION_ERROR * self.optical_depth / information).square()
        )
        return torch.where(self.information > LEAST, error, MOST_ERROR).clamp(max=MOST_ERROR)

    def confidence(self, signal: Tensor) -> Tensor:
        """Compute the confidence in J: the Wiener weight, variance of the scene's J / (that + variance of the error).

        Args:
            signal: (3,) mean square of the light of the scene.

        Returns:
            (N, 3) in 0..1; 0 for Gaussians that no image shows.
        """
        return torch.where(self.information > LEAST, signal / (signal + self.error(signal)).clamp(min=LEAST), 0.0)


@dataclass(frozen=True)
class SceneColors:
    """How the colors of a scene are distributed, in linear light, all float64.

    Attributes:
        signal: (3,) mean square.
        mean: (3,) mean.
        covariance: (3, 3) covariance of red, green and blue.
    """

    signal: Tensor
    mean: Tensor
    covariance: Tensor

    def to_json(self) -> dict[str, list]:
        """Return a plain dict that `from_json` reads."""
        return {entry.name: getattr(self, entry.name).tolist() for entry in fields(self)}

    @classmethod
    def from_json(cls, document: Mapping[str, list]) -> "SceneColors":
        """Read what `to_json` returned."""
        return cls(*(torch.tensor(document[entry.name], dtype=torch.float64) for entry in fields(cls)))


def transmission_and_backscatter(
    offsets: Tensor, medium: Medium, lamp: Lamp | None = None, backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    """Find what is left of the light of Gaussians, and what is added to it.

    Args:
        offsets: (N, 3) from the camera to the Gaussians, scene units.
        medium: The water, in linear light.
        lamp: A lamp at the camera.
        backend: What computes, as in `kernels_for`.

    Returns:
        The fraction (N, 3) of J that arrives, above 1 where a lamp is near, and the light (N, 3) of the water.
    """
    # Light through water is a linear function of J: what 0 and 1 become gives its two coefficients.
    black, white = torch.zeros_like(offsets), torch.ones_like(offsets)
    lighted = white if lamp is None else lit(white, offsets.norm(dim=1), lamp)
    added, whole = (to_light(through_water(color, offsets, medium, backend=backend)) for color in (black, lighted))
    return (whole - added).clamp(min=0), added


@torch.no_grad()
def restoration_limit(
    cloud: GaussianCloud,
    cameras: Iterable[Camera],
    medium: Medium,
    noise: Noise,
    lamp: Lamp | None = None,
    backend: str = "auto",
    colors: SceneColors | None = None,
    haze: Tensor | None = None,
) -> tuple[RestorationLimit, Tensor, SceneColors]:
    """Compute how far the images of a scene allow to restore the colors of Gaussians.

    Args:
        cloud: The Gaussians, without water.
        cameras: Cameras of the images.
        medium: The water, in linear light.
        noise: Noise of the images.
        lamp: A lamp at the camera.
        backend: What computes, as in `kernels_for`.
        colors: How the colors of the scene are distributed. Default: found from the Gaussians.
        haze: (N,) how sure it is that a Gaussian is open water (rendering/haze.py). Default: none is.

    Returns:
        The limit, the fraction (3,) of what the images show of the Gaussians whose red, green and blue have a
        confidence of RESTORED_FROM or more, and how the colors are distributed.
    """
    color = (0.5 + C0 * cloud.sh0[:, 0]).clamp(0, BRIGHTEST_COLOR)
    J = to_light(color)
    sums = LightSums(*(torch.zeros_like(color) for _ in fields(LightSums)))
    for camera in cameras:
        small = camera.resized(min(camera.width, WIDTH))
        pixels = camera.width * camera.height / (small.width * small.height)
        weight = contribution_sums(cloud, small, color.new_full((small.height, small.width, 1), pixels), backend)
        shown = weight[:, 0].nonzero()[:, 0]
        offsets = cloud.means[shown] - torch.from_numpy(camera.centre).to(color)
        transmission, backscatter = transmission_and_backscatter(offsets, medium, lamp, backend)
        light = transmission * J[shown] + backscatter
        sums.add(shown, weight[shown], light, transmission, backscatter, noise.variance(light))
    surface = torch.ones_like(sums.weight[:, 0], dtype=torch.bool) if haze is None else haze.to(J) < HAZE_FROM
    colors = colors or colors_of(J, sums, surface)
    signal = colors.signal.to(J)
    confidence, surfaces = sums.confidence(signal), sums.weight * surface[:, None]
    likely = to_display(likely_light(J, sums.error(signal), colors))
    restored = (surfaces * (confidence >= RESTORED_FROM)).sum(0) / surfaces.sum(0).clamp(min=LEAST)
    limit = RestorationLimit(confidence, torch.where(sums.weight > 0, likely, color))
    return limit, restored, colors


def colors_of(J: Tensor, sums: LightSums, chosen: Tensor) -> SceneColors:
    """Estimate how the colors of chosen Gaussians are distributed.

    Args:
        J: (N, 3) linear light of all Gaussians.
        sums: Their sums.
        chosen: (N,) bool.

    Returns:
        The distribution.
    """
    light, some = J[chosen], sums.rows(chosen)
    signal = some.signal(light)
    return scene_colors(light, some.error(signal), some.weight[:, 0], signal)


def scene_colors(J: Tensor, error: Tensor, weight: Tensor, signal: Tensor) -> SceneColors:
    """Estimate how the colors of a scene are distributed from uncertain values.

    They are taken as normally distributed; mean and covariance are found together with the light by expectation
    maximisation (Dempster, Laird and Rubin 1977).

    Args:
        J: (N, 3) linear light.
        error: (N, 3) variance of its error.
        weight: (N,) pixels that show each.
        signal: (3,) mean square of the light of the scene.

    Returns:
        The distribution; without anything shown, one of mean 0 and of a large variance.
    """
    J, error, weight = J.double(), error.double().clamp(min=LEAST), weight.double()
    shown = torch.nonzero(weight > 0)[:, 0]
    some = shown[:: max(1, len(shown) // PRIOR_GAUSSIANS)]
    if not len(some):
        return SceneColors(signal.double(), J.new_zeros(3), MOST_ERROR * torch.eye(3).to(J))
    values, variances, weights = J[some], error[some], weight[some, None] / weight[some].sum()
    certain = weights / (error[some] + values.square().mean(0))
    certain = certain / certain.sum(0)
    mean = (certain * values).sum(0)
    covariance = torch.diag((certain * (values - mean).square()).sum(0) + LEAST)
    errors = torch.diag_embed(variances)
    for _ in range(PRIOR_STEPS):
        likely = mean + estimated(values - mean, errors, covariance)
        inverse = torch.linalg.inv(covariance + errors)
        uncertainty = covariance - covariance @ inverse @ covariance
        mean = (weights * likely).sum(0)
        apart = likely - mean
        spread = apart[:, :, None] * apart[:, None, :] + uncertainty
        covariance = (weights[..., None] * spread).sum(0) + LEAST * torch.eye(3).to(spread)
    return SceneColors(signal.double(), mean, covariance)


def likely_light(J: Tensor, error: Tensor, colors: SceneColors) -> Tensor:
    """Estimate the light of surfaces from uncertain values and from how the scene's colors are distributed.

    The most likely light given the values is their linear estimate of least mean square error: a channel that is
    uncertain follows the others as it does elsewhere in the scene, and where none is certain it is the scene's mean
    color.

    Args:
        J: (N, 3) linear light.
        error: (N, 3) variance of its error.
        colors: How the colors are distributed.

    Returns:
        (N, 3) linear light, at least 0.
    """
    mean, covariance = colors.mean.to(J.device), colors.covariance.to(J.device)
    above = estimated(J.double() - mean, torch.diag_embed(error.double().clamp(min=LEAST)), covariance)
    return (mean + above).clamp(min=0).to(J.dtype)


def estimated(values: Tensor, error: Tensor, covariance: Tensor) -> Tensor:
    """Estimate what has mean 0 by the linear estimate of least mean square error.

    Args:
        values: (N, 3) uncertain values.
        error: (N, 3, 3) covariance of their error, positive definite.
        covariance: (3, 3) of what is estimated, or (N, 3, 3).

    Returns:
        The estimate (N, 3).
    """
    return (covariance @ torch.linalg.solve(covariance + error, values)[..., None])[..., 0]


def describe_restored(restored: Tensor) -> str:
    """Return a sentence for the user on channels that cannot be restored everywhere; empty if all can.

    Args:
        restored: (3,) fraction of what the images show that can be restored, as `restoration_limit` returns it.
    """
    missing = zip(("red", "green", "blue"), (1 - restored).tolist(), strict=True)
    parts = [f"{name} in {part:.0%}" for name, part in missing if part >= LEAST_TOLD]
    if not parts:
        return ""
    return (
        f"Too far away to be restored: {', '.join(parts)} of what the photos show. The color "
        "that is most likely in this scene takes its place."
    )


@torch.no_grad()
def render_confidence(cloud: GaussianCloud, confidence: Tensor, camera: Camera, backend: str = "auto") -> Tensor:
    """Render the confidence of Gaussians.

    Args:
        cloud: The Gaussians.
        confidence: (N,) in 0..1.
        camera: The camera.
        backend: What renders.

    Returns:
        (H, W) mean confidence of the Gaussians in each pixel, NaN where most of it is background.
    """
    viewmat, K = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
    rendering = rasterize(
        cloud.means, cloud.quats, cloud.scales, cloud.opacities, confidence.to(cloud.means)[:, None], viewmat, K,
        camera.width, camera.height, cloud.means.new_zeros(1), backend,
    )  # fmt: skip
    return torch.where(rendering.alpha > 0.5, rendering.channels[..., 0] / rendering.alpha, torch.nan)
