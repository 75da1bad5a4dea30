"""Which effects a run models, what they start from, and switching them while the run lasts."""

from collections.abc import Mapping
from typing import Any

import torch

from ..effects.caustics import Illumination
from ..effects.exposure import Exposure
from ..effects.lamp import Lamp
from ..effects.scene_effects import Simulated
from ..gaussians.cloud import GaussianCloud
from ..planning.plan import Plan
from ..settings.recipes import SWITCHES, Recipe, has, recipe_of, switched
from ..water.medium import Medium
from ..water.network import WaterNetwork
from .initial_water import InitialWater, initial_water, remove_water_from_colors
from .inputs import RunInputs
from .objective import Objective
from .state import RunState
from .trials import undetermined_effects

RATES = {"lamp": 1e-2, "exposure": 5e-3, "caustics": 2e-2}
"""Adam step sizes at the start of the run; they fall to 0 as a cosine."""


class EffectSelection:
    """Effects of one run, from its recipe, its plan and the user's choices.

    Args:
        inputs: Images and settings of the run.
        plan: The plan that the run follows, None for a recipe without one.

    Attributes:
        to_try: Effects that the plan leaves undetermined, which trials decide; off until then.
        water: The water that the run started from.
    """

    def __init__(self, inputs: RunInputs, plan: Plan | None) -> None:
        self.inputs, self.plan = inputs, plan
        self.to_try = undetermined_effects(plan) if inputs.validation else []
        self.water = InitialWater()

    def recipe(self, choices: Mapping[str, bool]) -> Recipe:
        """Return the recipe with these effects switched on or off on top of what plan and user say."""
        settings = self.inputs.settings
        planned = self.plan.switches() if self.plan else None
        return switched(recipe_of(settings.recipe, settings.effects, planned), choices)

    def objective(self, recipe: Recipe) -> Objective:
        """Return the loss of a recipe for this scene."""
        return Objective(recipe, self.inputs.median_range, self.water.order, self.inputs.settings.backend)

    def initial_choices(self) -> dict[str, bool]:
        """Return the effects to try, all off."""
        return dict.fromkeys(self.to_try, False)

    def initial_effects(self, recipe: Recipe, cloud: GaussianCloud) -> Simulated:
        """Make the effects that a run starts with, and take their water out of the cloud's colors, in place."""
        self._find_water(recipe, cloud)
        return self._initial(recipe, self.water.medium)

    def switch(self, state: RunState, choices: Mapping[str, bool]) -> None:
        """Switch effects on or off in the middle of a run; those that stay keep what they have learned."""
        state.choices |= choices
        state.recipe = self.recipe(state.choices)
        medium = None
        if state.recipe.attenuation:
            if state.effects.medium is None:
                with torch.no_grad():
                    self._find_water(state.recipe, state.cloud)
            medium = state.effects.medium or self.water.medium
        effects = self._initial(state.recipe, medium)
        for name, effect in state.effects.owners().items():
            if getattr(effects, name) is not None:
                setattr(effects, name, effect)
        state.optimizer.simulated = effects
        state.optimizer.adopt()
        state.guarded.keep(state.optimizer)

    def switched_on(self, state: RunState) -> list[str]:
        """Return the effects and parts of the method that the run has on."""
        return [
            name for name in SWITCHES if has(state.recipe, name) and (name != "moving_objects" or state.motion.masks)
        ]

    def _find_water(self, recipe: Recipe, cloud: GaussianCloud) -> None:
        self.water = initial_water(self.inputs, recipe, self.plan)
        if isinstance(self.water.medium, Medium) and self.plan:
            remove_water_from_colors(cloud, self.water.medium, self.inputs.training)

    def _initial(self, recipe: Recipe, medium: Medium | WaterNetwork | None) -> Simulated:
        """All effects of the recipe at their initial values: those of the plan, else neutral ones."""

        def fitted(effect: str) -> dict[str, Any]:
            return self.plan.effects[effect].start if self.plan else {}

        names = sorted(image.camera.name for image in self.inputs.training)
        camera, unit_range = self.inputs.training[0].camera, self.inputs.median_range
        tau, gains = fitted("lamp").get("tau"), fitted("exposure").get("log_gains")
        known = gains if isinstance(gains, dict) else {}
        return Simulated(
            medium,
            Lamp.starting(unit_range, float(tau) if isinstance(tau, int | float) else unit_range**2)
            if recipe.lamp
            else None,
            Exposure.starting({name: float(known.get(name, 0.0)) for name in names}) if recipe.exposure else None,
            Illumination.starting(names, camera.width, camera.height) if recipe.caustics else None,
        ).to(self.inputs.device)

    def learning_rates(self, state: RunState) -> dict[str, float]:
        """Return Adam's step size at the start of the run by parameter name, for all parameters of effects."""
        rates = RATES | {"medium": state.recipe.water_rate, "medium.veil": state.recipe.veil_rate}
        return {name: rates.get(name, rates.get(name.partition(".")[0], 0.0)) for name in state.effects.parameters()}
