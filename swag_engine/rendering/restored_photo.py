"""Photos without water: the colors of the splats with the details that only the photo shows, and splats fitted to them.

A render of the splats has what all photos say about a color, and is blurred. The photo with its water removed is sharp,
and where little light is left, mostly noise. What the photo shows beyond the render is added as far as it is more than
noise; docs/method.md, section 1, has the formulas.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from ..base.transfer import linear_to_srgb, srgb_to_linear
from ..evidence.noise import MAD_TO_SD, Noise
from ..gaussians.contributions import contribution_sums
from ..scene.cameras import Camera
from ..scene.images import TrainingImage
from .haze import without_haze
from .model import SceneModel
from .photo_terms import uniform_image
from .render import Picture, render
from .restoration import WIDTH, RestorationLimit, estimated

WINDOW = 160
"""Width of the image over the standard deviation of the window that the variance of details is measured in."""
MOSTLY_WATER = 3.0
"""Ratio of the light that the water adds to that of surfaces, from which a pixel shows the error of the water."""
FEWEST_PIXELS = 100
"""Pixels of that kind from which the error of the water is measured."""
WATER_DEVIATIONS = 2.0
"""Standard deviations that are taken as the error of the water: in some places it is larger than the median."""
FITTED_STRIDE = 3
"""Colors are fitted to one photo of so many: fitting to all changes delta E by less than .1 (docs/method.md)."""
FEWEST_FITTED = 6
"""Photos that colors are fitted to at least, where there are so many."""
REDUCED_TO = 4.0
"""Standard deviation, pixels, down to which images are reduced for a blur."""
LEAST_GAIN = 1e-4
"""Least fraction of the place's light in that of a pixel."""
ROWS = 64
"""Rows of an image that are computed together, which limits memory."""
LEAST_VARIANCE = 1e-12
"""Added to variances, so that matrices can be inverted."""
LEAST_WEIGHT = 1e-6
"""Least denominator: sum of T alpha, pixels."""


@torch.no_grad()
def restored_photo(
    model: SceneModel,
    limit: RestorationLimit | None,
    image: TrainingImage,
    noise: Noise,
    sh_degree: int,
    haze: Tensor | None = None,
    haze_shown: float = 0.0,
) -> np.ndarray:
    """Remove water, lamp and photo effects from a photo.

    Args:
        model: The Gaussians as trained, and the effects, in linear light.
        limit: Limit of the restored colors; None where colors are not limited.
        image: The photo, which need not be one that was trained on.
        noise: Its noise.
        sh_degree: Degree of the Gaussians' colors.
        haze: (N,) how sure it is that a Gaussian is open water (rendering/haze.py). Default: none is.
        haze_shown: Fraction of the haze that is shown, 0..1.

    Returns:
        Linear light (H, W, 3) of the surfaces, at least 0. Pixels that are not valid, and places where hardly any light
        of a surface arrives, are as rendered.
    """
    limited = limit.apply(model.cloud) if limit else model.cloud
    limited = without_haze(limited, haze, haze_shown)
    seen = render(limited, image.camera, sh_degree, model.effects.medium, amount=0)
    return _corrected(seen, model, image, noise, sh_degree)


def _corrected(seen: Picture, model: SceneModel, image: TrainingImage, noise: Noise, sh_degree: int) -> np.ndarray:
    """Return the light (H, W, 3) of a render without water, with what the photo shows beyond it."""
    camera = image.camera
    without = light_of(seen.color.cpu().numpy())
    covered = (2 * seen.alpha - 1).clamp(0, 1).cpu().numpy() * image.valid  # half a surface may be open water
    surface = covered > 0
    if surface.sum() < 2:  # no color to compare with
        return without.clip(min=0)
    brightness = np.sqrt(np.square(without[surface]).mean(axis=0))
    added, gain = water_terms(model, camera)
    deviation = water_deviation(model, image, added, gain, brightness, sh_degree)
    light, covariance = light_of(image.pixels / np.float32(255)), np.cov(without[surface].T)
    water_error = WATER_DEVIATIONS * deviation * added
    detail = likely_detail(
        light - added - gain * without, gain, light, noise, water_error, covariance, window_of(camera)
    )
    return (without + covered[..., None] * detail).clip(min=0)


def light_of(display: np.ndarray) -> np.ndarray:
    """Return the linear light of display values, float32."""
    return srgb_to_linear(display).astype(np.float32)


def water_terms(model: SceneModel, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the light (H, W, 3) that is added in a photo, and the fraction of a surface's light in it."""
    black, white = (light_of(uniform_image(model.cloud, model.effects, camera, value)) for value in (0.0, 1.0))
    return black, np.maximum(white - black, LEAST_GAIN)


def window_of(camera: Camera) -> float:
    """Return the standard deviation, pixels, of the window that images of a camera are averaged in."""
    return max(1.0, camera.width / WINDOW)


def blurred(values: np.ndarray, deviation: float) -> np.ndarray:
    """Blur an image by a Gaussian; wide ones on a reduced image, where they take less time.

    Args:
        values: (H, W) or (H, W, C).
        deviation: Standard deviation of the Gaussian, pixels.

    Returns:
        The blurred image, of the same shape.
    """
    height, width = values.shape[:2]
    factor = max(1, int(deviation / REDUCED_TO))
    if factor == 1:
        return cv2.GaussianBlur(values, (0, 0), deviation)
    small = cv2.resize(values, (-(-width // factor), -(-height // factor)), interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), deviation / factor), (width, height))


def water_deviation(
    model: SceneModel,
    image: TrainingImage,
    added: np.ndarray,
    gain: np.ndarray,
    brightness: np.ndarray,
    sh_degree: int,
) -> np.ndarray:
    """Measure how much the water of a photo differs from the one that was fitted to all, where it shows hardly more.

    Args:
        model: The Gaussians as trained, and the effects.
        image: The photo. It is compared at WIDTH at most: only what is the same over many pixels counts.
        added: (H, W, 3) light that is added in it.
        gain: (H, W, 3) fraction of a surface's light in it.
        brightness: (3,) usual linear light of surfaces.
        sh_degree: Degree of the Gaussians' colors.

    Returns:
        (3,) float32, standard deviation relative to the light that is added, from the median; 0 without enough pixels.
    """
    image = image.resized(min(image.camera.width, WIDTH))
    camera, effects = image.camera, model.effects
    size = (camera.width, camera.height)
    added, gain = (cv2.resize(terms, size, interpolation=cv2.INTER_AREA) for terms in (added, gain))
    through = render(model.cloud, camera, sh_degree, effects.medium, lamp=effects.lamp).color
    fitted = light_of(effects.apply_to_image(through, camera.name).cpu().numpy())
    apart = np.abs(blurred(light_of(image.pixels / np.float32(255)) - fitted, window_of(camera)))
    far = (added > MOSTLY_WATER * gain * brightness) & image.valid[..., None]
    deviations = np.zeros(3, np.float32)
    for channel in range(3):
        chosen = far[..., channel]
        if chosen.sum() >= FEWEST_PIXELS:
            deviations[channel] = MAD_TO_SD * np.median(apart[chosen, channel] / added[chosen, channel])
    return deviations


def photos_to_fit(photos: Sequence[TrainingImage]) -> Sequence[TrainingImage]:
    """Choose the photos of a run that colors are fitted to, evenly spaced."""
    return photos[:: max(1, min(FITTED_STRIDE, len(photos) // FEWEST_FITTED))]


@torch.no_grad()
def fit_to_photos(
    model: SceneModel,
    limit: RestorationLimit,
    images: Iterable[TrainingImage],
    noise: Noise,
    sh_degree: int,
    haze: Tensor | None = None,
) -> RestorationLimit:
    """Fit limited colors to the restored photos, by one step of simultaneous iterative reconstruction (Gilbert 1972).

    Training compares images through water, where Gaussians in front of one another have different amounts of it. Each
    can then have a color that is wrong without water, while their sum is right through it. A photo is restored with one
    range in each pixel, and shows one surface there.

    Args:
        model: The Gaussians as trained, and the effects, in linear light.
        limit: Limit of the restored colors.
        images: Photos that were trained on, as `photos_to_fit` chooses them.
        noise: Their noise.
        sh_degree: Degree of the Gaussians' colors.
        haze: (N,) how sure it is that a Gaussian is open water (rendering/haze.py). Default: none is.

    Returns:
        The limit with each color changed by the mean difference, in display values, of restored photos and renders over
        the pixels that show it.
    """
    cloud = model.cloud
    limited = without_haze(limit.apply(cloud), haze)
    sums = cloud.means.new_zeros(len(cloud), 4)
    for full in images:
        image = full.resized(min(full.camera.width, WIDTH))
        seen = render(limited, image.camera, sh_degree, model.effects.medium, amount=0)
        restored = torch.from_numpy(linear_to_srgb(_corrected(seen, model, image, noise, sh_degree))).to(seen.color)
        valid = torch.from_numpy(image.valid).to(seen.color)[..., None]
        difference = (restored - seen.color.clamp(min=0)) * valid
        sums += contribution_sums(limited, image.camera, torch.cat([difference, valid], -1))
    return replace(limit, color=limit.color + sums[:, :3] / sums[:, 3:].clamp(min=LEAST_WEIGHT))


def likely_detail(
    difference: np.ndarray,
    gain: np.ndarray,
    light: np.ndarray,
    noise: Noise,
    water_error: np.ndarray,
    covariance: np.ndarray,
    window: float,
) -> np.ndarray:
    """Estimate the light of surfaces beyond a render, from what a photo shows beyond it.

    The linear estimate of least mean square error (Wiener): details are taken as distributed like the colors of the
    scene, times a factor up to 1 that is measured around each pixel.

    Args:
        difference: (H, W, 3) photo - render, linear light.
        gain: (H, W, 3) fraction of a surface's light in that of the photo.
        light: (H, W, 3) of the photo.
        noise: Its noise.
        water_error: (H, W, 3) standard deviation of the light that the water adds.
        covariance: (3, 3) of the scene's linear light.
        window: Standard deviation of the window that the factor is measured in, pixels.

    Returns:
        (H, W, 3) linear light.
    """
    expected = np.square(gain) @ np.diag(covariance) + LEAST_VARIANCE
    variance = noise.variance(torch.from_numpy(light)).numpy() + np.square(water_error)
    factor = np.clip(blurred((np.square(difference) - variance).sum(axis=-1), window) / expected, 0, 1)
    parts = [
        _estimate(difference[rows], gain[rows], light[rows], water_error[rows], factor[rows], noise, covariance)
        for rows in (slice(row, row + ROWS) for row in range(0, len(difference), ROWS))
    ]
    return np.concatenate(parts)


def _estimate(
    difference: np.ndarray,
    gain: np.ndarray,
    light: np.ndarray,
    water_error: np.ndarray,
    factor: np.ndarray,
    noise: Noise,
    covariance: np.ndarray,
) -> np.ndarray:
    """Return the estimate of strips of images, with the covariance times the factor (H, W)."""
    beyond, passed, seen, water, prior = (
        torch.from_numpy(array.astype(np.float64))
        for array in (difference, gain, light, water_error, factor[..., None, None] * covariance)
    )
    error = (noise.covariance(seen) + torch.diag_embed(water.square())) / (passed[..., :, None] * passed[..., None, :])
    return estimated(beyond / passed, error + LEAST_VARIANCE * torch.eye(3), prior).numpy().astype(np.float32)
