"""One optimisation step: state and target in, loss and statistics out."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from ..base.timing import part
from ..gaussians.densify import random_of
from ..rendering.importance import visibility
from ..rendering.render import render
from ..water.medium import Medium
from ..water.network import WaterNetwork
from .densification import strategy_of
from .dropout import opacity_factors
from .effect_selection import EffectSelection
from .guard import step_problem
from .guidance import Guidance
from .inputs import RunInputs
from .state import RunState
from .targets import Target

GEOMETRY = ("means", "quats", "log_scales", "features")
"""Parameters that stage two freezes."""


@dataclass(frozen=True)
class StepConfig:
    """What the schedule says about one iteration.

    Attributes:
        fraction: How far the run is, 0..1.
        sh_degree: Degree of the Gaussians' colors, 0..3.
        water_degree: Degree of the background light, 0..2.
        with_water: Whether the water is modelled already.
        stage_two: Whether geometry and water are frozen.
        learning_rates: Adam's step size by parameter name.
        epsilon: What Adam adds to the root of the second moment, as in `Optimizer.step`.
        phase: What the loss is made of, as in `GuardedState.record_step`.
    """

    fraction: float
    sh_degree: int
    water_degree: int
    with_water: bool
    stage_two: bool
    learning_rates: dict[str, float]
    epsilon: float
    phase: str = ""


@dataclass(frozen=True)
class StepResult:
    """Outcome of one step.

    Attributes:
        loss: The loss; where a device tells it late, that of the last step of which it is known.
        problem: What was not finite; then the parameters are as before. Empty where the step was made, or is under way.
        means2d_gradient: (N, 2) gradient of the loss with respect to the projected centres, per pixel; None where
            there is none, or where the step counts views itself.
        radii: (N,) extent on screen in pixels, 0 where a Gaussian is not visible; None where means2d_gradient may be.
    """

    loss: float
    problem: str
    means2d_gradient: Tensor | None
    radii: Tensor | None


class Step(Protocol):
    """Renders a target, computes the loss and updates the parameters once."""

    def __call__(self, state: RunState, target: Target, config: StepConfig) -> StepResult:
        """Make one step.

        Args:
            state: State of the run; its parameters and moments are updated in place and the guard records the outcome,
                or `RunState.synchronize` does so where the step leaves them on a device.
            target: What is compared with.
            config: What the schedule says about this iteration.

        Returns:
            Loss and statistics.
        """


class AutogradStep:
    """The step by torch's automatic differentiation around the kernels; it can do every recipe.

    Args:
        inputs: Images and settings of the run.
        selection: Gives the loss of the recipe that the state has.
        guidance: Regions of the images that act on the loss, if any.
    """

    def __init__(self, inputs: RunInputs, selection: EffectSelection, guidance: Guidance | None) -> None:
        self.inputs, self.selection, self.guidance = inputs, selection, guidance

    def __call__(self, state: RunState, target: Target, config: StepConfig) -> StepResult:
        """Make one step; see `Step`."""
        settings, fraction = self.inputs.settings, config.fraction
        objective = self.selection.objective(state.recipe)
        if config.stage_two:
            for name in GEOMETRY:
                getattr(state.cloud, name).requires_grad_(False)
        medium = state.effects.medium if config.with_water else None
        factors = None
        if state.dropout and not target.interpolated:
            random = random_of(settings.seed, state.iteration, self.inputs.device)
            factors = opacity_factors(len(state.cloud), state.dropout, random)
        picture = render(
            state.cloud,
            target.camera,
            config.sh_degree,
            medium,
            config.water_degree,
            with_range=objective.needs_range(target, fraction),
            with_restored=objective.needs_restored(medium, fraction),
            backend=settings.backend,
            lamp=state.effects.lamp,
            kept=factors,
        )
        picture.color = state.effects.apply_to_image(picture.color, target.camera.name)
        with part("losses"):
            loss = objective(picture, target, medium, fraction)
        penalty = strategy_of(state.recipe).regularisation(state.cloud, self.inputs.median_range)
        if penalty is not None:
            loss = loss + penalty
        if self.guidance and not target.interpolated and not config.stage_two:
            with part("semantics"):
                guided = self.guidance.loss(
                    state.cloud, picture.alpha, target, medium, config.water_degree, state.iteration, fraction
                )
            loss = loss + guided
        with part("backward between kernels"):
            loss.backward()
        gradient = picture.rendering.means2d.grad
        return update_parameters(
            state, loss, gradient, picture.rendering.radii, medium, picture.offsets, target, config
        )


def update_parameters(
    state: RunState,
    loss: Tensor,
    means2d_gradient: Tensor | None,
    radii: Tensor,
    medium: Medium | WaterNetwork | None,
    offsets: Tensor,
    target: Target,
    config: StepConfig,
) -> StepResult:
    """Update the parameters by their gradients, unless one is not finite, and record the outcome.

    Args:
        state: State of the run, whose parameters have their gradients; they are cleared.
        loss: The loss, a scalar.
        means2d_gradient: (N, 2) gradient by the projected centres, None where there is none.
        radii: (N,) extent on screen, pixels.
        medium: The water, None without.
        offsets: (N, 3) from the camera to the Gaussians, scene units.
        target: What was compared with.
        config: What the schedule says about this iteration.

    Returns:
        The outcome of the step.
    """
    value, problem = step_problem(loss, state.optimizer.parameters())
    state.guarded.record_step(value, problem, target.camera.name, config.phase)
    if problem:
        state.optimizer.clear_gradients()
    else:
        if means2d_gradient is not None and state.recipe.undimmed_densification and medium is not None:
            means2d_gradient = means2d_gradient / visibility(medium, offsets).detach()[:, None]
        with part("optimiser"):
            state.optimizer.step(config.learning_rates, config.epsilon)
    return StepResult(value, problem, means2d_gradient, radii)
