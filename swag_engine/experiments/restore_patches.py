"""Remove what a run has fitted of water, lamp and photo effects from the patches of a chart in a photo.

All these effects are a gain and an offset of each pixel's light. They are read from two renders of the run, with black
and with white Gaussians in the places of the fitted ones. Over a flat chart both change evenly, so that a plane through
those of the patches that are seen bridges the holes that few iterations leave in the splats.
"""

import numpy as np

from ..base.transfer import linear_to_srgb, srgb_to_linear
from ..colorchart.find_chart import ChartObservation, measure
from ..effects.scene_effects import SceneEffects
from ..gaussians.cloud import GaussianCloud
from ..rendering.photo_terms import uniform_image, works_on_light
from ..scene.cameras import Camera

LEAST_GAIN = 1e-3
"""Gain below which a patch's own light is lost."""


def restored_patches(
    cloud: GaussianCloud, effects: SceneEffects, camera: Camera, observation: ChartObservation
) -> np.ndarray:
    """Restore the patches of a chart in a photo of a run.

    Args:
        cloud: The run's Gaussians, for the range of each pixel.
        effects: The run's effects.
        camera: Camera of the photo.
        observation: The chart in the photo.

    Returns:
        Linear light (N, 3) without water, lamp and photo effects; negative where the run has more backscatter than the
        photo has light.
    """
    on_light = works_on_light(effects)
    black, white = (uniform_image(cloud, effects, camera, value) for value in (0.0, 1.0))
    if on_light:
        black, white = srgb_to_linear(black), srgb_to_linear(white)
    seen = observation.light if on_light else linear_to_srgb(observation.light)
    offset = measure(black, observation)
    gain = np.maximum(measure(white, observation) - offset, LEAST_GAIN)
    places, used = observation.centres, observation.used
    restored = (seen - even_values(places, offset, used)) / np.exp(even_values(places, np.log(gain), used))
    return restored if on_light else srgb_to_linear(restored)


def even_values(places: np.ndarray, values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the values (N, C) at places (N, 2) of the planes of least absolute misfit to the used (N,) values."""
    design = np.column_stack([np.ones(len(places)), (places - places.mean(0)) / places.std()])
    design_used, values = (design[used], values[used]) if used.sum() > design.shape[1] else (design, values)
    weights = np.ones_like(values)
    planes = np.zeros((design.shape[1], values.shape[1]))
    for _ in range(30):
        normal = np.einsum("ni,nc,nj->cij", design_used, weights, design_used)
        right = np.einsum("ni,nc,nc->ci", design_used, weights, values)
        planes = np.linalg.solve(normal, right[..., None])[..., 0].T
        weights = 1 / np.maximum(np.abs(values - design_used @ planes), 1e-5)
    return design @ planes
