"""Limit restored colors where noise and errors of the water exceed what is left of their light, and hide open water.

Restoring divides by the transmission of the water, so that far away it multiplies noise and what is wrong with the
water until only these are seen. Gaussians that stand for open water would be a grey haze without water.
docs/method.md, section 1, has the formulas.
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
OPEN_WATER_ERROR = 0.02
"""Relative standard deviation of the light of Gaussians that stand for open water from the background light."""
OPEN_WATER_LOG_RATIO = 5.0
"""Log ratio of the likelihoods of open water and of a surface from which a Gaussian counts as open water."""
HIDDEN_LOGIT = -20.0
"""Opacity logit of Gaussians that are not shown: in 8 bits they are fully transparent."""
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
        open_water: (N,) bool, Gaussians that show nothing but open water; without water they are not shown.
    """

    confidence: Tensor
    color: Tensor
    open_water: Tensor

    @classmethod
    def from_checkpoint(cls, tensors: Mapping[str, Tensor]) -> "RestorationLimit | None":
        """Read the limit from the tensors of a checkpoint; None where it has none."""
        stored = {field.name: tensors.get(STORED + field.name) for field in fields(cls)}
        found = {name: tensor for name, tensor in stored.items() if tensor is not None}
        if "confidence" in found:  # runs before open water was told from surfaces
            found.setdefault("open_water", torch.zeros(len(found["confidence"]), dtype=torch.bool))
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

        What shows nothing but open water is hidden.

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
        opacity_logits = cloud.opacity_logits.masked_fill(self.open_water.to(cloud.means.device), HIDDEN_LOGIT)
        return replace(cloud, sh0=sh0, shN=certain * cloud.shN, opacity_logits=opacity_logits)


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
        background: Of weight * transmission * light of open water.
    """

    weight: Tensor
    light: Tensor
    information: Tensor
    backscatter: Tensor
    optical_depth: Tensor
    noise: Tensor
    background: Tensor

    def add(
        self,
        chosen: Tensor,
        weight: Tensor,
        light: Tensor,
        transmission: Tensor,
        backscatter: Tensor,
        variance: Tensor,
        background: Tensor,
    ) -> None:
        """Add an image.

        Args:
            chosen: (M,) index of the Gaussians that it shows.
            weight: (M, 1) pixels.
            light: (M, 3) light that reaches the camera.
            transmission: (M, 3) fraction of J in it; above 1 where a lamp is near.
            backscatter: (M, 3) the rest of it.
            variance: (M, 3) of a pixel of that light.
            background: (M, 3) light of open water in the direction of each.
        """
        information = weight * transmission.square()
        self.weight[chosen] += weight
        self.light[chosen] += weight * light
        self.information[chosen] += information
        self.backscatter[chosen] += weight * transmission * backscatter
        self.optical_depth[chosen] -= information * transmission.clamp(LEAST, 1.0).log()
        self.noise[chosen] += information * variance
        self.background[chosen] += weight * transmission * background

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
) -> tuple[RestorationLimit, Tensor, SceneColors]:
    """Compute how far the images of a scene allow to restore the colors of Gaussians.

    Args:
        cloud: The Gaussians, without water.
        cameras: Cameras of the images.
        medium: The water, in linear light.
        noise: Noise of the images.
        lamp: A lamp at the camera.
        backend: What computes, as in `kernels_for`.
        colors: How the colors of the scene are distributed; found from the Gaussians without it.

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
        background = medium.background_light(offsets / offsets.norm(dim=1, keepdim=True).clamp(min=LEAST))
        sums.add(shown, weight[shown], light, transmission, backscatter, noise.variance(light), background)
    known, everything = colors, torch.ones_like(sums.weight[:, 0], dtype=torch.bool)
    colors = known or colors_of(J, sums, everything)
    water = open_water_gaussians(J, sums, colors) if medium.background_sh is not None else ~everything
    if water.any():
        colors = known or colors_of(J, sums, ~water)
    signal = colors.signal.to(J)
    confidence, surfaces = sums.confidence(signal), sums.weight * ~water[:, None]
    likely = to_display(likely_light(J, sums.error(signal), colors))
    restored = (surfaces * (confidence >= RESTORED_FROM)).sum(0) / surfaces.sum(0).clamp(min=LEAST)
    limit = RestorationLimit(confidence, torch.where(sums.weight > 0, likely, color), water)
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


def open_water_gaussians(J: Tensor, sums: LightSums, colors: SceneColors) -> Tensor:
    """Find the Gaussians that show nothing but open water.

    What arrives from them is the background light in every image. A surface looks so by chance where the color of its
    restored light is J* = sum(weight * transmission * (background - backscatter)) / information. The likelihood of
    J - J* as an error of open water is compared with that of a surface, whose colors are distributed as the scene's.
    Where no light of a surface arrives, both are the same, and nothing is taken for open water.

    Args:
        J: (N, 3) linear light.
        sums: Sums of the Gaussians.
        colors: How the scene's colors are distributed.

    Returns:
        (N,) bool.
    """
    information = sums.information.double().clamp(min=LEAST)
    as_water = (sums.background - sums.backscatter).double() / information
    depth = sums.optical_depth.double() / information
    noise = sums.noise.double() / information.square()
    error = (noise + (OPEN_WATER_ERROR * sums.background.double() / information).square()).clamp(LEAST, MOST_ERROR)
    mean, covariance = colors.mean.to(error.device), colors.covariance.to(error.device)
    beyond = (ATTENUATION_ERROR * depth * (mean - as_water)).square().clamp(max=MOST_ERROR)
    water = _log_likelihood(J.double() - as_water, torch.diag_embed(error))
    surface = _log_likelihood(J.double() - mean, covariance + torch.diag_embed(error + beyond))
    return (water - surface > OPEN_WATER_LOG_RATIO) & (sums.information > LEAST).all(1)


def _log_likelihood(differences: Tensor, covariances: Tensor) -> Tensor:
    """Return the log of normal densities (N,), up to a constant, of differences (N, 3) from the mean."""
    scaled = torch.linalg.solve(covariances, differences)
    return -0.5 * (torch.logdet(covariances) + (differences * scaled).sum(-1))


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


def describe_open_water(limit: RestorationLimit) -> str:
    """Return a sentence for the user on Gaussians that are hidden without water; empty if none are."""
    count = int(limit.open_water.sum())
    if not count:
        return ""
    return f"Splats not shown without water, because they look like open water in all photos: {count:,}."


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
