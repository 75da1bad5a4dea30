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
from ..effects.beam import MOST_LOG_GAIN
from ..effects.exposure import Exposure
from ..effects.vignetting import LEAST_GAIN, MOST_GAIN, Vignetting
from ..formats.water import NO_BACKGROUND_LIGHT
from ..kernels.backends import KERNELS
from ..kernels.protocol import TooManyPairs
from ..kernels.webgpu import WebGpuKernels
from ..kernels.webgpu_device import WebGpuFailure
from ..kernels.webgpu_training import (
    EXPOSURES,
    GAIN,
    LAMP,
    LINEAR,
    OPEN,
    PAIRS_GUESSED,
    SIMILARITY,
    WATER,
    ResidentGaussians,
    View,
    adam_fields,
)
from ..rendering.native_image import NativeImage
from ..rendering.render import background_color
from ..scene.cameras import Camera
from ..water.medium import MAX_DEGREE, Medium
from ..water.network import WaterNetwork
from .densification import strategy_of
from .effect_selection import EffectSelection
from .inputs import RunInputs
from .native_step import IMAGE_EFFECTS, compare, runs_natively
from .optimizer import BETAS, EPS, MOMENTS, epsilon_of
from .resident import RESIDENT, view_of, words_of
from .state import RunState
from .step import GEOMETRY, Step, StepConfig, StepResult
from .targets import Target

COMPARED = ("means", "log_scales", "opacity_logits", "sh0")
"""Parameters whose gradients in the first step are compared with the CPU's; that of quats is 0 for round Gaussians."""
DIFFERENCE = 0.02
"""Largest relative difference of a gradient from the CPU's; by rounding, they differ by .0002."""
LEARNED = {
    "medium.attenuation": slice(0, 3),
    "medium.backscatter": slice(3, 6),
    "medium.background_sh": slice(6, 33),
    "lamp.log_tau": slice(33, 34),
    "vignetting.coefficients": slice(34, 37),
    "beam.coefficients": slice(37, 51),
    "background": slice(51, 54),
    "exposure.raw": slice(EXPOSURES, None),
}
"""Other parameters that are kept on the GPU with their moments, and their places there, as in effects.wgsl."""
NOT_UPDATED = -1.0
"""Step size of a parameter that a step leaves as it is, in effects.wgsl."""


def leave_card(backend: str) -> bool:
    """Compute on the processor from now on, because the card of the backend "wgpu" has too little memory.

    Args:
        backend: What computes.

    Returns:
        Whether a card computed until now.
    """
    kernels = KERNELS.get(backend)
    if not isinstance(kernels, WebGpuKernels) or kernels.failure:
        return False
    name = kernels.gpu.adapter_name
    kernels.fail(WebGpuFailure(f"The graphics card {name} has too little memory for this run."))
    return True


class WebGpuStep:
    """The step through WebGPU of recipes that compare colors only, where `runs_natively` says so.

    Parameters, moments and what densification goes by are on the GPU until `RunState.synchronize` is called. Outcomes
    of steps come late, several together, while the GPU makes later steps; the guard records them then. When the GPU
    fails, the run goes on without it from what was synchronised last; so it does when the gradients of the first step
    are not those of the CPU.

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
        self._loss = math.nan
        self._shortage: MemoryError | TooManyPairs | None = None
        self._ahead: RunState | None = None
        self._kept = False
        self._checked = False
        self._images: dict[int, Any] = {}

    def __call__(self, state: RunState, target: Target, config: StepConfig) -> StepResult:
        """Make one step; see `Step`."""
        water = state.effects.medium
        medium = water if config.with_water else None
        native = (
            not self.kernels.failure
            and runs_natively(self.selection.objective(state.recipe), state.effects, target, medium, config.fraction)
            and strategy_of(state.recipe).regularisation(state.cloud, self.inputs.median_range) is None
            and not (state.recipe.undimmed_densification or state.recipe.uses_regions or state.optimizer.fixed)
        )
        if not native or isinstance(water, WaterNetwork) or isinstance(medium, WaterNetwork):
            state.synchronize()
            return self.otherwise(state, target, config)
        try:
            if self._ahead and self._ahead is not state:
                self._ahead.synchronize()
            self._step(state, target, config, medium)
        except WebGpuFailure as failure:
            self._fail(state, failure)
            return self.otherwise(state, target, config)
        except MemoryError as error:
            self._shortage = error
        if shortage := self._shortage:
            self._forget(state)
            raise shortage
        return StepResult(self._loss, "", None, None)

    def _fail(self, state: RunState, failure: WebGpuFailure) -> None:
        self.kernels.fail(failure)
        self._forget(state)

    def _forget(self, state: RunState) -> None:
        """Release what is on the GPU; the state is as it was synchronised last."""
        self._resident, self._ahead, state.on_device, self._shortage = None, None, None, None
        self._held.clear()
        self._images.clear()
        state.optimizer.clear_gradients()

    # -- between the CPU and the GPU ----------------------------------------------------------------------------------

    @staticmethod
    def _arrays(state: RunState) -> dict[str, Tensor]:
        """Return parameters and moments of the Gaussians by the names that they have on the GPU."""
        arrays: dict[str, Tensor] = {}
        for name in RESIDENT:
            arrays[name] = getattr(state.cloud, name)
            arrays |= {
                f"{name}.{moment}": value for moment, value in zip(MOMENTS, state.optimizer.moments[name], strict=True)
            }
        return arrays

    @staticmethod
    def _learned(state: RunState) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
        """Return the other parameters that are on the GPU, with their moments."""
        parameters = state.optimizer.parameters()
        return {name: (parameters[name], *state.optimizer.moments[name]) for name in LEARNED if name in parameters}

    def _load(self, state: RunState) -> ResidentGaussians:
        """Send what has changed since it was sent or fetched last."""
        arrays, count, learned = self._arrays(state), len(state.cloud), self._learned(state)
        sizes = {name: arrays[name][0].numel() for name in RESIDENT}
        numbers = EXPOSURES + (learned["exposure.raw"][0].numel() if "exposure.raw" in learned else 0)
        resident = self._resident
        if resident is None or (resident.count, resident.sizes, resident.learned) != (count, sizes, numbers):
            self._held.clear()
            pairs = resident.pairs_a_gaussian if resident else PAIRS_GUESSED
            resident = self._resident = None  # its memory is free before the other is made
            resident = self._resident = ResidentGaussians(self.kernels.gpu, count, sizes, numbers, pairs)
        for name, tensor in arrays.items():
            if self._has_changed(name, tensor):
                resident.load(name, tensor)
        tensors = {f"{name}.{i}": tensor for name, own in learned.items() for i, tensor in enumerate(own)}
        if any([self._has_changed(name, tensor) for name, tensor in tensors.items()]):
            values = torch.zeros(3, numbers)
            values[0, LEARNED["medium.background_sh"]][:3] = NO_BACKGROUND_LIGHT
            for name, own in learned.items():
                values[:, LEARNED[name]] = torch.stack([tensor.detach().reshape(-1) for tensor in own])
            resident.load_effects(values)
        return resident

    def _has_changed(self, name: str, tensor: Tensor) -> bool:
        """Return whether a tensor is not as it was sent or fetched last, and take it as sent."""
        held, self._held[name] = self._held.get(name), (tensor, tensor._version)
        return held is None or held[0] is not tensor or held[1] != tensor._version

    def fetch(self, state: RunState, names: Collection[str] | None) -> None:
        """Bring a state up to date; see `OnDevice.fetch`."""
        with self._failure_handled(state), part("card to processor"), torch.no_grad():
            self._settle(state, wait=True)
            self._copy_back(state, names)

    def not_finite(self, state: RunState) -> str:
        """See `OnDevice.not_finite`."""
        finding = ""
        with self._failure_handled(state):
            assert self._resident is not None
            self._settle(state, wait=True)
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

    def render(self, state: RunState, camera: Camera, sh_degree: int) -> Tensor | None:
        """See `OnDevice.render`."""
        with self._failure_handled(state):
            assert self._resident is not None
            medium = state.effects.medium
            assert not isinstance(medium, WaterNetwork)
            fields = self._effects_fields(state, 0)
            view = self._view(state, camera, medium, sh_degree, MAX_DEGREE, fields)
            color, transmittance = self._resident.render(view)
            behind = background_color(state.cloud, camera, medium, backend="cpu").detach()
            return color + transmittance[..., None] * behind
        return None

    @contextmanager
    def _failure_handled(self, state: RunState) -> Iterator[None]:
        try:
            yield
        except WebGpuFailure as failure:
            self._fail(state, failure)

    def _settle(self, state: RunState, wait: bool) -> None:
        """Record the outcomes of steps that have come, or those of all steps; a shortage of memory counts later."""
        assert self._resident is not None
        try:
            for outcome in self._resident.outcomes(wait):
                self._loss = outcome.loss
                state.optimizer.steps -= bool(outcome.problem)
                state.guarded.record_step(outcome.loss, outcome.problem, *outcome.label)
        except (MemoryError, TooManyPairs) as shortage:
            self._shortage = shortage

    def _copy_back(self, state: RunState, names: Collection[str] | None) -> None:
        assert self._resident is not None
        learned = self._learned(state)
        values = self._resident.fetch_effects()
        for name, own in learned.items():
            for i, tensor in enumerate(own):
                tensor.detach().copy_(values[i, LEARNED[name]].view(tensor.shape))
                self._held[f"{name}.{i}"] = tensor, tensor._version
        arrays = {name: t for name, t in self._arrays(state).items() if names is None or name in names}
        fetched = {name: self._resident.fetch(name, tuple(tensor.shape)) for name, tensor in arrays.items()}
        for name, tensor in arrays.items():
            tensor.detach().copy_(fetched[name])
            self._held[name] = tensor, tensor._version
        if names is not None:
            return
        gradient, views = self._resident.fetch_statistics().unbind(1)
        state.statistics.gradient += gradient
        state.statistics.views += views
        if self._kept:
            values = self._resident.fetch_effects(good=True)
            good = {name: values[0, LEARNED[name]].view(own[0].shape) for name, own in learned.items()}
            good |= {
                name: self._resident.fetch(f"good.{name}", tuple(getattr(state.cloud, name).shape)) for name in RESIDENT
            }
            state.guarded.last_good |= good
        self._ahead, state.on_device, self._kept = None, None, False

    def _image(self, target: Target) -> Any:
        """Return the buffer of a training image."""
        key = id(target)
        if key not in self._images:
            self._images[key] = self.kernels.gpu.upload(words_of(target))
            finalize(target, self._images.pop, key, None)
        return self._images[key]

    # -- one step -----------------------------------------------------------------------------------------------------

    def _step(self, state: RunState, target: Target, config: StepConfig, medium: Medium | None) -> None:
        first = self._resident is None
        with part("processor to card"):
            resident = self._load(state)
        optimizer, exposure = state.optimizer, state.effects.models.get("exposure")
        optimizer.steps += 1
        adam = {
            name: adam_fields(rate, *BETAS, epsilon_of(name, config.epsilon), optimizer.steps)
            for name, rate in config.learning_rates.items()
            if not (config.stage_two and name in GEOMETRY)
        }
        image = exposure.names.index(target.camera.name) if isinstance(exposure, Exposure) else 0
        fields = self._effects_fields(state, image) | self._update_fields(state, adam, medium)
        view = self._view(state, target.camera, medium, config.sh_degree, config.water_degree, fields)
        l1, ssim, l2 = self.selection.objective(state.recipe).photometric_weights(config.fraction)
        before_water = medium is not None and medium.background_sh is not None
        coverage = state.recipe.coverage if before_water else state.recipe.coverage_of_color
        view = replace(
            view,
            target=self._image(target),
            mode=view.mode | (SIMILARITY if ssim else 0),
            dropout=state.dropout,
            geometry=not config.stage_two,
            weights=(l1, ssim, l2, coverage),
        )
        self._ahead, state.on_device = state, OnCard(self, state)
        with part("step on the card"):
            of_gaussians = {name: adam[name] for name in RESIDENT if name in adam}
            resident.step((target.camera.name, config.phase), view, of_gaussians)
            self._settle(state, wait=first)
        if first and not (self._checked or state.dropout or self._shortage or state.guarded.record.in_a_row):
            self._check(state, target, config, self._loss)

    @staticmethod
    def _effects_fields(state: RunState, image: int) -> dict[str, Any]:
        """Return how water, lamp and gains act, as effects.wgsl has it, with the exposure of the image of a number."""
        models, lamp = state.effects.models, state.effects.lamp
        fields = {
            "size": EXPOSURES, "image": image, "lamp_range": lamp.unit_range if lamp else 1.0, "medium_range": 1.0,
            "center_x": 0.5, "center_y": 0.5, "least": LEAST_GAIN, "most": MOST_GAIN,
            "most_beam": MOST_LOG_GAIN if "beam" in models else 0.0,
        }  # fmt: skip
        if isinstance(medium := models.get("medium"), Medium):
            fields |= {"medium_range": medium.unit_range, "same_beta": int(medium.backscatter is None)}
        if isinstance(vignetting := models.get("vignetting"), Vignetting):
            fields |= {"center_x": vignetting.centre[0], "center_y": vignetting.centre[1]}
        if isinstance(exposure := models.get("exposure"), Exposure):
            images, channels = exposure.raw.shape
            fields |= {"images": images, "channels": channels, "centred": int(exposure.centred)}
            fields["size"] += images * channels
        return fields

    def _update_fields(
        self, state: RunState, adam: dict[str, dict[str, float]], medium: Medium | None
    ) -> dict[str, Any]:
        """Return the fields of Adam in effects.wgsl; what has no gradient in this step is not updated."""
        without = set() if medium else {name for name in LEARNED if name.startswith("medium.")}
        if medium and medium.background_sh is not None:
            without.add("background")
        updated = self._learned(state).keys() & adam.keys() - without
        sizes = [adam[name]["step_size"] if name in updated else NOT_UPDATED for name in LEARNED]
        fields = adam_fields(0.0, *BETAS, EPS, state.optimizer.steps)
        del fields["step_size"]
        return {**fields, "rates": sizes[:4], "more_rates": sizes[4:]}

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
        expected, by_image = compare(self.kernels.cpu, image, state.effects, target, weights, state.recipe)
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
        camera: Camera,
        medium: Medium | None,
        sh_degree: int,
        water_degree: int,
        fields: dict[str, Any],
    ) -> View:
        """Return a view that is compared with nothing."""
        mode, models = 0, state.effects.models
        if medium:
            mode |= WATER | (LINEAR if medium.light == "linear" else 0)
            mode |= OPEN if medium.background_sh is not None else 0
        mode |= (LAMP if state.effects.lamp else 0) | (GAIN if models.keys() & set(IMAGE_EFFECTS) else 0)
        seed = np.random.SeedSequence((self.inputs.settings.seed, state.iteration)).generate_state(1)[0]
        degree = min(sh_degree, math.isqrt(1 + state.cloud.shN.shape[1]) - 1)
        return replace(view_of(camera, degree, water_degree, mode, fields), seed=int(seed))


@dataclass
class OnCard:
    """The parameters of a state that a step has left on the GPU; see `OnDevice`."""

    step: WebGpuStep
    state: RunState
    names: Collection[str] = (*RESIDENT, *LEARNED)

    def fetch(self, names: Collection[str] | None = None) -> None:
        """See `OnDevice`."""
        self.step.fetch(self.state, names)

    def not_finite(self) -> str:
        """See `OnDevice`."""
        return self.step.not_finite(self.state)

    def keep(self) -> None:
        """See `OnDevice`."""
        self.step.keep(self.state)

    def render(self, camera: Camera, sh_degree: int) -> Tensor | None:
        """See `OnDevice`."""
        return self.step.render(self.state, camera, sh_degree)
