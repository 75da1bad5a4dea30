"""PSNR of a run on its test images before and after splats are removed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..base.errors import InputError, continue_run
from ..evaluation.metrics import mean_score, render_image, score_image
from ..formats.run_folder import RunFolder
from ..gaussians.cloud import GaussianCloud
from ..scene.colmap import load_scene
from ..scene.images import load_images
from ..scene.split import split_views
from .evaluate_run import load_run


def score_edit(
    folder: Path, masks: Path, progress: Callable[[str, float], None] = lambda stage, fraction: None
) -> dict[str, Any]:
    """Compare the newest checkpoint of a run with its test images, with and without some Gaussians.

    Args:
        folder: Folder of the run.
        masks: File (.npy) of (2, N) bool in the order of result.ply: the Gaussians before and after the edit.
        progress: Gets the stage and its fraction (0..1).

    Returns:
        `before` and `after`, mean test PSNR in dB, and `views`, the number of test images.

    Raises:
        InputError: Where there is no run or no test image, a file cannot be read, or the masks are of other Gaussians.
    """
    scene_folder, settings, _ = RunFolder(folder).read_config()
    run = load_run(folder)
    cloud, effects = run.through(1), run.effects
    try:
        kept = np.load(masks)
    except (OSError, ValueError) as error:
        raise InputError(f"{masks} cannot be read as a mask of splats: {error}.") from error
    if kept.shape != (2, len(cloud)) or kept.dtype != bool:
        raise InputError(
            f"The run's checkpoint has {len(cloud)} splats and its result another number: {continue_run()}, "
            "which writes the result again."
        )
    scene = load_scene(scene_folder)
    names = set(split_views([view.name for view in scene.views]).test)
    images = load_images(scene, [view for view in scene.views if view.name in names], settings.width)
    images = [image for image in images if image.valid.any()]
    if not images:
        raise InputError(f"{scene_folder} has too few photos for held-out ones: the PSNR cannot be compared.")
    scores: list[list[Any]] = [[], []]
    parts = [_subset(cloud, torch.from_numpy(mask).to(cloud.means.device)) for mask in kept]
    for done, image in enumerate(images):
        progress("Render", done / len(images))
        for part, found in zip(parts, scores, strict=True):
            found.append(score_image(image, render_image(part, image.camera, settings.sh_degree, effects=effects)))
    before, after = (mean_score(found)[0] for found in scores)
    return {"before": before, "after": after, "views": len(images)}


def _subset(cloud: GaussianCloud, mask: torch.Tensor) -> GaussianCloud:
    """Return the Gaussians of a mask (N,) bool, with the same background."""
    parameters = cloud.parameters()
    background = parameters.pop("background")
    return GaussianCloud(**{name: tensor[mask] for name, tensor in parameters.items()}, background=background)
