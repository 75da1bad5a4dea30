"""What a finished run shows: scores and pictures."""

from pathlib import Path
from typing import Any

import cv2
import torch

from ..errors import InputError
from ..files import atomic_path
from ..gaussians.cloud import GaussianCloud
from ..rasterize.render import render
from ..scene.colmap import load_scene
from ..scene.images import load_images
from ..scene.split import split_views
from ..training.checkpoint import load_checkpoint
from ..training.loop import cloud_from_tensors
from ..training.run_folder import RunFolder
from .metrics import mean_score, score_views


def evaluate_run(folder: Path) -> dict[str, Any]:
    """Mean and per-view PSNR (dB) and SSIM on the held-out views. Raises InputError where there is no run."""
    scene_folder, settings, _ = RunFolder(folder).read_config()
    cloud = load_cloud(folder)
    scene = load_scene(scene_folder)
    held_out = set(split_views([view.camera.name for view in scene.views]).test)
    images = load_images(scene, [view for view in scene.views if view.camera.name in held_out], settings.width, None)
    scores = score_views(cloud, images, settings.sh_degree, settings.backend)
    test_psnr, test_ssim = mean_score(scores)
    views = {score.name: {"psnr": score.psnr, "ssim": score.ssim} for score in scores}
    return {"test_psnr": test_psnr, "test_ssim": test_ssim, "views": views}


def render_run(folder: Path, out: Path, camera: str | None) -> list[Path]:
    """Write one PNG a view at the training size and return the files: the held-out views, or the one named `camera`."""
    scene_folder, settings, _ = RunFolder(folder).read_config()
    cloud = load_cloud(folder)
    scene = load_scene(scene_folder)
    names = [view.camera.name for view in scene.views]
    wanted = split_views(names).test if camera is None else [camera]
    if not set(wanted) <= set(names):
        raise InputError(f"{scene.folder} has no photograph named {camera}; the first is {names[0]}.")
    files = []
    with torch.no_grad():
        for view in scene.views:
            if view.camera.name not in wanted:
                continue
            sized = view.camera.resized(min(settings.width, view.camera.width))
            color = render(cloud, sized, settings.sh_degree, backend=settings.backend).color
            pixels = (color.clamp(0, 1) * 255).round().byte().numpy()
            path = (out / view.camera.name).with_suffix(".png")
            with atomic_path(path) as temporary:
                temporary.write_bytes(cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())
            files.append(path)
    return files


def load_cloud(folder: Path) -> GaussianCloud:
    """The Gaussians of a run's newest checkpoint."""
    loaded = load_checkpoint(folder)
    if loaded is None:
        raise InputError(f"The run {folder} has no checkpoint yet; continue it with train --resume.")
    return cloud_from_tensors(loaded[0])
