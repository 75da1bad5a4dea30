"""How the light of a photo depends on that of the place: the terms of water, lamp and photo effects in each pixel."""

from dataclasses import replace

import numpy as np
import torch

from ..effects.scene_effects import SceneEffects
from ..gaussians.cloud import GaussianCloud
from ..kernels.reference.harmonics import C0
from ..scene.cameras import Camera
from ..water.medium import Medium
from .render import background_color, render

LEAST_ALPHA = 0.5
"""Least denominator: below it a pixel does not count as a surface."""


def works_on_light(effects: SceneEffects) -> bool:
    """Whether the water, if there is any, is computed in linear light and not in display values."""
    medium = effects.medium
    return medium is None or (isinstance(medium, Medium) and medium.light == "linear")


@torch.no_grad()
def uniform_image(cloud: GaussianCloud, effects: SceneEffects, camera: Camera, value: float) -> np.ndarray:
    """Render a view as if all Gaussians had one color.

    All effects are a gain and an offset of each pixel's light: the image of 0 is the offset, and that of 1 shows the
    gain. Where more than half of a pixel is covered, it counts as a surface: a photo shows no water behind one.

    Args:
        cloud: The Gaussians, for the range of each pixel.
        effects: Effects to render with.
        camera: Camera of the photo.
        value: Display value of the color.

    Returns:
        Display values (H, W, 3) float64.
    """
    sh0 = torch.full_like(cloud.sh0, (value - 0.5) / C0)
    painted = replace(cloud, sh0=sh0, shN=torch.zeros_like(cloud.shN))
    picture = render(painted, camera, 0, effects.medium, lamp=effects.lamp, with_background=False)
    alpha = picture.alpha[..., None]
    open_too = picture.color + (1 - alpha) * background_color(cloud, camera, effects.medium)
    color = torch.lerp(open_too, picture.color / alpha.clamp(min=LEAST_ALPHA), (2 * alpha - 1).clamp(min=0))
    return effects.apply_to_image(color, camera.name).cpu().numpy().astype(np.float64)
