"""The step by the CPU kernels alone, for recipes whose loss compares colors only."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..base.timing import part
from ..effects.exposure import Exposure
from ..effects.registry import MODELS
from ..effects.scene_effects import SceneEffects
from ..effects.vignetting import LEAST_GAIN, MOST_GAIN, TERMS, Vignetting
from ..gaussians.densify import random_of
from ..kernels.backends import kernels_for
from ..kernels.cpu import CpuKernels
from ..kernels.cpu_library import CpuLibrary
from ..rendering.native_image import NativeImage, add_gradient
from ..water.medium import Medium
from ..water.network import WaterNetwork
from .densification import strategy_of
from .dropout import opacity_factors
from .effect_selection import EffectSelection
from .inputs import RunInputs
from .losses import LIKE_WATER, UNLIKE_WATER
from .objective import Objective
from .state import RunState
from .step import AutogradStep, StepConfig, StepResult, update_parameters
from .targets import Target

IMAGE_EFFECTS = ("exposure", "vignetting")
"""Models of image effects that the kernels know."""


class NativeStep:
    """The step by the CPU kernels without an autograd graph, where `runs_natively` says so.

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
        native = isinstance(kernels, CpuKernels) and runs_natively(objective, state.effects, target, medium, fraction)
        if not native:
            return self.otherwise(state, target, config)
        assert isinstance(kernels, CpuKernels) and not isinstance(medium, WaterNetwork)
        factors = None
        if state.dropout:
            random = random_of(settings.seed, state.iteration)
            factors = opacity_factors(len(cloud), state.dropout, random, self.inputs.device)
        image = NativeImage(
            kernels, cloud, target.camera, config.sh_degree, medium, config.water_degree, state.effects.lamp, factors
        )
        weights = objective.photometric_weights(fraction)
        loss, gradients = compare(kernels.library, image, state.effects, target, weights, state.recipe.coverage)
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
    """Return whether the CPU kernels compute all that a step needs but the loss by which features are learned.

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
    """What the image effects do to the linear light of one image, for the kernels of photo.cpp.

    Attributes:
        log_gain: (1 or 3,) of the exposure, with its graph; None without.
        vignetting: The vignetting; None without.
        numbers: (10,) gains, coefficients of the vignetting, its centre and bounds; 0 where there is no image effect.
    """

    log_gain: Tensor | None
    vignetting: Vignetting | None
    numbers: Tensor | int

    @classmethod
    def of(cls, effects: SceneEffects, image: str) -> "Gain":
        """Return the gain of an image by its name."""
        exposure, vignetting = effects.models.get("exposure"), effects.models.get("vignetting")
        assert isinstance(exposure, Exposure | None) and isinstance(vignetting, Vignetting | None)
        if exposure is None and vignetting is None:
            return cls(None, None, 0)
        log_gain = exposure.log_gain(image) if exposure else None
        gains = torch.ones(3) if log_gain is None else log_gain.detach().exp().expand(3)
        coefficients, centre = torch.zeros(TERMS), (0.5, 0.5)
        if vignetting:
            coefficients, centre = vignetting.coefficients.detach(), vignetting.centre
        bounds = torch.tensor([*centre, LEAST_GAIN, MOST_GAIN])
        return cls(log_gain, vignetting, torch.cat([gains, coefficients, bounds]))

    def backward(self, sums: Tensor) -> None:
        """Set the gradients of the effects from those (6,) by the logs of the gains and by the coefficients."""
        if self.log_gain is not None:
            add_gradient(self.log_gain, sums[:3].sum_to_size(self.log_gain.shape))
        if self.vignetting:
            self.vignetting.coefficients.grad = sums[3:]


def compare(
    library: CpuLibrary,
    image: NativeImage,
    effects: SceneEffects,
    target: Target,
    weights: tuple[float, float, float],
    coverage: float,
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Compare the photo of a rendered image with its target, and set the gradients of the image effects.

    Args:
        library: The kernels.
        image: The rendered image.
        effects: The effects that are modelled; their image effects make the photo.
        target: The training image.
        weights: Of L1, 1 - SSIM and L2, as `losses.photometric` has them.
        coverage: Weight of `losses.uncovered_surface`, which counts where open water is modelled.

    Returns:
        The loss, a scalar, and its gradients by `image.blended`, by alpha and by `image.behind`.
    """
    l1, ssim, l2 = weights
    height, width = target.valid.shape
    size, count = (height, width), 3 * height * width
    gain = Gain.of(effects, target.camera.name)
    behind = 0 if image.behind is None else image.behind
    sources = *size, image.blended, image.transmittance, behind, gain.numbers
    photo, wanted = torch.empty(*size, 3), torch.empty(*size, 3)
    pixels, valid, errors = target.pixels.contiguous(), target.valid.contiguous(), doubles(height, 2)
    with part("photo"):
        library.run("photo_forward", height, *sources, pixels, valid, photo, wanted, errors)
    absolute, square = (errors.sum(0) / count).tolist()
    loss = l1 * absolute + l2 * square
    by_photo: Tensor | int = 0
    if ssim:
        by_photo, derivatives, rows = torch.empty(*size, 3), torch.empty(3, *size, 3), doubles(height, 2)
        with part("loss L1 and SSIM"):
            library.run("l1_ssim_forward", height, *size, photo, wanted, rows, derivatives)
        loss += ssim * (1 - float(rows[:, 1].sum()) / count)
        with part("loss L1 and SSIM backward"):
            factors = 0.0, -ssim / count
            library.run("l1_ssim_backward", height, *size, photo, wanted, derivatives, *factors, by_photo)
    by_blended, by_alpha, sums = torch.empty(*size, 3), torch.empty(size), doubles(height, 4 + TERMS)
    by_behind = torch.empty(0 if image.behind is None else (*size, 3))
    compared = valid, photo, wanted, by_photo, l1 / count, 2 * l2 / count
    surface = coverage / valid.numel(), LIKE_WATER, UNLIKE_WATER
    with part("photo backward"):
        library.run("photo_backward", height, *sources, *compared, *surface, by_blended, by_alpha, by_behind, sums)
    *by_gain, uncovered = sums.sum(0)
    gain.backward(torch.stack(by_gain).float())
    loss += surface[0] * float(uncovered)
    return torch.tensor(loss), (by_blended, by_alpha, by_behind)


def doubles(*size: int) -> Tensor:
    """Return an empty float64 tensor, for sums."""
    return torch.empty(size, dtype=torch.float64)
