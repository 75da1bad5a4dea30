"""What a run asks of its scene before it begins: the water, depth priors, frames between photographs.

Each answer comes with a sentence for the user. What cannot be had is left out and said, never an error.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..base.errors import InputError
from ..evidence.observations import FIT_WIDTH, observe
from ..gaussians.cloud import GaussianCloud
from ..gaussians.sh import C0
from ..planning.plan import Plan
from ..priors.depth import InverseDepth, StoredDepth, depth_priors
from ..priors.interpolate import Interpolator, admission, interpolated_pose, neighbour_pairs
from ..scene.colmap import Scene
from ..scene.images import TrainingImage, load_images
from ..settings.jerlov import water_of_type
from ..settings.recipes import Recipe
from ..settings.settings import TrainSettings
from ..water.light import to_display
from ..water.medium import Medium, without_water
from ..water.network import WaterNetwork
from ..weights.registry import find

DEPTH_NETWORK, FRAME_NETWORK = "depth-anything-v2-small", "rife"


def at_least_wide(scene: Scene, known: Sequence[TrainingImage], width: int) -> Sequence[TrainingImage]:
    """The photographs at `width` pixels, or as they are where they are wider or the files are smaller."""
    if max(image.camera.width for image in known) >= width:
        return known
    views = {view.camera.name: view for view in scene.views}
    return load_images(scene, [views[image.camera.name] for image in known], width)


def find_water(
    scene: Scene,
    known: Sequence[TrainingImage],
    recipe: Recipe,
    plan: Plan | None,
    settings: TrainSettings,
    median_range: float,
) -> tuple[str, Medium | WaterNetwork | None, tuple[int, int, int] | None]:
    """A sentence, the medium that training starts from (None: no water is modelled), and the channels by attenuation,
    largest first (None where that is not known).

    It starts from a water type where the user names one, else from what the plan fitted, else from a usual water.
    Raises InputError for a water type that is none, or one per metre where the scene has no scale.
    """
    if not recipe.attenuation:
        return (f"No water is modelled: {plan.effects['attenuation'].reason}" if plan else ""), None, None
    if recipe.medium == "network":
        return "Water is modelled by a network.", WaterNetwork.starting(median_range, settings.seed), None
    why, order, fitted = "as the method always does.", None, plan.water if plan else None
    if settings.water_type != "auto":
        betas = water_of_type(settings.water_type, settings.metres_per_unit)
        beta_D, beta_B = (torch.from_numpy(beta).float() for beta in betas)
        why, order = f"from the type {settings.water_type}.", _order(betas[0])
        medium = Medium.starting(median_range, recipe.light, beta_D, beta_B, dark_and_far(scene, known, recipe))
    elif fitted:
        assert plan
        beta_D, beta_B, B = (torch.tensor(fitted[name]) for name in ("beta_D", "beta_B", "B_inf"))
        why, order = plan.effects["attenuation"].reason, _order(beta_D.numpy())
        medium = Medium.starting(median_range, recipe.light, beta_D, beta_B, B)
    else:
        why = plan.effects["attenuation"].reason if plan else why
        medium = Medium.starting(median_range, recipe.light, B=dark_and_far(scene, known, recipe))
    if not recipe.separate_backscatter:
        medium.backscatter = None
    if not recipe.backscatter:
        medium.backscatter = medium.veil = None
    return f"Water is modelled: {why}", medium, order


def median_range(scene: Scene, images: Sequence[TrainingImage]) -> float:
    """r_bar: median Euclidean distance between the training cameras and the sparse points in front of them."""
    ranges = []
    for image in images:
        in_camera = (
            scene.points.positions @ image.camera.world_to_camera[:3, :3].T + image.camera.world_to_camera[:3, 3]
        )
        ranges.append(np.linalg.norm(in_camera[in_camera[:, 2] > 0], axis=1))
    together = np.concatenate(ranges)
    return float(np.median(together)) if len(together) else 1.0


def _order(attenuation: np.ndarray) -> tuple[int, int, int]:
    first, second, third = np.argsort(-attenuation).tolist()
    return first, second, third


def dark_and_far(scene: Scene, known: Sequence[TrainingImage], recipe: Recipe) -> Tensor | None:
    """A first B (3,) in the recipe's light: the median of the darkest hundredth of the farthest fifth of sightings."""
    views = {view.camera.name: view for view in scene.views}
    seen = at_least_wide(scene, known, FIT_WIDTH)
    observations = observe(seen, [views[image.camera.name].point_indices for image in seen], scene.points)
    if not len(observations.track):
        return None
    far = observations.light[observations.ranges >= np.quantile(observations.ranges, 0.8)]
    brightness = far.mean(axis=1)
    veil = torch.from_numpy(np.median(far[brightness <= np.quantile(brightness, 0.01)], axis=0)).float()
    return veil if recipe.light == "linear" else to_display(veil)


def take_water_away(cloud: GaussianCloud, medium: Medium, images: Sequence[TrainingImage]) -> None:
    """Let the colours, which are those of the points as photographed, begin as they are without the water."""
    centres = torch.from_numpy(np.stack([image.camera.centre for image in images])).to(cloud.means)
    ranges = torch.cdist(cloud.means, centres).median(dim=1).values
    cloud.sh0[:, 0] = (without_water(0.5 + C0 * cloud.sh0[:, 0], ranges, medium) - 0.5) / C0


def find_depth(
    scene: Scene, training: Sequence[TrainingImage], weights_dir: Path | None
) -> tuple[str, dict[str, np.ndarray]]:
    """A sentence, and by name the inverse range (H, W) float32 per scene unit that a network sees in a photograph.

    A scene may bring its own: depth/NAME.png (16 bits) or depth/NAME.npy, inverse depth up to scale and shift.
    """
    try:
        if (scene.folder / "depth").is_dir():
            priors, alignments = depth_priors(StoredDepth(scene), training, scene)
        else:
            network = InverseDepth(find(DEPTH_NETWORK, weights_dir))
            priors, alignments = depth_priors(lambda image: network(image.pixels), training, scene)
    except InputError as error:
        return f"No depth prior: {error}", {}
    refused = sorted({alignment.reason for alignment in alignments.values() if not alignment.accepted})
    why = f" {refused[0]}" if refused else ""
    return f"Depth prior on {len(priors)} of {len(training)} photographs.{why}", priors


def find_frames(
    scene: Scene, training: Sequence[TrainingImage], weights_dir: Path | None
) -> tuple[str, list[TrainingImage]]:
    """A sentence, and frames made in the middle between neighbouring training photographs."""
    images = {image.camera.name: image for image in training}
    pairs = neighbour_pairs([view.camera.name for view in scene.views], images)
    try:
        interpolator = Interpolator(find(FRAME_NETWORK, weights_dir))
        judged = admission(interpolator, images, pairs)
        if not judged.admitted:
            return f"No interpolated frames: {judged.reason}", []
        frames = []
        for first, second in ((images[a], images[b]) for a, b in pairs):
            if first.pixels.shape != second.pixels.shape:
                continue
            camera = interpolated_pose(first.camera, second.camera, 0.5)
            pixels = interpolator(first.pixels, second.pixels, 0.5)
            frames.append(TrainingImage(camera, pixels, first.valid & second.valid))
    except InputError as error:
        return f"No interpolated frames: {error}", []
    return f"{len(frames)} interpolated frames ({judged.psnr:.1f} dB where a photograph was left out).", frames
