"""How near a rendered picture is to its photograph, and to the truth where it is known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..base.transfer import srgb_to_linear
from ..effects.scene_effects import SceneEffects
from ..gaussians.cloud import GaussianCloud
from ..rasterize.api import rasterize
from ..rendering.render import render
from ..scene.cameras import Camera
from ..scene.images import TrainingImage
from .ssim import ssim

FLOATER_GAP = 0.05
"""How far in front of a surface a floater is, in median ranges."""
SHELLS = 160
"""Steps of range, half a FLOATER_GAP each, that `floater_mass` sorts Gaussians into: up to 4 median ranges."""


@dataclass(frozen=True)
class ViewScore:
    """PSNR in dB and SSIM of one view over its valid pixels; mse: mean square error over those `pixels`."""

    name: str
    psnr: float
    ssim: float
    mse: float
    pixels: int


def psnr_of(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean square error of values in 0..1; 100 dB at most."""
    return float(-10 * np.log10(max(mse, 1e-10)))


def score_views(
    cloud: GaussianCloud,
    images: Sequence[TrainingImage],
    sh_degree: int,
    backend: str = "auto",
    simulated: SceneEffects | None = None,
) -> list[ViewScore]:
    """Render every image's view and compare, at the size of the images, in 8 bits as both would be stored."""
    return [score_picture(image, picture(cloud, image.camera, sh_degree, backend, simulated)) for image in images]


@torch.no_grad()
def picture(
    cloud: GaussianCloud,
    camera: Camera,
    sh_degree: int,
    backend: str = "auto",
    simulated: SceneEffects | None = None,
    amount: float = 1.0,
) -> Tensor:
    """What `camera` sees through `amount` (0..1) of all that is simulated: (H, W, 3) on the CPU in 0..1, rounded as in
    8 bits. A photograph that nothing was learned of gets the gain that its neighbours let expect, and even light."""
    simulated = simulated or SceneEffects()
    color = render(
        cloud, camera, sh_degree, simulated.medium, amount=amount, backend=backend, lamp=simulated.lamp
    ).color
    color = simulated.apply_to_image(color, camera.name, amount).cpu()
    return (color.clamp(0, 1) * 255).round() / 255


def comparable(image: TrainingImage, color: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Picture and photograph (H, W, 3) in 0..1, alike where the photograph is not valid, and valid (H, W) bool."""
    target = torch.from_numpy(image.pixels).to(color.dtype) / 255
    valid = torch.from_numpy(image.valid)
    return torch.where(valid[..., None], color, target), target, valid


def score_picture(image: TrainingImage, color: Tensor) -> ViewScore:
    """PSNR and SSIM of one picture (H, W, 3) in 0..1 against its photograph; not a number without valid pixels."""
    compared, target, valid = comparable(image, color)
    if not valid.any():
        return ViewScore(image.camera.name, float("nan"), float("nan"), float("nan"), 0)
    mse = float(((compared - target)[valid] ** 2).mean())
    return ViewScore(image.camera.name, psnr_of(mse), float(ssim(compared, target)), mse, int(valid.sum()))


def median_control(training: Sequence[TrainingImage], test: Sequence[TrainingImage]) -> float:
    """Mean test PSNR in dB of the pixel-wise median of the training images: what knows nothing of geometry reaches.

    Not a number where there are no test images, or no training image of the size of the first.
    """
    if not test:
        return float("nan")
    shape = test[0].pixels.shape
    same = [image.pixels for image in training if image.pixels.shape == shape]
    if not same:
        return float("nan")
    median = torch.from_numpy(np.median(np.stack(same), axis=0).astype(np.float32) / 255)
    matching = [image for image in test if image.pixels.shape == shape]
    return mean_score([score_picture(image, median) for image in matching])[0]


def mean_score(scores: Sequence[ViewScore]) -> tuple[float, float]:
    """Mean PSNR and mean SSIM over views; not a number without any."""
    return mean([score.psnr for score in scores]), mean([score.ssim for score in scores])


def mean(values: Sequence[float]) -> float:
    """Mean of those values that are numbers; not a number without any."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def joint_psnr(scores: Sequence[ViewScore]) -> float:
    """PSNR in dB of the mean square error over the valid pixels of all views together.

    Never above the mean of the views' PSNR when they have equally many pixels: a view that fails weighs more.
    """
    seen = [score for score in scores if score.pixels]
    if not seen:
        return float("nan")
    return psnr_of(float(np.average([score.mse for score in seen], weights=[score.pixels for score in seen])))


@torch.no_grad()
def floater_mass(cloud: GaussianCloud, cameras: Sequence[Camera], median_range: float, backend: str = "auto") -> float:
    """The share, 0..1, of all that is drawn in these views which hangs in front of what is seen there.

    A Gaussian adds T alpha to a pixel (T the transmittance before it). Let W(r) be what the Gaussians nearer than r to
    the camera add to the pixel, r the Euclidean distance of their centres. The pixel's surface is where W reaches .5;
    its floaters add W(surface - FLOATER_GAP median_range), nothing where W stays below .5. The result is the floaters'
    sum over all pixels and views over the sum of all T alpha; not a number when nothing is drawn.

    The threshold differs from pixel to pixel, and a render has one value a Gaussian; so W is rendered itself, one
    channel for each of SHELLS ranges with 1 for the Gaussians nearer than it, and taken as linear between two. That
    is within 3 % of the sum over single Gaussians (demo scene). Surfaces farther than 4 median ranges count as there.
    """
    step = FLOATER_GAP / 2
    edges = (torch.arange(1, SHELLS + 1) * step * median_range).to(cloud.means)
    edges[-1] = torch.inf
    front = total = 0.0
    for camera in cameras:
        centre, viewmat, intrinsics = (
            torch.from_numpy(array).to(cloud.means) for array in (camera.centre, camera.world_to_camera, camera.K)
        )
        ranges = (cloud.means - centre).norm(dim=-1, keepdim=True)
        within = [cloud.means.new_zeros(camera.height, camera.width)] * 4  # W at the last edges: the gap is two steps
        for some in edges.split(16):
            drawn = rasterize(
                cloud.means, cloud.quats, cloud.scales, cloud.opacities, (ranges < some).to(cloud.means), viewmat,
                intrinsics, camera.width, camera.height, torch.zeros_like(some), backend,
            )  # fmt: skip
            for nearer in drawn.channels.unbind(-1):
                within = [*within[1:], nearer]
                surface = (within[2] < 0.5) & (nearer >= 0.5)
                between = (0.5 - within[2]) / (nearer - within[2])
                front += float(torch.lerp(within[0], within[1], between)[surface].sum())
        total += float(within[-1].sum())
    return front / total if total else float("nan")


def restored_error(restored: np.ndarray, clean: np.ndarray, valid: np.ndarray) -> tuple[float, float]:
    """PSNR in dB and mean CIE delta E 2000 of a picture without water against the truth.

    restored and clean (H, W, 3) sRGB in 0..1, valid (H, W) bool. Not numbers without valid pixels.
    """
    if not valid.any():
        return float("nan"), float("nan")
    ours, true = restored[valid].astype(np.float64), clean[valid].astype(np.float64)
    return psnr_of(float(((ours - true) ** 2).mean())), float(delta_e_2000(lab(ours), lab(true)).mean())


def lab(srgb: np.ndarray) -> np.ndarray:
    """CIE L*a*b* (..., 3), white D65, of sRGB (..., 3) in 0..1 (IEC 61966-2-1)."""
    linear = srgb_to_linear(srgb)
    xyz = linear @ np.array(
        [[0.4124564, 0.2126729, 0.0193339], [0.3575761, 0.7151522, 0.1191920], [0.1804375, 0.0721750, 0.9503041]]
    )
    t = xyz / (0.95047, 1.0, 1.08883)
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def delta_e_2000(lab1: np.ndarray, lab2: np.ndarray) -> np.ndarray:
    """CIEDE2000 colour difference (...) of L*a*b* colours (..., 3): Sharma, Wu, Dalal 2005, with k_L = k_C = k_H = 1.

    A difference of 1 is about the least that an eye sees.
    """
    (l1, a1, b1), (l2, a2, b2) = np.moveaxis(lab1, -1, 0), np.moveaxis(lab2, -1, 0)

    def saturation(chroma: np.ndarray) -> np.ndarray:
        return np.sqrt(chroma**7 / (chroma**7 + 25.0**7))

    g = 0.5 * (1 - saturation((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2))
    a1, a2 = (1 + g) * a1, (1 + g) * a2
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = np.degrees(np.arctan2(b1, a1)) % 360, np.degrees(np.arctan2(b2, a2)) % 360

    apart = np.where(c1 * c2 == 0, 0, h2 - h1)  # a grey has no hue
    wraps = np.abs(apart) > 180 + 1e-9  # opposite hues, up to rounding, do not
    turn = apart - np.where(wraps, 360 * np.sign(apart), 0)
    mean_hue = np.where(c1 * c2 == 0, h1 + h2, (h1 + h2) / 2 + np.where(wraps, 180, 0))
    mean_l, mean_c = (l1 + l2) / 2, (c1 + c2) / 2
    dl, dc, dh = l2 - l1, c2 - c1, 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2))

    hue = np.radians(mean_hue)
    t = (
        1
        - 0.17 * np.cos(hue - np.radians(30))
        + 0.24 * np.cos(2 * hue)
        + 0.32 * np.cos(3 * hue + np.radians(6))
        - 0.20 * np.cos(4 * hue - np.radians(63))
    )
    squared = (mean_l - 50) ** 2
    dl /= 1 + 0.015 * squared / np.sqrt(20 + squared)
    dc /= 1 + 0.045 * mean_c
    dh /= 1 + 0.015 * mean_c * t
    twist = np.exp(-(((np.degrees(hue) % 360 - 275) / 25) ** 2))
    rotation = -2 * saturation(mean_c) * np.sin(np.radians(60 * twist))
    return np.sqrt(dl**2 + dc**2 + dh**2 + rotation * dc * dh)
