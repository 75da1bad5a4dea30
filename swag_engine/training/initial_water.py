"""The water that training starts from, and the colors of the Gaussians without it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..evidence.observations import FIT_WIDTH, observe
from ..gaussians.cloud import GaussianCloud
from ..kernels.reference.harmonics import C0
from ..kernels.reference.transfer import to_display
from ..planning.plan import Plan
from ..scene.colmap import Scene
from ..scene.images import TrainingImage, load_images
from ..settings.jerlov import water_of_type
from ..settings.recipes import Recipe
from ..water.medium import Medium, without_water
from ..water.network import WaterNetwork
from .inputs import RunInputs

FAR_QUANTILE = 0.8
"""Observations beyond this quantile of range show the background light best."""
DARK_QUANTILE = 0.01
"""Of those, the darkest part has the least light of its own."""


@dataclass(frozen=True)
class InitialWater:
    """Water at the start of a run.

    Attributes:
        note: A sentence for the user.
        medium: Its parameters; None where no water is modelled.
        order: Channels by attenuation, largest first; None where that is not known.
    """

    note: str = ""
    medium: Medium | WaterNetwork | None = None
    order: tuple[int, int, int] | None = None


def initial_water(inputs: RunInputs, recipe: Recipe, plan: Plan | None) -> InitialWater:
    """Choose the water that training starts from.

    It starts from a water type where the user names one, else from what the plan fitted, else from a usual water.

    Args:
        inputs: Images and settings of the run.
        recipe: What the run computes.
        plan: The scene's plan, if the recipe takes one.

    Returns:
        The water.

    Raises:
        InputError: For an unknown water type, or one per metre where the scene has no scale.
    """
    settings = inputs.settings
    if "attenuation" not in recipe.effects:
        return InitialWater(f"No water is modelled: {plan.effects['attenuation'].reason}" if plan else "")
    if recipe.medium == "network":
        network = WaterNetwork.starting(inputs.median_range, settings.seed)
        return InitialWater("Water is modelled by a network.", network)
    why, order, fitted = "the method always does.", None, plan.water if plan else None
    if settings.water_type != "auto":
        betas = water_of_type(settings.water_type, settings.metres_per_unit)
        beta_D, beta_B = (torch.from_numpy(beta).float() for beta in betas)
        why, order = f"starting from the type {settings.water_type}.", _order(betas[0])
        B_inf = dark_and_far_light(inputs, recipe)
        medium = Medium.starting(inputs.median_range, recipe.light, beta_D, beta_B, B_inf)
    elif fitted:
        assert plan
        beta_D, beta_B, B = (torch.tensor(fitted[name]) for name in ("beta_D", "beta_B", "B_inf"))
        why, order = plan.effects["attenuation"].reason, _order(beta_D.numpy())
        medium = Medium.starting(inputs.median_range, recipe.light, beta_D, beta_B, B)
    else:
        why = plan.effects["attenuation"].reason if plan else why
        medium = Medium.starting(inputs.median_range, recipe.light, B=dark_and_far_light(inputs, recipe))
    if "separate_backscatter" not in recipe.effects:
        medium.backscatter = None
    if "backscatter" not in recipe.effects:
        medium.backscatter = medium.background_sh = None
    return InitialWater(f"Water is modelled: {why}", medium, order)


def dark_and_far_light(inputs: RunInputs, recipe: Recipe) -> Tensor | None:
    """Estimate the background light from the darkest of the farthest observations of sparse points.

    Args:
        inputs: Images and settings of the run.
        recipe: Says whether the water works on linear light or on display values.

    Returns:
        Background light (3,) in the recipe's light, None without observations.
    """
    scene = inputs.scene
    views = {view.camera.name: view for view in scene.views}
    seen = at_least_wide(scene, inputs.known, FIT_WIDTH)
    observations = observe(seen, [views[image.camera.name].point_indices for image in seen], scene.points)
    if not len(observations.track):
        return None
    far = observations.light[observations.ranges >= np.quantile(observations.ranges, FAR_QUANTILE)]
    brightness = far.mean(axis=1)
    dark = far[brightness <= np.quantile(brightness, DARK_QUANTILE)]
    background_light = torch.from_numpy(np.median(dark, axis=0)).float()
    return background_light if recipe.light == "linear" else to_display(background_light)


def remove_water_from_colors(cloud: GaussianCloud, medium: Medium, images: Sequence[TrainingImage]) -> None:
    """Replace the colors of a cloud, which are those of the points as photographed, by the colors without water."""
    centres = torch.from_numpy(np.stack([image.camera.centre for image in images])).to(cloud.means)
    ranges = torch.cdist(cloud.means, centres).median(dim=1).values
    cloud.sh0[:, 0] = (without_water(0.5 + C0 * cloud.sh0[:, 0], ranges, medium) - 0.5) / C0


def at_least_wide(scene: Scene, known: Sequence[TrainingImage], width: int) -> Sequence[TrainingImage]:
    """Load images again at `width` pixels where they are narrower and their files are wider."""
    if max(image.camera.width for image in known) >= width:
        return known
    views = {view.camera.name: view for view in scene.views}
    return load_images(scene, [views[image.camera.name] for image in known], width)


def _order(attenuation: np.ndarray) -> tuple[int, int, int]:
    first, second, third = np.argsort(-attenuation).tolist()
    return first, second, third
