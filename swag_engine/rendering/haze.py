"""Find Gaussians that are open water and no surface, from the photos (docs/method.md, section 1)."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from ..effects.lamp import Lamp, lit
from ..evidence.image_cells import LEAST_CELLS_OF_WATER, open_water_cells
from ..gaussians.cloud import GaussianCloud
from ..gaussians.contributions import contribution_sums
from ..kernels.reference.harmonics import C0
from ..scene.colmap import Scene
from ..scene.images import TrainingImage
from ..splats.haze import MOST_HAZE, haze_gain, opacity_without_haze
from ..water.medium import Medium, through_water
from ..water.network import WaterNetwork
from .model import SceneModel
from .render import background_color

WIDTH = 320
"""Largest width at which photos are compared with open water, pixels: open water has no details."""
BLUR = 1.0
"""Standard deviation of the blur of photos before they are compared, pixels: single pixels are noise."""
LEAST_TOLERANCE = 0.012
"""Least difference of a channel from open water that tells a surface, display values: 3 of 255."""
MOST_TOLERANCE = 0.06
"""Such a difference above which the pixels are not open water: that is .012 to .045 in generated scenes and in
japanese_gardens, and .08 and .11 in flat parts of the ground of aqualoc_amphorae and sparus_seabed."""
DEVIATIONS = 3.0
"""The difference over the median difference of pixels of open water."""
MOST_BIAS = 0.1
"""Largest difference of pixels of open water from the learned background light, display values: others are surfaces."""
NEAR_POINT = 1 / 40
"""Radius around a sparse point within which a photo shows a surface, image widths."""
UNLIKE = (0.3, 0.7)
"""Fraction of what photos show of a Gaussian that differs from open water: water up to the first, else a surface."""
NEAR_POINTS = (0.2, 0.5)
"""Fraction near sparse points: water up to the first, else a surface."""
TOLD = (0.8, 0.95)
"""Fraction of the scene's colors that differ from open water at the range of a Gaussian. Up to the first, a surface
there looks like open water, and none is taken for it."""
COLORS, RANGES = 256, 32
"""Colors of the scene, and ranges, at which that fraction is computed."""
SURE_SURFACE = 0.9
"""Fraction that differs from open water from which a Gaussian gives a color of the scene."""
MOST_OPACITY = 1 - 1e-6
"""Largest opacity: its logit is finite."""
LEAST = 1e-9
"""Least denominator: sum of T alpha, pixels."""


def without_haze(cloud: GaussianCloud, score: Tensor | None, amount: float = 0.0) -> GaussianCloud:
    """Return the Gaussians with a fraction of their haze.

    Args:
        cloud: The Gaussians as trained.
        score: (N,) as `haze_score` returns it; None for none.
        amount: Fraction of the haze that is shown, 0..1; with 1 the cloud itself is returned.
    """
    if score is None or amount == 1:
        return cloud
    return with_haze(_scaled(cloud, score, opacity_without_haze(score)), score, amount)


def with_haze(cloud: GaussianCloud, score: Tensor | None, amount: float) -> GaussianCloud:
    """Show haze in Gaussians without haze.

    Args:
        cloud: The Gaussians as `without_haze` returns them, and as files hold them.
        score: (N,) as `haze_score` returns it; None for none.
        amount: Fraction of the haze that is shown, 0..1.
    """
    return cloud if score is None or amount == 0 else _scaled(cloud, score, haze_gain(score, amount))


def _scaled(cloud: GaussianCloud, score: Tensor, factor: Tensor) -> GaussianCloud:
    """Return the Gaussians with opacities times a factor (N,) where the score (N,) is above 0."""
    opacities = (cloud.opacities * factor.to(cloud.means)).clamp(max=MOST_OPACITY)
    scaled = torch.where(score.to(cloud.means) > 0, torch.logit(opacities), cloud.opacity_logits)
    return replace(cloud, opacity_logits=scaled)


@torch.no_grad()
def haze_score(model: SceneModel, images: Sequence[TrainingImage], scene: Scene, backend: str = "auto") -> Tensor:
    """Find how sure it is that Gaussians are open water and no surface.

    A Gaussian is open water where the photos that show it have the color of open water, no sparse point is seen there,
    and nearly every color of the scene would look different at its range.

    Args:
        model: The N Gaussians as trained, and the effects.
        images: The photos that were trained on.
        scene: The scene with its sparse points.
        backend: What computes, as in `kernels_for`.

    Returns:
        (N,) in 0..MOST_HAZE; all 0 where the photos show no open water, and for water that is a network.
    """
    cloud, medium = model.cloud, model.effects.medium
    none = cloud.means.new_zeros(len(cloud))
    small = [image.resized(min(image.camera.width, WIDTH)) for image in images]
    cells = open_water_cells(small, scene)
    if cells.mean() < LEAST_CELLS_OF_WATER or isinstance(medium, WaterNetwork):
        return none
    behind = [_open_water_of(model, image, backend) for image in small]
    apart = [
        _blurred(image.pixels / np.float32(255)) - open_water for image, open_water in zip(small, behind, strict=True)
    ]
    found = _bias_and_tolerance(apart, cells)
    if found is None:
        return none
    bias, tolerance = found
    indices = {view.name: view.point_indices for view in scene.views}
    sums, farness = cloud.means.new_zeros(len(cloud), 3), none.clone()
    for image, difference in zip(small, apart, strict=True):
        valid = image.valid.astype(np.float32)
        unlike = valid * (np.abs(difference - bias).max(axis=-1) > tolerance)
        near = valid * _near_points(image, scene.points.positions[indices[image.camera.name]])
        weights = torch.from_numpy(np.stack([valid, unlike, near], axis=-1).astype(np.float32)).to(cloud.means)
        added = contribution_sums(cloud, image.camera, weights, backend)
        sums += added
        centre = torch.from_numpy(image.camera.centre).to(cloud.means)
        farness += added[:, 0] * (cloud.means - centre).norm(dim=1)
    weight = sums[:, 0].clamp(min=LEAST)
    unlike, near, ranges = sums[:, 1] / weight, sums[:, 2] / weight, farness / weight
    shown = sums[:, 0] > LEAST
    open_water = torch.from_numpy(np.mean([color.mean(axis=(0, 1)) for color in behind], axis=0)).to(cloud.means)
    sure = shown & (unlike > SURE_SURFACE)
    told = _told_colors(cloud.sh0[sure, 0], ranges, medium, model.effects.lamp, open_water, tolerance)
    score = (1 - _ramp(unlike, UNLIKE)) * (1 - _ramp(near, NEAR_POINTS)) * _ramp(told, TOLD)
    return torch.where(shown, MOST_HAZE * score, 0.0)


def describe_haze(score: Tensor) -> str:
    """Return a sentence for the user on Gaussians that are hidden without water; empty if none are."""
    count = int((score > 0.5).sum())
    if not count:
        return ""
    return f"Splats not shown without water, because they look like open water in the photos: {count:,}."


def _open_water_of(model: SceneModel, image: TrainingImage, backend: str) -> np.ndarray:
    """Return the display color (H, W, 3) of open water in a photo."""
    camera = image.camera
    behind = background_color(model.cloud, camera, model.effects.medium, backend=backend)
    behind = behind.expand(camera.height, camera.width, 3)
    return model.effects.apply_to_image(behind, camera.name).float().cpu().numpy()


def _blurred(pixels: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(pixels, (0, 0), BLUR)


def _bias_and_tolerance(apart: Sequence[np.ndarray], cells: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Measure how pixels of open water differ from the learned background light.

    Training determines that light only where no Gaussian is in front of it.

    Args:
        apart: Differences (H, W, 3) of V photos from that light, display values.
        cells: (V, CELLS, CELLS) bool, cells of open water.

    Returns:
        The median difference (3,), and the difference from it that tells a surface; None where the cells do not look
        like the background light, or differ more than open water does.
    """
    chosen = []
    for difference, water in zip(apart, cells, strict=True):
        size = difference.shape[1::-1]
        mask = cv2.resize(water.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        chosen.append(difference[mask & (np.abs(difference).max(axis=-1) < MOST_BIAS)])
    pixels = np.concatenate(chosen)
    if len(pixels) < LEAST_CELLS_OF_WATER * sum(difference[..., 0].size for difference in apart):
        return None
    bias = np.median(pixels, axis=0)
    usual = float(np.median(np.abs(pixels - bias).max(axis=-1)))
    tolerance = max(DEVIATIONS * usual, LEAST_TOLERANCE)
    return None if tolerance > MOST_TOLERANCE else (bias, tolerance)


def _near_points(image: TrainingImage, points: np.ndarray) -> np.ndarray:
    """Find the pixels near sparse points (M, 3) that the photo observes, (H, W) uint8."""
    camera = image.camera
    places = (points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]) @ camera.K.T
    places = np.floor(places[places[:, 2] > 0, :2] / places[places[:, 2] > 0, 2:]).astype(int)
    inside = ((places >= 0) & (places < (camera.width, camera.height))).all(axis=1)
    near = np.zeros((camera.height, camera.width), np.uint8)
    near[places[inside, 1], places[inside, 0]] = 1
    radius = max(1, round(NEAR_POINT * camera.width))
    return cv2.dilate(near, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)))


def _told_colors(
    sh0: Tensor, ranges: Tensor, medium: Medium | None, lamp: Lamp | None, open_water: Tensor, tolerance: float
) -> Tensor:
    """Return the fraction (N,) of the scene's colors that differ from open water at ranges.

    Args:
        sh0: (M, 3) harmonics of degree 0 of surfaces.
        ranges: (N,) scene units.
        medium: The water.
        lamp: A lamp at the camera.
        open_water: (3,) display color of open water.
        tolerance: Difference of a channel from which a color differs.
    """
    if not len(sh0):
        return torch.zeros_like(ranges)
    colors = (0.5 + C0 * sh0[:: max(1, len(sh0) // COLORS)]).clamp(0, 1)
    steps = torch.linspace(float(ranges.min()), float(ranges.max()), RANGES).to(ranges)
    told = []
    for step in steps:
        seen, offsets = colors, torch.zeros_like(colors)
        offsets[:, 2] = step
        if lamp is not None:
            seen = lit(seen, offsets[:, 2], lamp)
        if medium is not None:
            seen = through_water(seen, offsets, medium)
        told.append(((seen - open_water).abs().amax(-1) > tolerance).float().mean())
    nearest = torch.bucketize(ranges, (steps[1:] + steps[:-1]) / 2)
    return torch.stack(told)[nearest]


def _ramp(values: Tensor, ends: tuple[float, float]) -> Tensor:
    """Rise from 0 to 1 between two values."""
    return ((values - ends[0]) / (ends[1] - ends[0])).clamp(0, 1)
