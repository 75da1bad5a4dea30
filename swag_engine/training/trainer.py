"""Training: from a COLMAP scene to a run folder."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from ..base.errors import InputError, remedy
from ..base.files import locked_folder
from ..base.timing import Ledger, part
from ..evaluation.metrics import (
    ViewScore,
    in_8_bits,
    mean_score,
    median_image_psnr,
    score_image,
    score_views,
)
from ..evidence.noise import estimate_noise
from ..formats.ply import write_ply
from ..formats.run_folder import RunFolder, write_json
from ..gaussians.cloud import GaussianCloud, to_numpy
from ..gaussians.densify import PER_GAUSSIAN
from ..gaussians.init import gaussians_from_points
from ..kernels.backends import KERNELS
from ..kernels.hardware import hardware_of, with_backend_of_run
from ..kernels.webgpu import WebGpuKernels
from ..planning.plan import write_plan
from ..rendering.haze import describe_haze, haze_score, without_haze
from ..rendering.model import SceneModel
from ..rendering.restoration import (
    CONFIDENCE,
    WIDTH,
    RestorationLimit,
    describe_restored,
    restoration_limit,
)
from ..rendering.restored_photo import fit_to_photos, photos_to_fit
from ..scene.colmap import Points, Scene, load_scene
from ..scene.compression import small_jpeg_note
from ..scene.images import TrainingImage
from ..semantics.embed import DIMENSIONS
from ..settings.jerlov import water_of_type
from ..settings.settings import TrainSettings
from ..splats.haze import HAZE
from ..water.medium import MAX_DEGREE, Medium
from .checkpoint import load_checkpoint, save_checkpoint
from .densification import Densification
from .dropout import SCORED_IMAGES, dropout_note, dropout_rate
from .effect_selection import EffectSelection
from .guard import Guard, finite_part
from .guidance import Guidance, find_guidance
from .inputs import Event, load_inputs
from .motion import MotionMasks, find_motion
from .native_step import NativeStep
from .network_priors import depth_of_images, interpolated_frames
from .optimizer import EPS
from .pacing.budget import Budget, fit_budget
from .pacing.clock import FLAT_DB, FLAT_FRACTION, Clock, is_flat, next_minute
from .pacing.memory import TOO_LITTLE, Relief, fit_memory, none_if_out_of_memory, reduced
from .pacing.pacer import Pacer
from .pacing.preset_size import fit_preset, limit_gaussians
from .pacing.speed import Extent
from .run_plan import plan_of_run
from .schedule import SETTLED_BY, STANDARD, Schedule
from .state import CPU, RunState
from .step import GEOMETRY, AutogradStep, Step, StepConfig
from .target_cache import Targets
from .trials import run_trials, trials_due
from .water_fit import fit_again
from .webgpu_step import WebGpuStep, leave_card
from .whole import Whole

T = TypeVar("T")
InitialCloud = Callable[[Points, int, int, int, np.ndarray], GaussianCloud]

PREVIEWED = ("means", "quats", "log_scales", "opacity_logits", "sh0")
"""Parameters of the Gaussians that a preview shows."""
LIMITING_COST, FITTING_COST = 3, 11
"""Time in which colors are limited by a photo and fitted to one, at most WIDTH pixels wide, over that of scoring one of
that size."""
MOST_LOST_BY_FIT = 2.0
"""Mean loss of the validation images' PSNR, dB, up to which the last fit of the water is kept."""
PROGRESS_SECONDS = 0.2
"""Seconds between two `progress` events."""
EVALUATION_STOPPED = "The evaluation was stopped before its end: there are no figures of the test photos."


class EvaluationStopped(Exception):
    """The user stopped the evaluation at the end of a run."""


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
    should_stop_now: Callable[[], bool] = lambda: False,
) -> Event:
    """Train a scene to a run folder.

    Args:
        scene_folder: Folder of the scene: images and a COLMAP model.
        out: Folder of the run.
        settings: What the user chose.
        resume: Continue the run in `out` from its newest checkpoint with the settings it was started with, bit-equal
            to a run that never stopped (same machine, same backend) unless time limits it or the backend is "wgpu",
            whose sums differ from run to run. With more iterations or a time budget, a finished run continues for so
            long.
        on_event: Gets `progress`, `preview` and `checkpoint` events as they happen.
        should_stop: Asked between two iterations. It may wait, which pauses the run; when it returns true the run
            ends, with everything written and "interrupted" true in the result.
        preview: Write splats for a live preview every few seconds.
        weights_dir: Folder where networks are looked for before the user's cache.
        started: time.monotonic() that a time budget counts from, now without it.
        should_stop_now: Asked during the evaluation at the end, between two images; when it returns true, all files are
            written without figures of the test images, and "evaluation_stopped" is true in the metrics.

    Returns:
        The `result` event.

    Raises:
        InputError: For anything wrong with the scene, the folder or the disk.
    """
    started = time.monotonic() if started is None else started
    with locked_folder(out):
        trainer = make_trainer(RunFolder(out), scene_folder, settings, resume, on_event, weights_dir, started)
        return trainer.run_to_end(should_stop, preview, should_stop_now)


def make_trainer(
    run: RunFolder,
    scene_folder: Path,
    settings: TrainSettings,
    resume: bool,
    on_event: Callable[[Event], None],
    weights_dir: Path | None,
    started: float,
    schedule: Schedule = STANDARD,
    initial_cloud: InitialCloud = gaussians_from_points,
    part: Scene | None = None,
    whole: Whole | None = None,
) -> "Trainer":
    """Create a trainer for a new run, or restore one from its last checkpoint.

    Arguments and errors are the same as for `train` and `Trainer`.

    With `part`, that part of the scene in the folder is trained, and nothing else of it is read.
    """
    longer = False
    if resume:
        if not run.config.exists():
            raise InputError(
                f"There is no run in {run.path} to continue: {remedy('start one without --resume', 'press Train')}."
            )
        settings, longer = run.resumed_settings(scene_folder, settings)
    elif run.config.exists():
        raise InputError(
            f"{run.path} holds a training run already; "
            f"{remedy('continue it with --resume or choose another folder', 'choose another Output Folder')}."
        )
    scene = part or load_scene(scene_folder)
    if not resume:
        settings = with_scale_of(scene, settings)
    chosen = settings.backend
    settings, backend_note = with_backend_of_run(settings, resume)
    asked = fit_preset(scene, settings)
    fitted = _or_on_cpu(asked.backend, lambda: fit_budget(scene, asked, started, schedule.closing_seconds))
    if not fitted:
        raise InputError(TOO_LITTLE)
    settings, budget = fitted
    notes = []
    if not resume:
        if not part:  # the Gaussians of a part are its share of the whole
            settings, pixels_note = limit_gaussians(scene, settings)
            notes.append(pixels_note)
        settings, memory_note = fit_memory(Extent.of(scene), settings, hardware_of(settings).free_memory())
        notes.append(memory_note)
    run.write_config(scene.folder, replace(settings, backend=chosen), scene.up.tolist(), asdict(hardware_of(settings)))
    try:
        trainer = _or_on_cpu(
            settings.backend,
            lambda: Trainer(
                scene, run, settings, on_event, weights_dir, budget, resume, schedule, initial_cloud, whole
            ),
        )
        if not trainer:
            raise InputError(TOO_LITTLE)
        trainer.notes += filter(None, [*notes, backend_note])
    except InputError:
        if not resume:
            run.discard()
        raise
    if resume:
        trainer.resume(longer)
    return trainer


def _or_on_cpu(backend: str, compute: Callable[[], T]) -> T | None:
    """Return what `compute` returns, without the card where that has too little memory; None where memory runs out."""
    found = none_if_out_of_memory(compute)
    return none_if_out_of_memory(compute) if found is None and leave_card(backend) else found


def with_scale_of(scene: Scene, settings: TrainSettings) -> TrainSettings:
    """Return settings with the scene's measured scale where they have none.

    Raises:
        InputError: If the water is one per metre, and neither has a scale.
    """
    settings = replace(settings, metres_per_unit=settings.metres_per_unit or scene.metres_per_unit)
    if settings.water_type != "auto":
        water_of_type(settings.water_type, settings.metres_per_unit)
    return settings


class Trainer:
    """Trains one run.

    Args:
        scene: The scene.
        run: The run's folder; its config.json is written.
        settings: Settings with all sizes filled in.
        on_event: Gets events as they happen.
        weights_dir: Folder where networks are looked for first.
        budget: The time budget, if there is one.
        resume: Whether the run continues; then `resume` is called next.
        schedule: When things happen, and the learning rates.
        initial_cloud: Makes the Gaussians that a new run starts from; called as `gaussians_from_points` is.
        whole: Model of a larger scene, of which this is a part.

    Attributes:
        inputs: What never changes during the run.
        state: All that changes.
        step: Makes one optimisation step.
        densification: Adds, drops and relocates Gaussians.
        guard: Accepts steps and rolls back.
        pacer: Measures time.
        selection: Effects of the run.
        targets: Images at the size that is trained at.
        notes: Sentences for the user.
    """

    def __init__(
        self,
        scene: Scene,
        run: RunFolder,
        settings: TrainSettings,
        on_event: Callable[[Event], None],
        weights_dir: Path | None,
        budget: Budget | None = None,
        resume: bool = False,
        schedule: Schedule = STANDARD,
        initial_cloud: InitialCloud = gaussians_from_points,
        whole: Whole | None = None,
    ) -> None:
        self.run, self.on_event, self.whole = run, on_event, whole
        self._should_stop_now: Callable[[], bool] = lambda: False
        self.notes: list[str] = []
        self.training_psnr: float | None = None
        self.overfitting = ""
        self.pacer = Pacer(budget)
        inputs = self.inputs = load_inputs(scene, settings, schedule, on_event)
        self.notes += inputs.notes
        self.ledger = Ledger(torch.cuda.synchronize if inputs.device.type == "cuda" else None)
        cloud = (whole and whole.start) or initial_cloud(
            scene.points, settings.max_gaussians, settings.sh_degree, settings.seed, inputs.median_color()
        )
        start_count = len(cloud)
        plan = whole.plan if whole else plan_of_run(inputs, run.plan, weights_dir, resume)
        if plan:
            on_event({"event": "plan", "plan": plan.to_json()})
            write_plan(run.plan, plan)
        self.selection = EffectSelection(inputs, plan, whole)
        choices = self.selection.initial_choices()
        recipe = self.selection.recipe(choices)
        effects = self.selection.initial_effects(recipe, cloud)
        cloud = finite_part(cloud)
        depth: dict[str, np.ndarray] = {}
        frames: list[TrainingImage] = []
        if "attenuation" in recipe.effects and not whole:
            self.notes += filter(None, [small_jpeg_note(scene, [image.camera for image in inputs.training])])
        if "depth_prior" in recipe.effects:
            note, depth = depth_of_images(scene, inputs.training, weights_dir)
            self.notes.append(note)
        if "interpolation" in recipe.effects:
            note, frames = interpolated_frames(scene, inputs.training, weights_dir)
            self.notes.append(note)
        guidance: Guidance | None = None
        if recipe.uses_regions and whole:
            self.notes.append("Labels are not learned in parts of a survey: label the merged result.")
        elif recipe.uses_regions:
            note, guidance = find_guidance(scene, inputs.training, recipe, settings, weights_dir)
            self.notes.append(note)
            cloud.features = cloud.means.new_zeros(len(cloud), DIMENSIONS if guidance else 0)
        iterations = settings.iterations or (budget.iterations if budget else 1)
        if whole:
            cloud.background = whole.surroundings.background
            cloud = cloud.followed_by(whole.surroundings)
        model, fixed = SceneModel(cloud.to(inputs.device), effects), len(whole.surroundings) if whole else 0
        self.state = RunState.initial(model, recipe, choices, iterations, start_count, settings.backend, fixed)
        self.guard = Guard(iterations)
        self.targets = Targets(inputs, depth, frames, guidance)
        self._act_on(guidance)

    def _act_on(self, guidance: Guidance | None) -> None:
        self.guidance = guidance
        otherwise = AutogradStep(self.inputs, self.selection, guidance)
        native = NativeStep(self.inputs, self.selection, otherwise)
        kernels = KERNELS.get(self.inputs.settings.backend)
        self.step: Step = native
        if isinstance(kernels, WebGpuKernels):
            self.step = WebGpuStep(self.inputs, self.selection, native, kernels)
        self.densification = Densification(self.inputs, self.selection, self.targets, guidance)

    # -- the run ------------------------------------------------------------------------------------------------------

    def run_to_end(
        self, should_stop: Callable[[], bool], preview: bool, should_stop_now: Callable[[], bool] = lambda: False
    ) -> Event:
        """Train until the end or a stop, write all files and return the `result` event; arguments as of `train`."""
        schedule, pacer, self._should_stop_now = self.inputs.schedule, self.pacer, should_stop_now
        pacer.start(self.state.iteration)
        saved = shown = reported = time.monotonic()
        validations = self._validations_due
        interrupted = False
        loss = math.nan
        while not (self.state.clock.done or self.state.guarded.training_failed):
            with pacer.pause():
                interrupted = should_stop()
            if interrupted:
                break
            if due := trials_due(self.state, self.selection.to_try):
                with pacer.outside_plan():
                    interrupted = not self._try_effects(due, should_stop)
                if interrupted:
                    break
                continue
            with self.ledger.iteration():
                loss = self.iterate()
            state = self.state
            if self.inputs.validation and self._validations_due > validations and not state.clock.done:
                validations = self._validations_due
                self._validate(loss)
                if self.inputs.settings.stop_when_flat:
                    self._finish_when_flat()
            pacer.replan(state.clock, state.iteration)
            now = time.monotonic()
            if now - reported > PROGRESS_SECONDS or state.clock.done:
                reported = now
                self.on_event(self._progress(loss))
            if preview and now - shown > schedule.preview_seconds:
                self._write_preview()
                shown = time.monotonic()
            if now - saved > schedule.checkpoint_seconds:
                self.save()
                saved = time.monotonic()
        self.state.synchronize()
        self.guard.check_result(self.state.guarded, self.state.optimizer)
        self.save()  # before anything that takes long: whoever stops a run may not wait for it
        limit: RestorationLimit | None = None
        haze: torch.Tensor | None = None
        scores: list[ViewScore] | None = None
        seconds = pacer.seconds
        if interrupted:  # all that can be opened, should the process be killed before the end
            self._write_splats(None, None)
            self._write_metrics(interrupted, None, seconds)
        with suppress(EvaluationStopped):
            haze = none_if_out_of_memory(self._haze)
            limit = none_if_out_of_memory(lambda: self._restoration_limit(haze)) if self._restores else None
            self.save(limit, haze)
            seconds = pacer.seconds
            scores = self._evaluate(loss)
        return self._finish(interrupted, limit, haze, scores, seconds)

    def iterate(self) -> float:
        """Make one iteration and return its loss; one that runs out of memory is abandoned and the run reduced.

        A run on a card that cannot be reduced any further continues on the processor, with images of full size.
        """
        if (loss := none_if_out_of_memory(self._iterate)) is not None:
            return loss
        state = self.state
        state.optimizer.restart(state.guarded.last_good)
        if state.relief.exhausted and leave_card(self.inputs.settings.backend):
            state.relief = Relief()
            return math.nan
        state.replace_free(*reduced(state.free_cloud))
        state.guarded.keep(state.optimizer)
        state.relief.relieve(state.free_count)
        self.targets.clear()
        return math.nan

    def _iterate(self) -> float:
        state = self.state
        if self.selection.fits_water(state):
            self._fit_water()
        config = self.step_config()
        target = self.targets.next(state, config.fraction)
        with_water = config.with_water and state.effects.medium is not None
        phase = f"[{self.targets.factor}] {with_water} {config.stage_two} {state.dropout > 0} {state.water_final}"
        result = self.step(state, target, replace(config, phase="" if target.interpolated else phase))
        state.iteration += 1
        state.clock.advance(state.iteration)
        densifies = not config.stage_two and self.densification.due(state)
        if densifies:
            state.synchronize()
        if not result.problem:
            if result.means2d_gradient is not None and result.radii is not None and not target.interpolated:
                state.statistics.add(result.means2d_gradient, result.radii, target.camera.width)
            if densifies:
                rate, fraction = config.learning_rates["means"], state.clock.fraction
                self.densification.after_step(state, rate, self._sh_degree(fraction), self._water_degree(fraction))
                # With densification, so that Gaussians on a device are read for both at once.
                if "moving_objects" in state.recipe.effects and state.motion.search_due(fraction):
                    self._mask_motion()
        if self.guard.roll_back_if_bad(state.guarded, state.optimizer, state.iteration, state.on_device):
            state.reset_statistics()
        return result.loss

    def _fit_water(self) -> None:
        """Fit water and lamp once more and keep them; as learned where memory does not suffice or validation fails.

        Validation images get much worse where the fit takes something for water that is none, such as a lamp that the
        run does not have.
        """
        state, inputs = self.state, self.inputs
        state.synchronize()
        state.water_final = True
        state.guarded.keep(state.optimizer)
        model, photos = SceneModel(state.cloud, state.effects), {view.name: view.path for view in inputs.scene.views}
        degree, backend = inputs.settings.sh_degree, inputs.settings.backend
        before = mean_score(self._scores(inputs.validation, state.cloud))[0]
        with part("water"):
            none_if_out_of_memory(lambda: fit_again(model, inputs.training, photos, degree, backend))
        loss = before - mean_score(self._scores(inputs.validation, state.cloud))[0]
        if loss > MOST_LOST_BY_FIT:
            state.optimizer.restart(state.guarded.last_good)
            self.notes.append(
                f"The last fit of the water was left out: validation images were {loss:.1f} dB worse with it. Perhaps "
                "the scene has a lamp that the run does not have (--effects lamp=on)."
            )
        state.guarded.keep(state.optimizer)

    def step_config(self) -> StepConfig:
        """Return what the schedule says about the next iteration."""
        fraction, recipe = self.state.clock.fraction, self.state.recipe
        return StepConfig(
            fraction=fraction,
            sh_degree=self._sh_degree(fraction),
            water_degree=self._water_degree(fraction),
            with_water=self.whole is not None or fraction >= recipe.water_from,
            stage_two=fraction >= recipe.stage_two_from,
            learning_rates=self._learning_rates(fraction),
            epsilon=max(EPS, self.inputs.schedule.hardly_shown / self.inputs.values),
        )

    def _sh_degree(self, fraction: float) -> int:
        joined = sum(fraction >= start for start in self.inputs.schedule.sh_degrees)
        return min(self.inputs.settings.sh_degree, joined)

    def _water_degree(self, fraction: float) -> int:
        return MAX_DEGREE if self.whole or fraction >= self.state.recipe.B_inf_degrees_from else 0

    def _learning_rates(self, fraction: float) -> dict[str, float]:
        """Adam's step size by parameter name, `fraction` (0..1) of the way through the run."""
        state = self.state
        rates = asdict(self.inputs.schedule.learning_rates)
        end = rates.pop("means_end")
        rates["means"] *= (end / rates["means"]) ** fraction * self.inputs.median_range
        # Otherwise long runs move the means to where they overfit single images.
        rates["means"] *= min(1.0, math.sqrt(SETTLED_BY / max(1, state.clock.iterations)))
        if fraction >= state.recipe.stage_two_from:
            rates = {name: rate for name, rate in rates.items() if name not in GEOMETRY}
        else:
            falling = 0.5 * (1 + math.cos(math.pi * fraction))
            rates |= {name: falling * rate for name, rate in self.selection.learning_rates(state).items()}
        if self.whole:
            rates.pop("background", None)
        return {name: state.guarded.record.rate_factor * rate for name, rate in rates.items()}

    def _mask_motion(self) -> None:
        state, settings = self.state, self.inputs.settings
        masks = find_motion(state.cloud, state.effects, self.inputs.training, settings.sh_degree, settings.backend)
        state.motion = MotionMasks(masks, state.motion.searches + 1)

    # -- trials -------------------------------------------------------------------------------------------------------

    def _try_effects(self, due: Sequence[str], should_stop: Callable[[], bool]) -> bool:
        """Try effects in forks of the run. False where that was stopped: the run is then as it was before."""
        before = self.state

        def score_after(fork: RunState, iterations: int) -> Sequence[ViewScore] | None:
            self.state = fork
            for _ in range(iterations):
                if should_stop():
                    return None
                self.iterate()
            fork.synchronize(())
            return self._scores(self.inputs.validation, fork.cloud)

        best = run_trials(before, due, self._copied, self.selection.switch, score_after)
        self.state = best or before
        return best is not None

    def _copied(self, state: RunState) -> RunState:
        return self._restored(*state.to_checkpoint())

    def _restored(self, tensors: dict[str, torch.Tensor], stored: Event) -> RunState:
        inputs = self.inputs
        return RunState.from_checkpoint(
            tensors, stored, self.selection.recipe, inputs.training, inputs.device, inputs.settings.backend
        )

    # -- validation and progress --------------------------------------------------------------------------------------

    @property
    def _validations_due(self) -> int:
        """How many validations the run should have had by now."""
        return int(self.state.clock.fraction / self.inputs.schedule.validate_every + 1e-6)

    def _finish_when_flat(self) -> None:
        """Skip to the last stage once the curve is flat and the Gaussians have had time to settle."""
        clock, recipe = self.state.clock, self.state.recipe
        last = recipe.stage_two_from
        if recipe.densify_until + FLAT_FRACTION <= clock.fraction < last and is_flat(self.state.curve):
            self.notes.append(
                f"Finished early: the last {FLAT_FRACTION:.0%} of the run gained less than {FLAT_DB} dB in validation."
            )
            self.pacer.finish_early(clock, self.state.iteration, last)

    def _progress(self, loss: float) -> Event:
        state, settings = self.state, self.inputs.settings
        return {
            "event": "progress",
            "stage": "train",
            "iteration": state.iteration,
            "iterations": state.clock.planned(state.iteration),
            "seconds": round(self.pacer.seconds, 2),
            "seconds_left": round(self.pacer.seconds_left(state.clock, state.iteration), 1),
            "loss": loss,
            "psnr": state.psnr,
            "ssim": state.ssim,
            "curve": state.curve,
            "next_minute_db": next_minute(state.curve),
            "gaussians": state.free_count,
            "max_gaussians": min(settings.max_gaussians, state.relief.most or settings.max_gaussians),
            "width": settings.width,
            "iterations_per_second": round(self.pacer.iterations_per_second(state.iteration), 2),
        }

    def _write_preview(self) -> None:
        self.state.synchronize(PREVIEWED)
        state = self.state
        write_ply(self.run.preview, state.free_cloud.to_splats(sh_degree=0))
        water = state.effects.medium.to_json() if state.effects.medium else None  # per scene unit
        shown = {"path": str(self.run.preview), "water": water, "background": self._background()}
        self.on_event({"event": "preview", "iteration": state.iteration} | shown)

    @torch.no_grad()
    def _scores_on_device(self, images: Sequence[TrainingImage]) -> list[ViewScore]:
        """Score images where steps have left the Gaussians on a device; empty where they have not, or it failed."""
        scores = []
        for image in images:
            device, name = self.state.on_device, image.camera.name
            color = device.render(image.camera, self.inputs.settings.sh_degree) if device else None
            if color is None:
                return []
            scores.append(score_image(image, in_8_bits(self.state.effects.apply_to_image(color, name))))
        return scores

    def _scores(self, images: Sequence[TrainingImage], cloud: GaussianCloud) -> list[ViewScore]:
        """Score images; on the CPU where the card has too little memory, with NaN where no memory suffices."""
        state, settings = self.state, self.inputs.settings
        degree, backend = settings.sh_degree, settings.backend
        found = none_if_out_of_memory(
            lambda: self._scores_on_device(images) or score_views(cloud, images, degree, backend, state.effects)
        )
        if found is None:
            state.synchronize(PER_GAUSSIAN)
            on_cpu, effects = cloud.to(CPU), deepcopy(state.effects).to(CPU)
            found = none_if_out_of_memory(lambda: score_views(on_cpu, images, degree, "auto", effects))
        state.relief.unscored |= found is None
        return found or [ViewScore(image.camera.name, math.nan, math.nan, math.nan, 0) for image in images]

    def _validate(self, loss: float) -> None:
        """Score the validation images and log the result. Test images are never scored here."""
        self.state.synchronize(())
        state, inputs = self.state, self.inputs
        started, seconds = time.monotonic(), self.pacer.seconds
        state.psnr, state.ssim = mean_score(self._scores(inputs.validation, state.cloud))
        state.curve.append((round(state.clock.fraction, 4), round(seconds, 2), state.psnr))
        if budget := self.pacer.budget:
            each = (time.monotonic() - started) / len(inputs.validation)
            pixels = min(1.0, WIDTH / inputs.training[0].camera.width) ** 2
            training = inputs.training
            restoring = LIMITING_COST * len(training) + FITTING_COST * len(photos_to_fit(training))
            restored = pixels * restoring if self._restores else 0
            budget.held_out = each * (len(inputs.validation) + len(inputs.test) + restored)
        if state.recipe.dropout:
            scored = inputs.training[:: -(-len(inputs.training) // SCORED_IMAGES)]
            self.training_psnr = mean_score(self._scores(scored, state.cloud))[0]
            state.dropout = dropout_rate(self.training_psnr, state.psnr, state.recipe.dropout)
        self.run.log(
            {
                "iteration": state.iteration,
                "seconds": round(seconds, 3),
                "loss": loss,
                "training_psnr": self.training_psnr,
                "psnr": state.psnr,
                "ssim": state.ssim,
                "gaussians": state.free_count,
                "ms": round(1000 * seconds / max(1, state.iteration), 2),
            }
        )

    # -- results ------------------------------------------------------------------------------------------------------

    @property
    def _restores(self) -> bool:
        """Whether restored colors are limited; recipes with water on display values stay as their papers have them."""
        medium = self.state.effects.medium
        return isinstance(medium, Medium) and medium.light == "linear"

    def _haze(self) -> torch.Tensor:
        state, inputs = self.state, self.inputs
        model = SceneModel(state.cloud, state.effects)
        score = haze_score(model, inputs.training, inputs.scene, inputs.settings.backend)
        self.notes += filter(None, [describe_haze(score)])
        return score

    def _restoration_limit(self, haze: torch.Tensor | None) -> RestorationLimit:
        state, inputs = self.state, self.inputs
        medium = state.effects.medium
        assert isinstance(medium, Medium)
        noise = (self.whole and self.whole.noise) or estimate_noise(inputs.training, inputs.scene.views)
        colors = self.whole.colors if self.whole else None
        cameras = self._steps("Restored colors: photo", [image.camera for image in inputs.training])
        limit, restored, _ = restoration_limit(
            state.cloud, cameras, medium, noise, state.effects.lamp, inputs.settings.backend, colors, haze
        )
        self.notes += filter(None, [describe_restored(restored)])
        photos = self._steps("Comparison with restored photo", list(photos_to_fit(inputs.training)))
        static = map(state.motion.static_pixels, photos)
        model = SceneModel(state.cloud, state.effects)
        return fit_to_photos(model, limit, static, noise, inputs.settings.sh_degree, haze)

    def _steps(self, what: str, steps: Sequence[T]) -> Iterator[T]:
        """Iterate over parts of the evaluation at the end with a `progress` event for each.

        Raises:
            EvaluationStopped: When the user asks for it.
        """
        for number, step in enumerate(steps, 1):
            if self._should_stop_now():
                raise EvaluationStopped
            text = f"{what} {number} of {len(steps)}"
            self.on_event(
                {"event": "progress", "stage": "evaluate", "text": text, "iteration": number, "iterations": len(steps)}
            )
            yield step

    def _evaluate(self, loss: float) -> list[ViewScore]:
        """Score validation images, where there are any, and test images, and return the scores of these."""
        inputs, dropped = self.inputs, self.state.dropout
        if self._should_stop_now():
            raise EvaluationStopped
        if inputs.validation and self.state.iteration:
            self._validate(loss)
        self.overfitting = dropout_note(dropped, self.training_psnr, self.state.psnr)
        images = self._steps("Evaluating test photo", inputs.test)
        return [score for image in images for score in self._scores([image], self.state.cloud)]

    def _finish(
        self,
        interrupted: bool,
        limit: RestorationLimit | None,
        haze: torch.Tensor | None,
        scores: list[ViewScore] | None,
        seconds: float,
    ) -> Event:
        """Write results and figures, and return the `result` event; arguments as of `_write_metrics`."""
        state, inputs = self.state, self.inputs
        self._write_splats(limit, haze)
        guard_note = self.guard.note(state.guarded, state.iteration)
        kernels = KERNELS.get(inputs.settings.backend)
        failure = kernels.failure if isinstance(kernels, WebGpuKernels) else ""
        self.notes += filter(None, [state.motion.note, guard_note, state.relief.note, failure])
        metrics = self._write_metrics(interrupted, scores, seconds)
        self.run.log({name: metrics[name] for name in ("iteration", "seconds", "test_psnr", "test_ssim")})
        if state.effects.medium:
            write_json(self.run.water, state.effects.medium.to_json(inputs.settings.metres_per_unit))
        self.run.preview.unlink(missing_ok=True)
        return {
            "event": "result",
            "request": "train",
            "run": str(self.run.path),
            "ply": str(self.run.ply),
            "metrics": metrics,
            "interrupted": interrupted,
        }

    def _write_splats(self, limit: RestorationLimit | None, haze: torch.Tensor | None) -> None:
        state, up = self.state, self.inputs.scene.up
        cloud = without_haze(limit.apply(state.cloud) if limit else state.cloud, haze)
        splats = cloud.rows(slice(state.free_count)).to_splats()
        x, y, z = self.inputs.scene.origin.tolist()
        splats.origin = x, y, z
        if haze is not None and haze.any():
            splats.extras[HAZE] = to_numpy(haze[: state.free_count])
        if limit:
            splats.extras[CONFIDENCE] = to_numpy(limit.least_confidence[: state.free_count])
        if self.guidance:
            self.guidance.write(self.run.path, splats, up.tolist(), state.cloud)
        else:
            self.run.write_result(splats, up)

    def _write_metrics(self, interrupted: bool, scores: list[ViewScore] | None, seconds: float) -> Event:
        """Write metrics.json.

        Args:
            interrupted: Whether the training was stopped.
            scores: Scores of the test images, None where the evaluation was stopped.
            seconds: Duration of the training.

        Returns:
            The metrics.
        """
        state, inputs = self.state, self.inputs
        test_psnr, test_ssim = mean_score(scores or [])
        metrics: Event = {
            "test_psnr": test_psnr,
            "test_ssim": test_ssim,
            "control_psnr": math.nan if scores is None else median_image_psnr(inputs.training, inputs.test),
            "psnr": state.psnr,
            "ssim": state.ssim,
            "iteration": state.iteration,
            "iterations": state.clock.planned(state.iteration),
            "gaussians": state.free_count,
            "seconds": round(seconds, 2),
            "ledger": self.ledger.milliseconds(),
            "interrupted": interrupted,
            "evaluation_stopped": scores is None,
            "background": self._background(),
            "water": self.selection.water.note,
            "effects": self.selection.switched_on(state),
            "trials": state.trials,
            "overfitting": self.overfitting,
            "notes": self.notes,
            "views": {score.name: {"psnr": score.psnr, "ssim": score.ssim} for score in scores or []},
        }
        self.run.write_metrics(metrics)
        return metrics

    def _background(self) -> list[float]:
        """Display color (3,) behind the Gaussians: black where the water that was there has been removed."""
        medium = self.state.effects.medium
        open_water = isinstance(medium, Medium) and medium.background_sh is not None
        color = torch.zeros(3) if open_water else self.state.cloud.background.detach().sigmoid()
        return [round(value, 6) for value in color.tolist()]

    # -- checkpoints --------------------------------------------------------------------------------------------------

    def save(self, limit: RestorationLimit | None = None, haze: torch.Tensor | None = None) -> None:
        """Write a checkpoint of the run.

        Args:
            limit: Limit of the restored colors, at the end of a run. It is beside the Gaussians and not applied to
                them, so that the run can continue.
            haze: (N,) how sure it is that a Gaussian is open water, at the end of a run.
        """
        state = self.state
        state.seconds, state.budget_spent = self.pacer.seconds, self.pacer.budget_spent
        tensors, stored = state.to_checkpoint()
        found = (limit.tensors() if limit else {}) | ({} if haze is None else {HAZE: haze.cpu()})
        path = save_checkpoint(self.run.path, state.iteration, tensors | found, stored)
        self.on_event({"event": "checkpoint", "path": str(path)})

    def resume(self, longer: bool = False) -> None:
        """Continue from the newest checkpoint; from the start when the run was stopped before its first.

        Args:
            longer: Whether the run continues past the end that it was planned to have.

        Raises:
            InputError: If no checkpoint can be read.
        """
        loaded = load_checkpoint(self.run.path)
        if loaded is None:
            self.run.log_until(0)
            return
        planned, budget = self.state.clock, self.pacer.budget
        state = self.state = self._restored(*loaded)
        if not state.cloud.features.shape[1]:  # the run began without regions
            self.targets.emphasis = None
            self._act_on(None)
        self.pacer.seconds_before = state.seconds
        if longer:
            state.clock = Clock(state.iteration + budget.iterations) if budget else planned
        elif budget:
            budget.started -= state.budget_spent
        state.clock.advance(state.iteration)
        self.run.log_until(state.iteration)
