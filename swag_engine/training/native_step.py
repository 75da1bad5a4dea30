"""The step by native kernels alone, for recipes whose loss compares colors only."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from ..base.timing import part
from ..effects.beam import MOST_LOG_GAIN, POWERS, Beam
from ..effects.exposure import Exposure
from ..effects.registry import MODELS
from ..effects.scene_effects import SceneEffects
from ..effects.vignetting import LEAST_GAIN, MOST_GAIN, TERMS, Vignetting
from ..gaussians.densify import random_of
from ..kernels.backends import kernels_for
from ..kernels.cpu import CpuKernels
from ..kernels.cuda import CudaKernels
from ..kernels.protocol import NativeKernels
from ..rendering.native_image import NativeImage, add_gradients
from ..settings.recipes import Recipe
from ..water.medium import Medium
from ..water.network import WaterNetwork
from .densification import strategy_of
from .dropout import opacity_factors
from .effect_selection import EffectSelection
from .inputs import RunInputs
from .losses import CLOSED, SURFACE_LIMITS
from .objective import Objective
from .state import RunState
from .step import AutogradStep, StepConfig, StepResult, update_parameters
from .targets import Target

IMAGE_EFFECTS = ("exposure", "vignetting", "beam")
"""Models of image effects that the kernels know."""


class NativeStep:
    """The step by kernels of the CPU or of CUDA without an autograd graph, where `runs_natively` says so.

    Args:
        inputs: Images and settings of the run.
        selection: Gives the loss of the recipe that the state has.
        otherwise: Makes all other steps.
    """

    def __init__(self, inputs: RunInputs, selection: EffectSelection, otherwise: AutogradStep) -> None:
        self.inputs, self.selection, self.otherwise = inputs, selection, otherwise

    def __call__(self, state: RunState, target: Target, config: StepConfig) -> StepResult:
        """Make one step; see `Step`."""
        settings, cloud, fraction = self.inputs.settings, state.cloud, config.fraction
        kernels = kernels_for(settings.backend, cloud.means)
        objective = self.selection.objective(state.recipe)
        medium = state.effects.medium if config.with_water else None
        known = isinstance(kernels, CpuKernels | CudaKernels)
        if not (known and runs_natively(objective, state.effects, target, medium, fraction)):
            return self.otherwise(state, target, config)
        assert isinstance(kernels, CpuKernels | CudaKernels) and not isinstance(medium, WaterNetwork)
        factors = None
        if state.dropout:
            random = random_of(settings.seed, state.iteration, self.inputs.device)
            factors = opacity_factors(len(cloud), state.dropout, random)
        image = NativeImage(
            kernels, cloud, target.camera, config.sh_degree, medium, config.water_degree, state.effects.lamp, factors
        )
        weights = objective.photometric_weights(fraction)
        loss, gradients = compare(kernels, image, state.effects, target, weights, state.recipe)
        by_means2d = image.backward(*gradients, with_geometry=not config.stage_two)
        penalty = strategy_of(state.recipe).regularisation(cloud, self.inputs.median_range)
        if penalty is not None:
            with part("backward between kernels"):
                penalty.backward()
            loss = loss + penalty.detach()
        if (guidance := self.otherwise.guidance) and not config.stage_two:
            with part("semantics"):
                alpha, degree = 1 - image.transmittance, config.water_degree
                guided = guidance.loss(cloud, alpha, target, medium, degree, state.iteration, fraction)
                if guided.requires_grad:
                    guided.backward()  # by the features alone
                loss = loss + guided.detach()
        return update_parameters(state, loss, by_means2d, image.radii, medium, image.offsets, target, config)


def runs_natively(
    objective: Objective,
    effects: SceneEffects,
    target: Target,
    medium: Medium | WaterNetwork | None,
    fraction: float,
) -> bool:
    """Return whether native kernels compute all that a step needs but the loss by which features are learned.

    Args:
        objective: The loss of the run's recipe.
        effects: The effects that are modelled.
        target: What is compared with.
        medium: The water, None without.
        fraction: How far the run is, 0..1.
    """
    known = all(key in IMAGE_EFFECTS for key in effects.models if MODELS[key].acts_on == "image")
    exposure = effects.models.get("exposure")
    learned = not isinstance(exposure, Exposure) or target.camera.name in exposure.names
    analytic = not isinstance(medium, WaterNetwork)
    return known and learned and analytic and objective.is_photometric(target, medium, fraction)


@dataclass(frozen=True)
class Gain:
    """What the image effects do to the linear light of one image, for the kernels of photo.cpp and photo.cu.

    Attributes:
        log_gain: (1 or 3,) of the exposure, with its graph; None without.
        vignetting: The vignetting; None without.
        beam: The beam; None without.
        numbers: (25,) gains; coefficients of the vignetting, its centre and bounds; coefficients of the beam and their
            bound, 0 without a beam. 0 where there is no image effect.
    """

    log_gain: Tensor | None
    vignetting: Vignetting | None
    beam: Beam | None
    numbers: Tensor | int

    @classmethod
    def of(cls, effects: SceneEffects, image: str, device: torch.device) -> "Gain":
        """Return the gain of an image by its name."""
        exposure, vignetting, beam = (effects.models.get(name) for name in IMAGE_EFFECTS)
        assert isinstance(exposure, Exposure | None) and isinstance(vignetting, Vignetting | None)
        assert isinstance(beam, Beam | None)
        if exposure is None and vignetting is None and beam is None:
            return cls(None, None, None, 0)
        log_gain = exposure.log_gain(image) if exposure else None
        gains = torch.ones(3, device=device) if log_gain is None else log_gain.detach().exp().expand(3)
        coefficients, centre = torch.zeros(TERMS, device=device), (0.5, 0.5)
        if vignetting:
            coefficients, centre = vignetting.coefficients.detach(), vignetting.centre
        bounds = constants((*centre, LEAST_GAIN, MOST_GAIN), torch.float32, device)
        of_beam = beam.coefficients.detach() if beam else torch.zeros(len(POWERS), device=device)
        most = constants((MOST_LOG_GAIN if beam else 0.0,), torch.float32, device)
        return cls(log_gain, vignetting, beam, torch.cat([gains, coefficients, bounds, of_beam, most]))

    def backward(self, sums: Tensor) -> None:
        """Set the gradients of the effects from those (20,) by the logs of the gains and by coefficients."""
        if self.log_gain is not None:
            add_gradients([(self.log_gain, sums[:3].sum_to_size(self.log_gain.shape))])
        if self.vignetting:
            self.vignetting.coefficients.grad = sums[3 : 3 + TERMS]
        if self.beam:
            self.beam.coefficients.grad = sums[3 + TERMS :]


def compare(
    kernels: NativeKernels,
    image: NativeImage,
    effects: SceneEffects,
    target: Target,
    weights: tuple[float, float, float],
    recipe: Recipe,
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Compare the photo of a rendered image with its target, and set the gradients of the image effects.

    Args:
        kernels: The backend.
        image: The rendered image.
        effects: The effects that are modelled; their image effects make the photo.
        target: The training image.
        weights: Of L1, 1 - SSIM and L2, as `losses.photometric` has them.
        recipe: Weights of `losses.uncovered_surface`, which counts where open water is modelled, and of
            `uncovered_pixels`, which counts elsewhere.

    Returns:
        The loss, a scalar, and its gradients by `image.blended`, by alpha and by `image.behind`.
    """
    l1, ssim, l2 = weights
    height, width = target.valid.shape
    size, count = (height, width), 3 * height * width
    pixels, valid = target.pixels.contiguous(), target.valid.contiguous()
    gain = Gain.of(effects, target.camera.name, pixels.device)
    behind = 0 if image.behind is None else image.behind
    sources = *size, image.blended, image.transmittance, behind, gain.numbers
    items, by_blended = kernels.items_of_image(*size), torch.empty_like(image.blended)
    photo, wanted = torch.empty_like(by_blended), torch.empty_like(by_blended)
    with part("photo"):
        errors = kernels.sum_each("photo_forward", items, 2, *sources, pixels, valid, photo, wanted)
    by_photo: Tensor | int = 0
    similarity = errors[:0]
    if ssim:
        with part("loss L1 and SSIM"):
            similarity, similarity_backward = kernels.similarity(photo, wanted)
        with part("loss L1 and SSIM backward"):
            by_photo = similarity_backward(-ssim / count)
    by_alpha = torch.empty_like(image.transmittance)
    by_behind = by_blended.new_empty(0) if image.behind is None else torch.empty_like(by_blended)
    compared = valid, photo, wanted, by_photo, l1 / count, 2 * l2 / count
    surface = recipe.coverage / valid.numel(), *SURFACE_LIMITS
    outputs = by_blended, by_alpha, by_behind
    with part("photo backward"):
        made = 4 + TERMS + len(POWERS)
        sums = kernels.sum_each("photo_backward", items, made, *sources, *compared, *surface, *outputs)
    gain.backward(sums[:-1].float())
    terms = torch.cat([errors, similarity, sums[-1:]])
    factors = l1 / count, l2 / count, *([-ssim / count] if ssim else []), surface[0]
    loss = (ssim + terms @ constants(factors, terms.dtype, terms.device)).float()
    if recipe.coverage_of_color and image.behind is None and target.surface is not None:
        loss = loss + close_pixels(
            image.transmittance, target.surface & target.valid, recipe.coverage_of_color, by_alpha
        )
    return loss, outputs


def close_pixels(transmittance: Tensor, surface: Tensor, weight: float, by_alpha: Tensor) -> Tensor:
    """Compute weight times `losses.uncovered_pixels`, and add its gradient.

    Args:
        transmittance: (H, W) 1 - alpha.
        surface: (H, W) bool as `uncovered_pixels` has it.
        weight: Weight of the loss.
        by_alpha: (H, W) gradient by alpha, which is changed.

    Returns:
        The loss, a scalar.
    """
    factor = weight / surface.numel()
    uncovered = (surface * (transmittance - CLOSED)).relu()
    by_alpha -= factor * (uncovered > 0)
    return factor * uncovered.sum()


@lru_cache
def constants(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return numbers as a constant tensor. Uploading blocks until the card is idle, so upload once."""
    return torch.tensor(values, dtype=dtype, device=device)
