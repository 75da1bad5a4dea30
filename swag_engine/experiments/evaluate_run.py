"""What a finished run shows: scores and pictures."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ..base.errors import InputError
from ..base.files import atomic_path
from ..effects.scene_effects import SceneEffects
from ..evaluation.lpips import BACKBONES, load_lpips
from ..evaluation.metrics import (
    comparable,
    floater_mass,
    joint_psnr,
    mean,
    mean_score,
    median_control,
    picture,
    restored_error,
    score_picture,
)
from ..formats.run_folder import RunFolder, write_json
from ..gaussians.cloud import GaussianCloud
from ..kernels.backends import device_for
from ..kernels.machine import examine
from ..rendering.model import SceneModel
from ..scene.colmap import Scene, load_scene
from ..scene.images import TrainingImage, load_images, read_picture
from ..scene.inspect import inspect_scene
from ..scene.split import split_views
from ..training.checkpoint import load_checkpoint
from ..training.inputs import median_range
from .evaluation_page import write_evaluation_page
from .page import Compared

PAGE = "evaluation.html"


def evaluate_run(folder: Path, weights_dir: Path | None = None) -> dict[str, Any]:
    """Score a run's newest checkpoint on the held-out views; write evaluation.json and evaluation.html to its folder.

    weights_dir: where LPIPS weights are looked for first. Without water the pictures are compared with the scene's
    clean/NAME.png or .webp, in the views that have one. Figures that cannot be had are not a number; `notes` are
    sentences for the user.

    test_psnr (dB), test_ssim and test_lpips (by backbone) are means over the views, test_psnr_joint is of the error of
    all views together; control_psnr is median_control's, floater_mass (0..1) as in metrics; restored has psnr (dB) and
    delta_e; megabytes (10^6 bytes) are of the result's files, seconds those of training; machine is where this
    evaluation ran. `views` has the figures of each. Raises InputError where there is no run, or a file is damaged.
    """
    run = RunFolder(folder)
    scene_folder, settings, _ = run.read_config()
    cloud, simulated, state = newest(folder)
    lpips, notes = load_lpips(weights_dir)
    scene = load_scene(scene_folder)
    split = split_views([view.name for view in scene.views])
    wanted = [view for view in scene.views if view.name not in split.validation]
    images = load_images(scene, wanted, settings.width)
    training = [image for image in images if image.camera.name in split.train]
    test = [image for image in images if image.camera.name in split.test]

    scores, views, shown = [], {}, []
    for image in test:
        color = picture(cloud, image.camera, settings.sh_degree, simulated=simulated)
        restored = picture(cloud, image.camera, settings.sh_degree, simulated=simulated, amount=0)
        shown_color, target, _ = comparable(image, color)
        score = score_picture(image, color)
        figures: dict[str, Any] = {"psnr": score.psnr, "ssim": score.ssim}
        figures["lpips"] = {name: network(shown_color, target) for name, network in lpips.items()}
        if truth := _clean_picture(scene, image):
            psnr, delta_e = restored_error(restored.numpy(), *truth)
            figures["restored"] = {"psnr": psnr, "delta_e": delta_e}
        scores.append(score)
        views[score.name] = figures
        shown.append(compared(image, color, restored if simulated.models else None))

    test_psnr, test_ssim = mean_score(scores)
    summary = inspect_scene(scene)
    truths = [view["restored"] for view in views.values() if "restored" in view]
    reference_range = median_range(scene, training)
    result = {
        "run": str(folder.absolute()),
        "scene": str(scene.folder),
        "iteration": state["iteration"],
        "test_psnr": test_psnr,
        "test_psnr_joint": joint_psnr(scores),
        "test_ssim": test_ssim,
        "test_lpips": {name: mean([view["lpips"].get(name, float("nan")) for view in views.values()])
                       for name in BACKBONES},
        "restored": {name: mean([truth[name] for truth in truths]) for name in ("psnr", "delta_e")},
        "control_psnr": median_control(training, test),
        "floater_mass": floater_mass(cloud, [image.camera for image in test], reference_range),
        "median_range": reference_range,
        "images": summary["images"],
        "registered": summary["registered"],
        "registered_share": summary["registered_share"],
        "gaussians": len(cloud),
        "megabytes": {path.name: path.stat().st_size / 1e6 for path in run.results.values() if path.exists()},
        "seconds": round(state["seconds"], 2),
        "machine": machine(cloud.means.device),
        "notes": notes,
        "views": views,
    }  # fmt: skip
    write_json(folder / "evaluation.json", result)
    write_evaluation_page(folder / PAGE, result, shown)
    return result


def compared(image: TrainingImage, color: Tensor, restored: Tensor | None) -> Compared:
    """A view for a page, of its pictures (H, W, 3) in 0..1; restored: without the water, None where there is none."""

    def in_8_bits(x: Tensor) -> np.ndarray:
        return (x * 255).round().byte().numpy()

    without = None if restored is None else in_8_bits(restored)
    return Compared(image.camera.name, image.pixels, in_8_bits(color), image.valid, without)


def describe(evaluation: dict[str, Any]) -> str:
    """The lines that `evaluate RUN` prints."""
    lines = [_scores(name, view["psnr"], view["ssim"], view["lpips"]) for name, view in evaluation["views"].items()]
    means = (evaluation[name] for name in ("test_psnr", "test_ssim", "test_lpips"))
    lines += [
        _scores("mean", *means),
        f"joint PSNR {evaluation['test_psnr_joint']:.2f} dB, of the median photograph "
        f"{evaluation['control_psnr']:.2f} dB, floater mass {evaluation['floater_mass']:.1%}",
        f"{evaluation['gaussians']} Gaussians, {evaluation['seconds']:.0f} s of training",
        *evaluation["notes"],
        f"Page: {Path(evaluation['run']) / PAGE}",
    ]
    return "\n".join(lines)


def _scores(name: str, psnr: float, ssim: float, lpips: dict[str, float]) -> str:
    known = [f"LPIPS {BACKBONES[key].title} {value:.3f}" for key, value in lpips.items() if np.isfinite(value)]
    return ", ".join([f"{name}: PSNR {psnr:.2f} dB", f"SSIM {ssim:.3f}", *known])


def _clean_picture(scene: Scene, image: TrainingImage) -> tuple[np.ndarray, np.ndarray] | None:
    """Truth without water for a view: (H, W, 3) sRGB in 0..1, and where it holds: on surfaces, which have a range."""
    name = Path(image.camera.name)
    pictures = [(scene.folder / "clean" / name).with_suffix(suffix) for suffix in (".png", ".webp")]
    clean = next((path for path in pictures if path.is_file()), None)
    if clean is None:
        return None
    ranges = (scene.folder / "range" / name).with_suffix(".png")
    height, width = image.valid.shape
    pixels = cv2.resize(read_picture(clean)[0], (width, height), interpolation=cv2.INTER_AREA)
    valid = image.valid
    if ranges.is_file():
        range_mm = cv2.imdecode(np.fromfile(ranges, np.uint8), cv2.IMREAD_UNCHANGED)
        if range_mm is None:
            raise InputError(f"{ranges} cannot be read as a picture: it may be cut short; copy it again.")
        valid = valid & (cv2.resize(range_mm, (width, height), interpolation=cv2.INTER_NEAREST) > 0)
    return pixels / np.float32(255), valid


def machine(device: torch.device) -> dict[str, Any]:
    """Where this runs and with which versions."""
    found = examine()
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"CPU, {found['cores']} cores"
    return {
        "device": name,
        "backend": found["auto"],
        "system": found["system"],
        "engine": found["engine"],
        "python": found["python"],
        "packages": found["packages"],
    }


def render_run(folder: Path, out: Path, camera: str | None, water: float = 1.0) -> list[Path]:
    """Write one PNG a view at the training size and return the files: the held-out views, or the one named `camera`.

    water: how much of it, from 0 (taken away) to 1 (as photographed). Raises InputError for another amount or name.
    """
    if not 0 <= water <= 1:
        raise InputError(f"The amount of water must be from 0 to 1, not {water}.")
    scene_folder, settings, _ = RunFolder(folder).read_config()
    cloud, simulated, _ = newest(folder)
    scene = load_scene(scene_folder)
    names = [view.camera.name for view in scene.views]
    wanted = split_views(names).test if camera is None else [camera]
    if not set(wanted) <= set(names):
        raise InputError(f"{scene.folder} has no photograph named {camera}; the first is {names[0]}.")
    files = []
    for view in scene.views:
        if view.camera.name not in wanted:
            continue
        sized = view.camera.resized(min(settings.width, view.camera.width))
        pixels = (
            (picture(cloud, sized, settings.sh_degree, simulated=simulated, amount=water) * 255).round().byte().numpy()
        )
        path = (out / view.camera.name).with_suffix(".png")
        with atomic_path(path) as temporary:
            temporary.write_bytes(cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())
        files.append(path)
    return files


def newest(folder: Path) -> tuple[GaussianCloud, SceneEffects, dict[str, Any]]:
    """Gaussians and effects of a run's newest checkpoint, where they are rendered fastest, and its state."""
    loaded = load_checkpoint(folder)
    if loaded is None:
        raise InputError(f"The run {folder} has no checkpoint yet; continue it with train --resume.")
    tensors, state = loaded
    device = device_for("auto")
    model = SceneModel.from_checkpoint(tensors, state).to(device)
    return model.cloud, model.effects, state
