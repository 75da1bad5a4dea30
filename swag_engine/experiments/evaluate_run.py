"""Evaluation of a finished run: scores on its test images, and rendered images."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ..base.errors import InputError, continue_run
from ..base.files import atomic_path, output_names
from ..base.html_page import number
from ..base.transfer import srgb_to_linear
from ..effects.scene_effects import SceneEffects
from ..evaluation.lpips import BACKBONES, load_lpips
from ..evaluation.metrics import (
    floater_mass,
    in_8_bits,
    joint_psnr,
    mask_invalid,
    mean,
    mean_score,
    median_image_psnr,
    render_color,
    render_image,
    restored_error,
    score_image,
)
from ..formats.exr import write_light_exr
from ..formats.run_folder import RunFolder, write_json
from ..gaussians.cloud import GaussianCloud
from ..kernels.hardware import Hardware, device_for, hardware_for
from ..kernels.machine import describe_machine
from ..rendering.haze import without_haze
from ..rendering.model import SceneModel
from ..rendering.restoration import RestorationLimit
from ..scene.cameras import Camera
from ..scene.colmap import Scene, load_scene
from ..scene.images import TrainingImage, decode_image, describe_empty, load_images, read_image
from ..scene.inspect import inspect_scene
from ..scene.split import split_views
from ..splats.development import Development
from ..splats.haze import HAZE, check_haze, haze_amount
from ..training.checkpoint import load_checkpoint
from ..training.inputs import median_range
from .develop_run import color_view
from .evaluation_page import write_evaluation_page
from .page import ViewComparison

PAGE = "evaluation.html"
"""Name of the page in the run's folder."""


def evaluate_run(folder: Path, weights_dir: Path | None = None) -> dict[str, Any]:
    """Score the newest checkpoint of a run on its test images; write evaluation.json and evaluation.html.

    Images without water are compared with clean/NAME.png or .webp of the scene, in the views that have one. Scores are
    those of images without development, the page shows developed ones.

    Args:
        folder: Folder of the run.
        weights_dir: Folder where LPIPS weights are searched first.

    Returns:
        The document in evaluation.json. `test_psnr` (dB), `test_ssim` and `test_lpips` (by backbone) are means over
        the views, `test_psnr_joint` is that of the error of all views together, `control_psnr` that of the
        median-image baseline, `floater_mass` (0..1) is defined in metrics.py. `restored` has psnr (dB) and delta_e of
        the images without water. `megabytes` (10^6 bytes) are those of the result files, `seconds` those of training.
        `machine` is where the evaluation ran. `views` has the metrics of each view, `notes` sentences for the user.
        Metrics that are not known are NaN.

    Raises:
        InputError: Where there is no run, or a file is damaged.
    """
    run = RunFolder(folder)
    scene_folder, settings, _ = run.read_config()
    loaded = load_run(folder)
    photographed, cloud, effects, state = loaded.through(1), loaded.cloud, loaded.effects, loaded.state
    lpips, notes = load_lpips(weights_dir)
    scene = load_scene(scene_folder)
    split = split_views([view.name for view in scene.views])
    wanted = [view for view in scene.views if view.name not in split.validation]
    images = load_images(scene, wanted, settings.width)
    notes += filter(None, [describe_empty(images)])
    images = [image for image in images if image.valid.any()]
    training = [image for image in images if image.camera.name in split.train]
    test = [image for image in images if image.camera.name in split.test]

    development = color_view(folder, "auto", cloud, effects).at(0)
    scores, views, comparisons = [], {}, []
    for image in test:
        color = render_image(photographed, image.camera, settings.sh_degree, effects=effects)
        restored = render_image(cloud, image.camera, settings.sh_degree, effects=effects, amount=0)
        shown_color, target, _ = mask_invalid(image, color)
        score = score_image(image, color)
        figures: dict[str, Any] = {"psnr": score.psnr, "ssim": score.ssim}
        figures["lpips"] = {name: network(shown_color, target) for name, network in lpips.items()}
        if truth := true_image(scene, image):
            psnr, delta_e = restored_error(restored.numpy(), *truth)
            figures["restored"] = {"psnr": psnr, "delta_e": delta_e}
        scores.append(score)
        views[score.name] = figures
        shown = render_image(
            cloud, image.camera, settings.sh_degree, effects=effects, amount=0, development=development
        )
        comparisons.append(compare_view(image, color, shown if effects.models else None))

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
        "control_psnr": median_image_psnr(training, test),
        "floater_mass": floater_mass(cloud, [image.camera for image in test], reference_range),
        "median_range": reference_range,
        "images": summary["images"],
        "registered": summary["registered"],
        "registered_share": summary["registered_share"],
        "gaussians": len(cloud),
        "megabytes": {path.name: path.stat().st_size / 1e6 for path in run.results.values() if path.exists()},
        "seconds": round(state["seconds"], 2),
        "machine": machine(hardware_for("auto", with_wgpu=False)),
        "notes": notes,
        "views": views,
    }  # fmt: skip
    write_json(folder / "evaluation.json", result)
    write_evaluation_page(folder / PAGE, result, comparisons)
    return result


def compare_view(
    image: TrainingImage, color: Tensor, restored: Tensor | None, confidence: Tensor | None = None
) -> ViewComparison:
    """Make the comparison of one view for a page.

    Args:
        image: Image of the scene.
        color: Rendered image (H, W, 3), display values 0..1.
        restored: Rendered image without water, developed (H, W, 3), None without a water model.
        confidence: Confidence (H, W) in its colors, 0..1, NaN where no Gaussian is; None if it is not to be shown.

    Returns:
        The comparison.
    """

    def to_bytes(x: Tensor) -> np.ndarray:
        return (x * 255).round().byte().numpy()

    without = None if restored is None else to_bytes(restored)
    sure = None if confidence is None else confidence.cpu().numpy()
    return ViewComparison(image.camera.name, image.pixels, to_bytes(color), image.valid, without, sure)


def describe(evaluation: dict[str, Any]) -> str:
    """Format an evaluation as the lines that `evaluate RUN` prints."""
    lines = [_scores(name, view["psnr"], view["ssim"], view["lpips"]) for name, view in evaluation["views"].items()]
    means = (evaluation[name] for name in ("test_psnr", "test_ssim", "test_lpips"))
    lines += [
        _scores("mean", *means),
        f"joint PSNR {number(evaluation['test_psnr_joint'], 2, ' dB')}, median-image baseline "
        f"{number(evaluation['control_psnr'], 2, ' dB')}, floater mass "
        f"{number(100 * evaluation['floater_mass'], 1, '%')}",
        f"{evaluation['gaussians']} Gaussians, {evaluation['seconds']:.0f} s of training",
        *evaluation["notes"],
        f"Page: {Path(evaluation['run']) / PAGE}",
    ]
    return "\n".join(lines)


def _scores(name: str, psnr: float, ssim: float, lpips: dict[str, float]) -> str:
    known = [f"LPIPS {BACKBONES[key].title} {value:.3f}" for key, value in lpips.items() if np.isfinite(value)]
    return ", ".join([f"{name}: PSNR {number(psnr, 2, ' dB')}", f"SSIM {number(ssim, 3)}", *known])


def true_image(scene: Scene, image: TrainingImage) -> tuple[np.ndarray, np.ndarray] | None:
    """Read the true image without water of a view, None where the scene has none.

    Returns:
        The image (H, W, 3), sRGB 0..1, and the valid pixels (H, W) bool: those of surfaces, which have a range.
    """
    name = Path(image.camera.name)
    pictures = [(scene.folder / "clean" / name).with_suffix(suffix) for suffix in (".png", ".webp")]
    clean = next((path for path in pictures if path.is_file()), None)
    if clean is None:
        return None
    ranges = (scene.folder / "range" / name).with_suffix(".png")
    height, width = image.valid.shape
    pixels = cv2.resize(read_image(clean)[0], (width, height), interpolation=cv2.INTER_AREA)
    valid = image.valid
    if ranges.is_file():
        valid = valid & (cv2.resize(decode_image(ranges), (width, height), interpolation=cv2.INTER_NEAREST) > 0)
    return pixels / np.float32(255), valid


def machine(hardware: Hardware) -> dict[str, Any]:
    """Describe the machine: card or processor, backend, system and versions."""
    found = describe_machine()
    return {
        "device": hardware.name,
        "backend": hardware.backend,
        "system": found["system"],
        "engine": found["engine"],
        "python": found["python"],
        "packages": found["packages"],
    }


def render_run(
    folder: Path,
    out: Path,
    camera: str | None,
    water: float = 1.0,
    develop: str = "auto",
    exr: bool = False,
    haze: float = 0.0,
) -> list[Path]:
    """Render views of a run at the training size to image files.

    Args:
        folder: Folder of the run.
        out: Folder of the files.
        camera: Name of one image; all test images without it.
        water: Amount of water, from 0 (removed) to 1 (as photographed).
        develop: Development of PNG files, as `RunFolder.color_view`.
        exr: Write linear light without development to OpenEXR files in place of PNG files.
        haze: Fraction of the haze in open water that is shown, 0..1; at least that of the water is.

    Returns:
        The files.

    Raises:
        InputError: For another amount, name or development, and where the run has no checkpoint.
    """
    if not 0 <= water <= 1:
        raise InputError(f"The amount of water must be from 0 to 1, not {water}.")
    check_haze(haze)
    scene_folder, settings, _ = RunFolder(folder).read_config()
    run = load_run(folder)
    cloud, effects = run.through(water, haze), run.effects
    scene = load_scene(scene_folder)
    names = [view.camera.name for view in scene.views]
    wanted = split_views(names).test if camera is None else [camera]
    if not set(wanted) <= set(names):
        raise InputError(f"{scene.folder} has no photo named {camera}; the first is {names[0]}.")
    development = color_view(folder, develop, run.cloud, effects).at(water)
    paths = output_names(names, ".exr" if exr else ".png")
    RunFolder(folder).refuse_own(*(out / paths[name] for name in wanted))
    files = []
    for view in scene.views:
        if view.camera.name not in wanted:
            continue
        sized = view.camera.resized(min(settings.width, view.camera.width))
        path = out / paths[sized.name]
        files.append(write_view(path, cloud, sized, settings.sh_degree, effects, water, development))
    return files


def write_view(
    path: Path,
    cloud: GaussianCloud,
    camera: Camera,
    sh_degree: int,
    effects: SceneEffects,
    water: float,
    development: Development,
) -> Path:
    """Render a view to an image file.

    Args:
        path: The file, as `write_picture`.
        cloud: The Gaussians.
        camera: The camera.
        sh_degree: Degree of the spherical harmonics.
        effects: Effects to render with.
        water: Amount of water, from 0 (removed) to 1 (as photographed).
        development: Development of a PNG file.

    Returns:
        The file.

    Raises:
        InputError: If it cannot be written.
    """
    color = render_color(cloud, camera, sh_degree, effects=effects, amount=water)
    return write_picture(path, color.numpy(), development)


def write_picture(path: Path, color: np.ndarray, development: Development) -> Path:
    """Write a picture to a file.

    Args:
        path: A PNG file, or an OpenEXR file, which gets linear light without development.
        color: (H, W, 3) display values, which may be above 1.
        development: Of a PNG file.

    Returns:
        The file.

    Raises:
        InputError: If it cannot be written.
    """
    if path.suffix == ".exr":
        write_light_exr(path, srgb_to_linear(color))
        return path
    pixels = in_8_bits(torch.from_numpy(development.apply(color))).mul(255).round().byte().numpy()
    with atomic_path(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())
    return path


@dataclass(frozen=True)
class LoadedRun:
    """Model of a run.

    Attributes:
        trained: The Gaussians as trained.
        effects: The effects.
        state: The stored state.
        limit: Limit of the restored colors; None where the run restores none or has not ended.
        haze: (N,) how sure it is that a Gaussian is open water; None where the run has not ended, or is older.
    """

    trained: GaussianCloud
    effects: SceneEffects
    state: dict[str, Any]
    limit: RestorationLimit | None
    haze: Tensor | None

    def through(self, water: float, haze: float = 0.0) -> GaussianCloud:
        """Return the Gaussians as they are seen through a fraction of the water, and with one of the haze, 0..1."""
        limited = self.limit.apply(self.trained, water) if self.limit else self.trained
        return without_haze(limited, self.haze, haze_amount(water, haze))

    @property
    def cloud(self) -> GaussianCloud:
        """The Gaussians as the result files have them, with limited colors where restored ones are not certain."""
        return self.through(0.0)

    @property
    def confidence(self) -> Tensor | None:
        """(N,) confidence in the restored colors, 0..1; None without a limit."""
        return None if self.limit is None else self.limit.least_confidence.to(self.trained.means)


def load_newest(folder: Path) -> tuple[GaussianCloud, SceneEffects, dict[str, Any]]:
    """Load the Gaussians of the result files, effects and stored state of a run, as `load_run`."""
    run = load_run(folder)
    return run.cloud, run.effects, run.state


def load_run(folder: Path) -> LoadedRun:
    """Load the newest checkpoint of a run to the device of the fastest backend.

    Args:
        folder: Folder of the run.

    Returns:
        The model.

    Raises:
        InputError: Where the run has no checkpoint, or it is damaged.
    """
    loaded = load_checkpoint(folder)
    if loaded is None:
        raise InputError(f"The run {folder} has no checkpoint yet; {continue_run()}.")
    tensors, state = loaded
    device = device_for("auto")
    model = SceneModel.from_checkpoint(tensors, state).to(device)
    return LoadedRun(model.cloud, model.effects, state, RestorationLimit.from_checkpoint(tensors), tensors.get(HAZE))
