"""The step on a GPU through WebGPU, where the Gaussians stay between the steps."""

import math
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any
from weakref import finalize

import numpy as np
import torch
from torch import Tensor

from ..base.timing import part
from ..gaussians.cloud import LOG_SCALE_LIMITS
from ..kernels.backends import KERNELS, automatic_backend
from ..kernels.protocol import TooManyPairs
from ..kernels.webgpu import WebGpuKernels
from ..kernels.webgpu_device import WebGpuFailure
from ..kernels.webgpu_training import (
    GAIN,
    LAMP,
    LINEAR,
    NUMBERS,
    OPEN,
    SIMILARITY,
    WATER,
    Outcome,
    ResidentGaussians,
    View,
    adam_fields,
)
from ..rendering.native_image import NativeImage, Shading
from ..rendering.render import DAZZLING, FARTHEST
from ..settings.settings import TrainSettings
from ..water.network import WaterNetwork
from .densification import strategy_of
from .effect_selection import EffectSelection
from .inputs import RunInputs
from .losses import LIKE_WATER, UNLIKE_WATER
from .native_step import Gain, compare, runs_natively
from .optimizer import BETAS, EPS, MOMENTS
from .state import RunState
from .step import GEOMETRY, Step, StepConfig, StepResult
from .targets import Target

RESIDENT = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
"""Parameters that are kept on the GPU, with their moments."""
RECIPES = ("swag", "3dgs")
"""Recipes that are trained on a GPU through WebGPU."""
COMPARED = ("means", "log_scales", "opacity_logits", "sh0")
"""Parameters whose gradients in the first step are compared with the CPU's; that of quats is 0 for round Gaussians."""
DIFFERENCE = 0.02
"""Largest relative difference of a gradient from the CPU's; by rounding, they differ by .0002."""
COEFFICIENTS, TAU, UNIT_RANGE, GAINS = 33, 33, 34, 35
"""How many coefficients the water has, and places of the other numbers, as in medium.wgsl."""


def with_backend_of_run(settings: TrainSettings, resume: bool) -> tuple[TrainSettings, str]:
    """Choose what computes: "auto" takes a graphics card through WebGPU where its recipe and the machine allow it.

    Args:
        settings: What the user chose.
        resume: Whether the run continues, which it does without the card that it began on.

    Returns:
        The settings, and a sentence for the user where a run on "wgpu" is computed on the processor.
    """
    if settings.backend == "auto" and settings.recipe in RECIPES and automatic_backend() == "wgpu":
        return replace(settings, backend="wgpu"), ""
    if settings.backend == "wgpu" and settings.recipe not in RECIPES:
        note = (
            f"The recipe {settings.recipe} does not run on the backend wgpu, which has {' and '.join(RECIPES)}: this "
            "run was computed on the processor."
        )
        return replace(settings, backend="cpu"), note
    if settings.backend == "wgpu" and resume and (reason := KERNELS["wgpu"].unavailable_reason()):
        return replace(settings, backend="cpu"), f"The run was continued on the processor: {reason}"
    return settings, ""


class WebGpuStep:
    """The step through WebGPU of recipes that compare colors only, where `runs_natively` says so.

    Gaussians, moments and what densification goes by are on the GPU until `RunState.synchronize` is called. The few
    numbers of water, lamp, gains and background are on the CPU, with graphs of their own. When the GPU fails, the run
    goes on without it from what was synchronised last; so it does when the gradients of the first step are not those of
    the CPU.

    Args:
        inputs: Images and settings of the run.
        selection: Gives the loss of the recipe that the state has.
        otherwise: Makes all other steps.
        kernels: The backend.
    """

    def __init__(self, inputs: RunInputs, selection: EffectSelection, otherwise: Step, kernels: WebGpuKernels) -> None:
        self.inputs, self.selection, self.otherwise, self.kernels = inputs, selection, otherwise, kernels
        self._resident: ResidentGaussians | None = None
        self._held: dict[str, tuple[Tensor, int]] = {}
        self._ahead: RunState | None = None
        self._kept = False
        self._checked = False
        self._images: dict[int, Any] = {}

    def __call__(self, state: RunState, target: Target, config: StepConfig) -> StepResult:
        """Make one step; see `Step`."""
        medium = state.effects.medium if config.with_water else None
        native = (
            not self.kernels.failure
            and runs_natively(self.selection.objective(state.recipe), state.effects, target, medium, config.fraction)
            and strategy_of(state.recipe).regularisation(state.cloud, self.inputs.median_range) is None
            and not (state.recipe.undimmed_densification or state.recipe.uses_regions or state.optimizer.fixed)
        )
        if not native or isinstance(medium, WaterNetwork):
            state.synchronize()
            return self.otherwise(state, target, config)
        try:
            if self._ahead and self._ahead is not state:
                self._ahead.synchronize()
            return self._step(state, target, config)
        except WebGpuFailure as failure:
            self._fail(state, failure)
            return self.otherwise(state, target, config)
        except (MemoryError, TooManyPairs):
            self._forget(state)
            raise

    def _fail(self, state: RunState, failure: WebGpuFailure) -> None:
        self.kernels.fail(failure)
        self._forget(state)

    def _forget(self, state: RunState) -> None:
        """Release what is on the GPU; the state is as it was synchronised last."""
        self._resident, self._ahead, state.on_device = None, None, None
        self._held.clear()
        self._images.clear()
        state.optimizer.clear_gradients()

    # -- between the CPU and the GPU ----------------------------------------------------------------------------------

    @staticmethod
    def _arrays(state: RunState) -> dict[str, Tensor]:
        """Return parameters and moments by the names that they have on the GPU."""
        arrays: dict[str, Tensor] = {}
        for name in RESIDENT:
            arrays[name] = getattr(state.cloud, name)
            arrays |= {
                f"{name}.{moment}": value for moment, value in zip(MOMENTS, state.optimizer.moments[name], strict=True)
            }
        return arrays

    def _load(self, state: RunState) -> ResidentGaussians:
        """Send what has changed since it was sent or fetched last."""
        arrays, count = self._arrays(state), len(state.cloud)
        sizes = {name: arrays[name][0].numel() for name in RESIDENT}
        if self._resident is None or (self._resident.count, self._resident.sizes) != (count, sizes):
            self._held.clear()
            self._resident = None  # its memory is free before the other is made
            self._resident = ResidentGaussians(self.kernels.gpu, count, sizes)
        for name, tensor in arrays.items():
            held = self._held.get(name)
            if held is None or held[0] is not tensor or held[1] != tensor._version:
                self._resident.load(name, tensor)
                self._held[name] = tensor, tensor._version
        return self._resident

    def fetch(self, state: RunState, parameters_only: bool) -> None:
        """Bring a state up to date; see `OnDevice.fetch`."""
        with self._failure_handled(state), part("card to processor"), torch.no_grad():
            self._copy_back(state, parameters_only)

    def not_finite(self, state: RunState) -> str:
        """See `OnDevice.not_finite`."""
        finding = ""
        with self._failure_handled(state):
            assert self._resident is not None
            sizes = self._resident.sizes
            moments = {f"{name}.{moment}": size for name, size in sizes.items() for moment in MOMENTS}
            finding = self._resident.not_finite(sizes | moments)
        return finding and f"{finding} is not finite"

    def keep(self, state: RunState) -> None:
        """See `OnDevice.keep`."""
        if self._resident is None:  # it has failed
            return
        with self._failure_handled(state):
            self._resident.keep(RESIDENT)
            self._kept = True

    @contextmanager
    def _failure_handled(self, state: RunState) -> Iterator[None]:
        try:
            yield
        except WebGpuFailure as failure:
            self._fail(state, failure)

    def _copy_back(self, state: RunState, parameters_only: bool) -> None:
        assert self._resident is not None
        arrays = {name: t for name, t in self._arrays(state).items() if name in RESIDENT or not parameters_only}
        fetched = {name: self._resident.fetch(name, tuple(tensor.shape)) for name, tensor in arrays.items()}
        for name, tensor in arrays.items():
            tensor.detach().copy_(fetched[name])
            self._held[name] = tensor, tensor._version
        if parameters_only:
            return
        gradient, views = self._resident.fetch_statistics().unbind(1)
        state.statistics.gradient += gradient
        state.statistics.views += views
        if self._kept:
            good = {
                name: self._resident.fetch(f"good.{name}", tuple(getattr(state.cloud, name).shape)) for name in RESIDENT
            }
            state.guarded.last_good |= good
        self._ahead, state.on_device, self._kept = None, None, False

    def _image(self, target: Target) -> Any:
        """Return the buffer of a training image."""
        key = id(target)
        if key not in self._images:
            valid = (target.valid[..., None] * 255).to(torch.uint8)
            words = torch.cat([target.pixels, valid], -1).contiguous().view(torch.int32)
            self._images[key] = self.kernels.gpu.upload(words)
            finalize(target, self._images.pop, key, None)
        return self._images[key]

    # -- one step -----------------------------------------------------------------------------------------------------

    def _step(self, state: RunState, target: Target, config: StepConfig) -> StepResult:
        with part("processor to card"):
            resident = self._load(state)
        medium = state.effects.medium if config.with_water else None
        assert not isinstance(medium, WaterNetwork)
        shading = Shading.of(medium, config.water_degree, state.effects.lamp)
        gain = Gain.of(state.effects, target.camera.name)
        background = None if shading.open_water else state.cloud.background.sigmoid()
        view = self._view(state, target, config, shading, gain, background)
        optimizer = state.optimizer
        adam = {
            name: adam_fields(config.learning_rates[name], *BETAS, EPS, optimizer.steps + 1)
            for name in RESIDENT
            if name in config.learning_rates and not (config.stage_two and name in GEOMETRY)
        }
        self._ahead, state.on_device = state, OnCard(self, state)
        with part("step on the card"):
            outcome = resident.step(view, adam)
        if not (self._checked or state.dropout or outcome.problem):
            self._check(state, target, config, outcome.loss)
        if not outcome.problem:
            _set_gradients(outcome, shading, gain, background)
            with part("optimiser"):
                optimizer.step(config.learning_rates)
        return StepResult(outcome.loss, outcome.problem, None, None)

    def _check(self, state: RunState, target: Target, config: StepConfig, loss: float) -> None:
        """Compare the loss and the gradients of a step with the CPU's, whose parameters are still those before it.

        Raises:
            WebGpuFailure: They differ by more than DIFFERENCE.
        """
        assert self._resident is not None
        self._checked = True
        medium, cloud = state.effects.medium if config.with_water else None, state.cloud
        assert not isinstance(medium, WaterNetwork)
        shown = config.sh_degree, medium, config.water_degree, state.effects.lamp
        image = NativeImage(self.kernels.cpu, cloud, target.camera, *shown, None)
        weights = self.selection.objective(state.recipe).photometric_weights(config.fraction)
        library = self.kernels.cpu.library
        expected, by_image = compare(library, image, state.effects, target, weights, state.recipe.coverage)
        image.backward(*by_image, with_geometry=not config.stage_two)
        differences = {"the loss": abs(loss - float(expected)) / max(float(expected), 1e-3)}
        for name in COMPARED:
            if (gradient := getattr(cloud, name).grad) is not None and gradient.any():
                got = self._resident.fetch(f"by.{name}", tuple(gradient.shape))
                differences[f"the gradient of {name}"] = float((got - gradient).norm() / gradient.norm())
        state.optimizer.clear_gradients()
        name, worst = max(differences.items(), key=lambda entry: entry[1])
        if not worst < DIFFERENCE:
            raise WebGpuFailure(
                f"The graphics card {self.kernels.gpu.adapter_name} computes wrongly: {name} differs by {worst:.1%} "
                f"from the processor's ({DIFFERENCE:.0%} at most)."
            )

    def _view(
        self,
        state: RunState,
        target: Target,
        config: StepConfig,
        shading: Shading,
        gain: Gain,
        background: Tensor | None,
    ) -> View:
        camera, numbers = target.camera, np.zeros(NUMBERS, np.float32)
        mode, tau = 0, shading.tau
        if shading.coefficients is not None:
            mode |= WATER | (LINEAR if shading.linear else 0) | (OPEN if shading.open_water else 0)
            numbers[:COEFFICIENTS] = shading.coefficients.detach().numpy()
        if tau is not None:
            mode |= LAMP
            numbers[TAU] = float(tau.detach())
        numbers[UNIT_RANGE] = shading.unit_range
        if isinstance(gain.numbers, Tensor):
            mode |= GAIN
            numbers[GAINS:] = gain.numbers.numpy()
        l1, ssim, l2 = self.selection.objective(state.recipe).photometric_weights(config.fraction)
        seed = np.random.SeedSequence((self.inputs.settings.seed, state.iteration)).generate_state(1)[0]
        return View(
            target=self._image(target),
            viewmat=torch.from_numpy(camera.world_to_camera).float(),
            K=torch.from_numpy(camera.K).float(),
            centre=torch.from_numpy(camera.centre).float(),
            width=camera.width,
            height=camera.height,
            sh_degree=min(config.sh_degree, math.isqrt(1 + state.cloud.shN.shape[1]) - 1),
            water_degree=config.water_degree,
            mode=mode | (SIMILARITY if ssim else 0),
            numbers=numbers,
            background=(0.0, 0.0, 0.0) if background is None else tuple(background.tolist()),
            dropout=state.dropout,
            seed=int(seed),
            geometry=not config.stage_two,
            weights=(l1, ssim, l2, state.recipe.coverage),
            surface=(LIKE_WATER, UNLIKE_WATER),
            log_scale_limits=LOG_SCALE_LIMITS,
            farthest=FARTHEST,
            dazzling=DAZZLING,
        )


@dataclass
class OnCard:
    """The Gaussians of a state that a step has left on the GPU; see `OnDevice`."""

    step: WebGpuStep
    state: RunState
    names: Collection[str] = RESIDENT

    def fetch(self, parameters_only: bool = False) -> None:
        """See `OnDevice`."""
        self.step.fetch(self.state, parameters_only)

    def not_finite(self) -> str:
        """See `OnDevice`."""
        return self.step.not_finite(self.state)

    def keep(self) -> None:
        """See `OnDevice`."""
        self.step.keep(self.state)


def _set_gradients(outcome: Outcome, shading: Shading, gain: Gain, background: Tensor | None) -> None:
    """Set the gradients of water, lamp, gains and background."""
    with part("backward between kernels"):
        if shading.coefficients is not None:
            shading.coefficients.backward(outcome.by_coefficients)
        if shading.tau is not None:
            shading.tau.backward(outcome.by_tau)
        gain.backward(outcome.by_gain)
        if background is not None:
            background.backward(outcome.by_background)
