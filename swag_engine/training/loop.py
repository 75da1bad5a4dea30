"""The optimisation: from a COLMAP scene to a run folder."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import InputError
from ..evaluation.metrics import mean_score, median_control, score_views
from ..formats.gltf import write_glb
from ..formats.ply import write_ply
from ..gaussians.cloud import GaussianCloud
from ..gaussians.grow import Growth, GrowthStatistics
from ..gaussians.init import gaussians_from_points
from ..gaussians.sh import C0
from ..rasterize.backends import device_for
from ..rasterize.render import render
from ..scene.cameras import Camera
from ..scene.colmap import Scene, load_scene
from ..scene.images import TrainingImage, load_images
from ..scene.split import split_views
from ..water.identify import FIT_WIDTH, fit_water, observe
from ..water.medium import MAX_DEGREE, SETTINGS, Medium, without_water
from .checkpoint import load_checkpoint, save_checkpoint
from .config import LearningRates, Schedule, TrainSettings
from .losses import l1_ssim
from .optimizer import Optimizer
from .recipes import RECIPES
from .run_folder import RunFolder, write_json

Event = dict[str, Any]


@dataclass
class Target:
    """One photograph at one size: camera, pixels (H, W, 3) uint8, valid (H, W) bool."""

    camera: Camera
    pixels: Tensor
    valid: Tensor

    @classmethod
    def shrunk(cls, image: TrainingImage, factor: int, device: torch.device) -> "Target":
        """The photograph at 1/factor of its size; a pixel is valid where all that it averages is."""
        camera, pixels, valid = image.camera, image.pixels, image.valid
        if factor > 1 and min(valid.shape) >= 32 * factor:
            camera = camera.resized(camera.width // factor)
            size = (camera.width, camera.height)
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
            valid = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
        return cls(camera, torch.from_numpy(pixels).to(device), torch.from_numpy(valid).to(device))


def train(
    scene_folder: Path,
    out: Path,
    settings: TrainSettings,
    resume: bool = False,
    on_event: Callable[[Event], None] = lambda event: None,
    should_stop: Callable[[], bool] = lambda: False,
    preview: bool = False,
) -> Event:
    """Train a scene to a run folder and return the `result` event.

    on_event gets `progress`, `preview` and `checkpoint` events as they happen. When should_stop() turns true the run
    ends after the iteration at hand, with everything written and "interrupted" true in the result. With `resume` the
    run goes on from its newest checkpoint with the settings it was started with, bit-equal to a run that never
    stopped (same machine, same backend). Raises InputError for anything wrong with the scene, the folder or the disk.
    """
    run = RunFolder(out)
    if resume:
        settings = resumed_settings(run, scene_folder, settings)
        if run.finished():
            raise InputError(f"The run {out} is finished already; its result is {run.ply.name}.")
    elif run.config.exists():
        raise InputError(f"{out} holds a training run already; continue it with --resume or choose another folder.")
    scene = load_scene(scene_folder)
    if not resume:
        run.write_config(scene.folder, settings, scene.up.tolist())
    try:
        trainer = Trainer(scene, run, settings, on_event)
    except InputError:
        if not resume:
            run.discard()
        raise
    if resume:
        trainer.resume()
    return trainer.run_to_end(should_stop, preview)


def resumed_settings(run: RunFolder, scene_folder: Path, asked: TrainSettings) -> TrainSettings:
    """The settings that the run was started with. Raises InputError where the request names others."""
    scene, settings, _ = run.read_config()
    if scene.resolve() != scene_folder.resolve():
        raise InputError(f"The run {run.path} belongs to the scene {scene}, not to {scene_folder}.")
    default, kept = TrainSettings().to_json(), settings.to_json()
    for name, value in asked.to_json().items():
        if value not in (default[name], kept[name]):
            title = name.replace("_", " ")
            raise InputError(f"The run {run.path} was started with {title} {kept[name]}; it cannot go on with {value}.")
    return settings


class Trainer:
    """One run: the scene's photographs, the cloud, its optimiser, and what was measured so far."""

    def __init__(
        self, scene: Scene, run: RunFolder, settings: TrainSettings, on_event: Callable[[Event], None]
    ) -> None:
        self.run, self.settings, self.on_event, self.scene = run, settings, on_event, scene
        self.rates, self.schedule, self.growth = LearningRates(), Schedule(), Growth()
        self.device = device_for(settings.backend)
        self.iteration, self.seconds_before = 0, 0.0
        self.psnr: float | None = None
        self.ssim: float | None = None
        self.images = self.load_photographs()
        split = split_views([view.camera.name for view in scene.views])
        self.training = [self.images[name] for name in split.train]
        self.validation = [self.images[name] for name in split.validation]
        self.test = [self.images[name] for name in split.test]
        self.levels: dict[int, list[Target]] = {}
        self.median_range = median_range(scene, self.training)
        background = (
            np.median(np.stack([np.median(image.pixels, axis=(0, 1)) for image in self.training]), axis=0) / 255
        )
        cloud = gaussians_from_points(
            scene.points, settings.max_gaussians, settings.sh_degree, settings.seed, background
        )
        self.start_count = len(cloud)
        self.recipe = RECIPES[settings.recipe]
        self.water_note, medium = self.find_water() if self.recipe.water else ("", None)
        if medium:
            self.take_water_away(cloud, medium)
        self.optimizer = Optimizer(cloud.to(self.device), medium and medium.to(self.device), settings.backend)
        self.statistics = GrowthStatistics.zeros(len(cloud), self.device)

    @property
    def cloud(self) -> GaussianCloud:
        return self.optimizer.cloud

    @property
    def medium(self) -> Medium | None:
        return self.optimizer.medium

    def find_water(self) -> tuple[str, Medium | None]:
        """What the sparse points say of the water, in one sentence, and the medium that training starts from."""
        width = max(self.settings.width, FIT_WIDTH)
        views = {view.camera.name: view for view in self.scene.views}
        known = self.training + self.validation
        seen = [views[image.camera.name] for image in known]
        images = load_images(self.scene, seen, width) if width > self.settings.width else known
        fit = fit_water(observe(images, [view.point_indices for view in seen], self.scene.points))
        if not fit.found:
            return fit.reason, None
        start = (torch.from_numpy(values).float() for values in (fit.beta_D, fit.beta_B, fit.B))
        return fit.reason, Medium.starting(self.median_range, "linear", *start)

    def take_water_away(self, cloud: GaussianCloud, medium: Medium) -> None:
        """Let the colours, which are those of the points as photographed, begin as they are without the water."""
        centres = torch.from_numpy(np.stack([image.camera.centre for image in self.training])).to(cloud.means)
        ranges = torch.cdist(cloud.means, centres).median(dim=1).values
        cloud.sh0[:, 0] = (without_water(0.5 + C0 * cloud.sh0[:, 0], ranges, medium) - 0.5) / C0

    def load_photographs(self) -> dict[str, TrainingImage]:
        def progress(done: int, total: int) -> None:
            self.on_event({"event": "progress", "stage": "load", "iteration": done, "iterations": total})

        images = load_images(self.scene, self.scene.views, self.settings.width, progress)
        return {image.camera.name: image for image in images}

    # -- one iteration ------------------------------------------------------------------------------------------------

    def step(self) -> float:
        """One iteration; returns its loss."""
        fraction = self.iteration / self.settings.iterations
        target = self.next_target(fraction)
        degree = min(self.settings.sh_degree, sum(fraction >= start for start in self.schedule.sh_degrees))
        picture = render(
            self.cloud, target.camera, degree, self.medium, self.water_degree, backend=self.settings.backend
        )
        loss = l1_ssim(picture.color, target.pixels.float() / 255, target.valid, backend=self.settings.backend)
        loss.backward()
        gradient = picture.rendering.means2d.grad
        if gradient is not None:
            self.statistics.add(gradient, picture.rendering.radii, target.camera.width)
        self.optimizer.step(self.learning_rates(fraction))
        self.iteration += 1
        self.grow()
        return float(loss.detach())

    @property
    def water_degree(self) -> int:
        """SH degree of the water's colour at this iteration."""
        return MAX_DEGREE if self.iteration >= self.recipe.veil_degrees_from * self.settings.iterations else 0

    def learning_rates(self, fraction: float) -> dict[str, float]:
        """Step size by name, `fraction` (0..1) of the way through the run."""
        rates = asdict(self.rates)
        end = rates.pop("means_end")
        rates["means"] *= (end / self.rates.means) ** fraction * self.median_range
        water = self.recipe.water_rate * 0.5 * (1 + math.cos(math.pi * fraction))
        return rates | {f"medium.{name}": water for name in ("attenuation", "backscatter", "veil")}

    def next_target(self, fraction: float) -> Target:
        """The photograph of this iteration: every epoch in its own order, which depends on the seed alone."""
        factor = next((factor for until, factor in self.schedule.coarse if fraction < until), 1)
        if factor not in self.levels:
            self.levels = {factor: [Target.shrunk(image, factor, self.device) for image in self.training]}
        epoch, position = divmod(self.iteration, len(self.training))
        order = np.random.default_rng((self.settings.seed, epoch)).permutation(len(self.training))
        return self.levels[factor][order[position]]

    def grow(self) -> None:
        schedule, total = self.schedule, self.settings.iterations
        fraction = self.iteration / total
        if self.iteration % schedule.grow_every or not schedule.grow_from <= fraction <= schedule.grow_until:
            return
        progress = (fraction - schedule.grow_from) / (schedule.grow_until - schedule.grow_from)
        # The number grows to its limit evenly in time, so that late Gaussians still have time to settle.
        budget = self.start_count + int((self.settings.max_gaussians - self.start_count) * min(1.0, 1.25 * progress))
        with torch.no_grad():
            cloud, source = self.growth.event(self.cloud, self.statistics, budget, self.median_range)
        self.optimizer.replace(cloud, source)
        self.statistics = GrowthStatistics.zeros(len(cloud), self.device)

    # -- the run ------------------------------------------------------------------------------------------------------

    def run_to_end(self, should_stop: Callable[[], bool], preview: bool) -> Event:
        settings, schedule = self.settings, self.schedule
        started = saved = shown = reported = time.monotonic()
        first = self.iteration
        every = max(1, round(settings.iterations * schedule.validate))
        interrupted = False
        loss = float("nan")
        while self.iteration < settings.iterations:
            if should_stop():
                interrupted = True
                break
            loss = self.step()
            now = time.monotonic()
            seconds = self.seconds_before + now - started
            if self.iteration % every == 0 and self.validation and self.iteration < settings.iterations:
                self.validate(loss, seconds)
            if now - reported > 0.2 or self.iteration == settings.iterations:
                reported = now
                speed = (self.iteration - first) / max(now - started, 1e-9)
                self.on_event(self.progress(loss, seconds, speed))
            if preview and now - shown > schedule.preview_seconds:
                write_ply(self.run.preview, self.cloud.to_splats(sh_degree=0))
                self.on_event({"event": "preview", "path": str(self.run.preview), "iteration": self.iteration})
                shown = time.monotonic()
            if now - saved > schedule.checkpoint_seconds:
                self.save(seconds)
                saved = time.monotonic()
        seconds = self.seconds_before + time.monotonic() - started
        self.save(seconds)
        return self.finish(loss, seconds, interrupted)

    def progress(self, loss: float, seconds: float, speed: float) -> Event:
        left = self.settings.iterations - self.iteration
        return {
            "event": "progress",
            "stage": "train",
            "iteration": self.iteration,
            "iterations": self.settings.iterations,
            "seconds": round(seconds, 2),
            "seconds_left": round(self.seconds_left(left, speed), 1),
            "loss": loss,
            "psnr": self.psnr,
            "ssim": self.ssim,
            "gaussians": len(self.cloud),
            "iterations_per_second": round(speed, 2),
        }

    def seconds_left(self, iterations: int, speed: float) -> float:
        return iterations / max(speed, 1e-9)

    def validate(self, loss: float, seconds: float) -> None:
        """Score the validation views and log it. Test views are never looked at here."""
        scores = score_views(self.cloud, self.validation, self.settings.sh_degree, self.settings.backend, self.medium)
        self.psnr, self.ssim = mean_score(scores)
        self.run.log(
            {
                "iteration": self.iteration,
                "seconds": round(seconds, 3),
                "loss": loss,
                "psnr": self.psnr,
                "ssim": self.ssim,
                "gaussians": len(self.cloud),
                "ms": round(1000 * seconds / self.iteration, 2),
            }
        )

    def finish(self, loss: float, seconds: float, interrupted: bool) -> Event:
        """Write results and figures; returns the result event."""
        if self.validation and self.iteration:
            self.validate(loss, seconds)
        splats = self.cloud.to_splats()
        write_ply(self.run.ply, splats)
        write_glb(self.run.glb, splats, self.scene.up)
        scores = score_views(self.cloud, self.test, self.settings.sh_degree, self.settings.backend, self.medium)
        test_psnr, test_ssim = mean_score(scores)
        metrics: Event = {
            "test_psnr": test_psnr,
            "test_ssim": test_ssim,
            "control_psnr": median_control(self.training, self.test),
            "psnr": self.psnr,
            "ssim": self.ssim,
            "iteration": self.iteration,
            "iterations": self.settings.iterations,
            "gaussians": len(self.cloud),
            "seconds": round(seconds, 2),
            "interrupted": interrupted,
            "background": self.background(),
            "water": self.water_note,
            "views": {score.name: {"psnr": score.psnr, "ssim": score.ssim} for score in scores},
        }
        self.run.log(
            {
                "iteration": self.iteration,
                "seconds": round(seconds, 3),
                **{k: metrics[k] for k in ("test_psnr", "test_ssim")},
            }
        )
        if self.medium:
            write_json(self.run.water, self.medium.to_json())
        self.run.write_metrics(metrics)
        self.run.preview.unlink(missing_ok=True)
        return {
            "event": "result",
            "request": "train",
            "run": str(self.run.path),
            "ply": str(self.run.ply),
            "metrics": metrics,
            "interrupted": interrupted,
        }

    def background(self) -> list[float]:
        """Display colour (3,) behind the Gaussians: black where the water that was there has been taken away."""
        color = torch.zeros(3) if self.medium else self.cloud.background.detach().sigmoid()
        return [round(value, 6) for value in color.tolist()]

    # -- checkpoints --------------------------------------------------------------------------------------------------

    def save(self, seconds: float) -> None:
        tensors = {f"cloud.{name}": tensor.detach() for name, tensor in self.cloud.parameters().items()}
        if self.medium:
            tensors |= {f"medium.{name}": tensor.detach() for name, tensor in self.medium.parameters().items()}
        tensors |= self.optimizer.state_tensors()
        tensors |= {"growth.gradient": self.statistics.gradient, "growth.views": self.statistics.views}
        state = {
            "iteration": self.iteration,
            "seconds": seconds,
            "start_count": self.start_count,
            "psnr": self.psnr,
            "ssim": self.ssim,
            "medium": self.medium and {name: getattr(self.medium, name) for name in SETTINGS},
        }
        path = save_checkpoint(self.run.path, self.iteration, tensors, state)
        self.on_event({"event": "checkpoint", "path": str(path)})

    def resume(self) -> None:
        """Go on from the newest checkpoint; from the start when the run was stopped before its first."""
        loaded = load_checkpoint(self.run.path)
        if loaded is None:
            self.run.log_until(0)
            return
        tensors, state = loaded
        cloud, medium = cloud_from_tensors(tensors), medium_from_tensors(tensors, state)
        self.optimizer = Optimizer(cloud.to(self.device), medium and medium.to(self.device), self.settings.backend)
        self.optimizer.load_state(tensors)
        sums = (tensors[name].to(self.device, copy=True) for name in ("growth.gradient", "growth.views"))
        self.statistics = GrowthStatistics(*sums)
        self.iteration, self.seconds_before = state["iteration"], state["seconds"]
        self.start_count, self.psnr, self.ssim = state["start_count"], state["psnr"], state["ssim"]
        self.run.log_until(self.iteration)


def cloud_from_tensors(tensors: dict[str, Tensor]) -> GaussianCloud:
    """The cloud of a checkpoint's tensors."""
    prefix = "cloud."
    return GaussianCloud(**{name[len(prefix) :]: t.clone() for name, t in tensors.items() if name.startswith(prefix)})


def medium_from_tensors(tensors: dict[str, Tensor], state: dict[str, Any]) -> Medium | None:
    """The water of a checkpoint, None where it has none."""
    prefix = "medium."
    found = {name[len(prefix) :]: t.clone() for name, t in tensors.items() if name.startswith(prefix)}
    if not found:
        return None
    settings = state["medium"]
    return Medium(found["attenuation"], found["backscatter"], found["veil"], settings["unit_range"], settings["light"])


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
