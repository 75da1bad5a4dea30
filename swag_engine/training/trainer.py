"""The optimisation: from a COLMAP scene to a run folder."""

import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base.errors import InputError
from ..base.files import claimed
from ..base.timing import Ledger
from ..evaluation.metrics import ViewScore, mean_score, median_control, score_views
from ..formats.gltf import write_glb
from ..formats.ply import write_ply
from ..formats.run_folder import RunFolder, write_json
from ..gaussians.cloud import GaussianCloud
from ..gaussians.densify import Growth, GrowthStatistics, McmcGrowth
from ..gaussians.init import gaussians_from_points
from ..kernels.backends import device_for
from ..scene.colmap import Scene, load_scene
from ..scene.images import TrainingImage, load_images
from ..scene.split import split_views
from ..semantics.embed import DIMENSIONS
from ..settings.settings import TrainSettings
from ..water.medium import Medium
from .checkpoint import load_checkpoint, save_checkpoint
from .dropout import LOOKED_AT, dropout_note, dropout_rate
from .guard import Guard, finite_part
from .guidance import Guidance, find_guidance
from .optimizer import Optimizer
from .pacing.budget import Budget, fit_budget
from .pacing.clock import FLAT_DB, FLAT_SHARE, REPLANNED, Clock, Point, is_flat, next_minute
from .pacing.memory import TOO_LITTLE, Relief, fit_memory, free_memory, within_memory
from .pacing.speed import Extent
from .prepare import find_depth, find_frames, median_range
from .run_plan import plan_of_run
from .schedule import Schedule
from .step import Iteration
from .targets import Target
from .trials import trials_due, try_effects

Event = dict[str, Any]
CPU = torch.device("cpu")


def train(
    scene_folder: Path,
    out: Path,
    settings: TrainSettings,
    resume: bool = False,
    on_event: Callable[[Event], None] = lambda event: None,
    should_stop: Callable[[], bool] = lambda: False,
    preview: bool = False,
    weights_dir: Path | None = None,
    started: float | None = None,
) -> Event:
    """Train a scene to a run folder and return the `result` event.

    on_event gets `progress`, `preview` and `checkpoint` events as they happen. should_stop() is asked between two
    iterations: it may wait, which pauses the run; when it turns true the run ends, with everything written and
    "interrupted" true in the result. With `resume` the run goes on from its newest checkpoint with the settings it was
    started with, bit-equal to a run that never stopped (same machine, same backend), unless time limits it. Resumed
    with more iterations or a time budget, a finished run goes on for so long. weights_dir: where networks are looked
    for before the user's cache. started: time.monotonic() that a time budget counts from, now without it. Raises
    InputError for anything wrong with the scene, the folder or the disk.
    """
    started = time.monotonic() if started is None else started
    with claimed(out):
        trainer = trainer_of(RunFolder(out), scene_folder, settings, resume, on_event, weights_dir, started)
        return trainer.run_to_end(should_stop, preview)


def trainer_of(
    run: RunFolder,
    scene_folder: Path,
    settings: TrainSettings,
    resume: bool,
    on_event: Callable[[Event], None],
    weights_dir: Path | None,
    started: float,
) -> "Trainer":
    """The trainer of a new run, or of one as far as it came; arguments as of `train`."""
    longer = False
    if resume:
        settings, longer = run.resumed_settings(scene_folder, settings)
    elif run.config.exists():
        raise InputError(
            f"{run.path} holds a training run already; continue it with --resume or choose another folder."
        )
    scene = load_scene(scene_folder)
    settings, budget = fit_budget(scene, settings.sized(), started)
    note = ""
    if not resume:
        settings, note = fit_memory(Extent.of(scene), settings, free_memory(device_for(settings.backend)))
    run.write_config(scene.folder, settings, scene.up.tolist())
    try:
        trainer = within_memory(lambda: Trainer(scene, run, settings, on_event, weights_dir, budget, resume))
        if not trainer:
            raise InputError(TOO_LITTLE)
        trainer.notes += filter(None, [note])
    except InputError:
        if not resume:
            run.discard()
        raise
    if resume:
        trainer.resume(longer)
    return trainer


class Trainer(Iteration):
    """One run: the scene's photographs, the cloud, its optimiser, and what was measured so far."""

    def __init__(
        self,
        scene: Scene,
        run: RunFolder,
        settings: TrainSettings,
        on_event: Callable[[Event], None],
        weights_dir: Path | None,
        budget: Budget | None = None,
        resume: bool = False,
    ) -> None:
        self.run, self.settings, self.on_event, self.scene = run, settings, on_event, scene
        self.schedule = Schedule()
        self.device = device_for(settings.backend)
        self.iteration, self.seconds_before = 0, 0.0
        self.budget = budget
        self.clock = Clock(settings.iterations or (budget.iterations if budget else 1))
        self.ledger = Ledger(torch.cuda.synchronize if self.device.type == "cuda" else None)
        self.psnr: float | None = None
        self.ssim: float | None = None
        self.training_psnr: float | None = None
        self.dropout = 0.0
        self.images = self.load_photographs()
        split = split_views([view.camera.name for view in scene.views])
        self.training = [self.images[name] for name in split.train]
        self.validation = [self.images[name] for name in split.validation]
        self.test = [self.images[name] for name in split.test]
        self.levels: dict[int, list[Target]] = {}
        self.relief = Relief()
        self.median_range = median_range(scene, self.training)
        background = (
            np.median(np.stack([np.median(image.pixels, axis=(0, 1)) for image in self.training]), axis=0) / 255
        )
        cloud = gaussians_from_points(
            scene.points, settings.max_gaussians, settings.sh_degree, settings.seed, background
        )
        self.start_count = len(cloud)
        plan = plan_of_run(scene, self.training + self.validation, settings, run.plan, weights_dir, resume)
        if plan:
            on_event({"event": "plan", "plan": plan.to_json()})
        simulated, recipe = self.begin_effects(plan, cloud), self.recipe
        self.growth = McmcGrowth() if recipe.growth == "mcmc" else Growth()
        cloud = finite_part(cloud)
        self.notes: list[str] = []
        self.curve: list[Point] = []
        self.depth: dict[str, np.ndarray] = {}
        self.frames: list[TrainingImage] = []
        if recipe.depth:
            note, self.depth = find_depth(scene, self.training, weights_dir)
            self.notes.append(note)
        if recipe.interpolation:
            note, self.frames = find_frames(scene, self.training, weights_dir)
            self.notes.append(note)
        self.guidance: Guidance | None = None
        if recipe.uses_regions:
            note, self.guidance = find_guidance(scene, self.training, recipe, settings, weights_dir)
            self.notes.append(note)
            cloud.features = cloud.means.new_zeros(len(cloud), DIMENSIONS if self.guidance else 0)
        self.optimizer = Optimizer(cloud.to(self.device), simulated, settings.backend)
        self.statistics = GrowthStatistics.zeros(len(cloud), self.device)
        self.guard = Guard(self.optimizer, self.clock.iterations)

    def load_photographs(self) -> dict[str, TrainingImage]:
        def progress(done: int, total: int) -> None:
            self.on_event({"event": "progress", "stage": "load", "iteration": done, "iterations": total})

        images = load_images(self.scene, self.scene.views, self.settings.width, progress)
        return {image.camera.name: image for image in images}

    # -- the run ------------------------------------------------------------------------------------------------------

    def run_to_end(self, should_stop: Callable[[], bool], preview: bool) -> Event:
        settings, schedule = self.settings, self.schedule
        self.resumed_at = self.iteration
        self.began = saved = shown = reported = planned = time.monotonic()
        validations = self.validations_due
        interrupted = False
        loss = float("nan")
        while not (self.clock.done or self.guard.gives_up):
            asked = time.monotonic()
            if should_stop():
                interrupted = True
                break
            paused = time.monotonic() - asked
            if paused > 0.1:
                self.began, planned = self.began + paused, planned + paused
                if self.budget:
                    self.budget.started += paused
            if trials_due(self):
                asked = time.monotonic()
                if interrupted := not try_effects(self, should_stop):
                    break
                planned += time.monotonic() - asked
                continue
            with self.ledger.iteration():
                loss = self.step()
            if self.validation and self.validations_due > validations and not self.clock.done:
                validations = self.validations_due
                self.validate(loss)
                if settings.stop_when_flat:
                    self.stop_when_flat()
            now = time.monotonic()
            if self.budget and self.iteration % REPLANNED == 0:
                self.clock.replan(self.iteration, now - planned, self.budget.left(), self.budget.predicted)
                planned = now
            if now - reported > 0.2 or self.clock.done:
                reported = now
                self.on_event(self.progress(loss))
            if preview and now - shown > schedule.preview_seconds:
                write_ply(self.run.preview, self.cloud.to_splats(sh_degree=0))
                water = self.medium.to_json() if self.medium else None  # per scene unit
                path = str(self.run.preview)
                self.on_event({"event": "preview", "path": path, "iteration": self.iteration, "water": water})
                shown = time.monotonic()
            if now - saved > schedule.checkpoint_seconds:
                self.save()
                saved = time.monotonic()
        self.guard.settle(self.optimizer)
        self.save()
        return self.finish(loss, interrupted)

    @property
    def validations_due(self) -> int:
        """How many validations the run should have had by now."""
        return int(self.clock.fraction / self.schedule.validate + 1e-6)

    @property
    def seconds(self) -> float:
        """Time trained so far, earlier parts of a resumed run included."""
        return self.seconds_before + time.monotonic() - self.began

    def stop_when_flat(self) -> None:
        """Go to the last stage once the curve is flat and the Gaussians have had time to settle."""
        fraction, last = self.clock.fraction, self.recipe.stage_two_from
        if not (self.recipe.grow_until + FLAT_SHARE <= fraction < last and is_flat(self.curve)):
            return
        self.notes.append(f"Ended early: a fifth of the run gained less than {FLAT_DB} dB on the validation views.")
        self.clock.skip_to(last, self.iteration)
        if self.budget:
            self.budget.shorten(self.seconds * (1 - last) / last)

    def progress(self, loss: float) -> Event:
        speed = (self.iteration - self.resumed_at) / max(time.monotonic() - self.began, 1e-9)
        planned = self.clock.planned(self.iteration)
        left = max(0.0, self.budget.left()) if self.budget else (planned - self.iteration) / max(speed, 1e-9)
        return {
            "event": "progress",
            "stage": "train",
            "iteration": self.iteration,
            "iterations": planned,
            "seconds": round(self.seconds, 2),
            "seconds_left": round(left, 1),
            "loss": loss,
            "psnr": self.psnr,
            "ssim": self.ssim,
            "curve": self.curve,
            "next_minute_db": next_minute(self.curve),
            "gaussians": len(self.cloud),
            "iterations_per_second": round(speed, 2),
        }

    def scored(self, images: Sequence[TrainingImage]) -> list[ViewScore]:
        """Scores of photographs in what the run has learned so far: on the CPU where the card has too little memory,
        and no numbers where memory does not reach there either."""
        degree, backend = self.settings.sh_degree, self.settings.backend
        found = within_memory(lambda: score_views(self.cloud, images, degree, backend, self.simulated))
        if found is None:
            cloud, simulated = self.cloud.to(CPU), deepcopy(self.simulated).to(CPU)
            found = within_memory(lambda: score_views(cloud, images, degree, "auto", simulated))
        self.relief.unscored |= found is None
        nothing = float("nan")
        return found or [ViewScore(image.camera.name, nothing, nothing, nothing, 0) for image in images]

    def validate(self, loss: float) -> None:
        """Score the validation views and log it. Test views are never looked at here."""
        started, seconds = time.monotonic(), self.seconds
        self.psnr, self.ssim = mean_score(self.scored(self.validation))
        self.curve.append((round(self.clock.fraction, 4), round(seconds, 2), self.psnr))
        if self.budget:
            each = (time.monotonic() - started) / len(self.validation)
            self.budget.held_out = each * (len(self.validation) + len(self.test))
        if self.recipe.dropout:
            looked_at = self.training[:: -(-len(self.training) // LOOKED_AT)]
            self.training_psnr = mean_score(self.scored(looked_at))[0]
            self.dropout = dropout_rate(self.training_psnr, self.psnr, self.recipe.dropout)
        self.run.log(
            {
                "iteration": self.iteration,
                "seconds": round(seconds, 3),
                "loss": loss,
                "training_psnr": self.training_psnr,
                "psnr": self.psnr,
                "ssim": self.ssim,
                "gaussians": len(self.cloud),
                "ms": round(1000 * seconds / max(1, self.iteration), 2),
            }
        )

    def finish(self, loss: float, interrupted: bool) -> Event:
        """Write results and figures; returns the result event."""
        seconds, left_out = self.seconds, self.dropout
        if self.validation and self.iteration:
            self.validate(loss)
        splats = self.cloud.to_splats()
        if self.guidance:
            self.guidance.write(self.run.path, splats, self.scene.up.tolist(), self.cloud)
        else:
            write_ply(self.run.ply, splats)
            write_glb(self.run.glb, splats, self.scene.up)
        scores = self.scored(self.test)
        test_psnr, test_ssim = mean_score(scores)
        learned = dropout_note(left_out, self.training_psnr, self.psnr)
        self.notes += filter(None, [self.moving_note, learned, self.guard.note(self.iteration), self.relief.note])
        metrics: Event = {
            "test_psnr": test_psnr,
            "test_ssim": test_ssim,
            "control_psnr": median_control(self.training, self.test),
            "psnr": self.psnr,
            "ssim": self.ssim,
            "iteration": self.iteration,
            "iterations": self.clock.planned(self.iteration),
            "gaussians": len(self.cloud),
            "seconds": round(seconds, 2),
            "ledger": self.ledger.milliseconds(),
            "interrupted": interrupted,
            "background": self.background(),
            "water": self.water_note,
            **self.effect_figures(),
            "notes": self.notes,
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
            write_json(self.run.water, self.medium.to_json(self.settings.metres_per_unit))
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
        open_water = isinstance(self.medium, Medium) and self.medium.veil is not None
        color = torch.zeros(3) if open_water else self.cloud.background.detach().sigmoid()
        return [round(value, 6) for value in color.tolist()]

    # -- checkpoints --------------------------------------------------------------------------------------------------

    def save(self) -> None:
        path = save_checkpoint(self.run.path, self.iteration, *self.state())
        self.on_event({"event": "checkpoint", "path": str(path)})

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All that `load` needs to go on from here, in the CPU's memory, not shared with what goes on."""
        tensors = {f"cloud.{name}": tensor for name, tensor in self.cloud.parameters().items()}
        tensors |= self.effect_tensors() | self.optimizer.state_tensors() | self.guard.tensors()
        tensors |= {"growth.gradient": self.statistics.gradient, "growth.views": self.statistics.views}
        state = self.effect_state() | {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "clock": asdict(self.clock),
            "curve": list(self.curve),
            "spent": time.monotonic() - self.budget.started if self.budget else 0.0,
            "start_count": self.start_count,
            "psnr": self.psnr,
            "ssim": self.ssim,
            "dropout": self.dropout,
            "guard": self.guard.state(),
            "relief": asdict(self.relief),
        }
        return {name: tensor.detach().to(CPU, copy=True) for name, tensor in tensors.items()}, state

    def load(self, tensors: dict[str, Tensor], state: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        simulated = self.load_effects(tensors, state)
        self.optimizer = Optimizer(cloud_from_tensors(tensors).to(self.device), simulated, self.settings.backend)
        self.optimizer.load_state(tensors)
        self.guard.load(state["guard"], tensors, self.optimizer)
        self.relief = Relief(**state["relief"])
        sums = (tensors[name].to(self.device, copy=True) for name in ("growth.gradient", "growth.views"))
        self.statistics = GrowthStatistics(*sums)
        self.iteration, self.clock = state["iteration"], Clock(**state["clock"])
        self.curve = [tuple(point) for point in state["curve"]]
        self.start_count, self.psnr, self.ssim = state["start_count"], state["psnr"], state["ssim"]
        self.dropout = state["dropout"]

    def resume(self, longer: bool = False) -> None:
        """Go on from the newest checkpoint; from the start when the run was stopped before its first.

        longer: the run goes on past the end that it was planned to have.
        """
        loaded = load_checkpoint(self.run.path)
        if loaded is None:
            self.run.log_until(0)
            return
        tensors, state = loaded
        planned = self.clock
        self.load(tensors, state)
        if not self.cloud.features.shape[1]:  # the run began without regions
            self.guidance = None
        self.seconds_before = state["seconds"]
        if longer:
            self.clock = Clock(self.iteration + self.budget.iterations) if self.budget else planned
        elif self.budget:
            self.budget.started -= state["spent"]
        self.clock.advance(self.iteration)
        self.run.log_until(self.iteration)


def cloud_from_tensors(tensors: dict[str, Tensor]) -> GaussianCloud:
    """The cloud of a checkpoint's tensors."""
    prefix = "cloud."
    return GaussianCloud(**{name[len(prefix) :]: t.clone() for name, t in tensors.items() if name.startswith(prefix)})
