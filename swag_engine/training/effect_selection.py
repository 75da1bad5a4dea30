"""Which effects a run models, what they start from, and switching them while the run lasts."""

from collections.abc import Mapping
from copy import deepcopy

import torch

from ..effects.effect import InitialContext
from ..effects.scene_effects import SceneEffects
from ..gaussians.cloud import GaussianCloud
from ..planning.plan import Plan
from ..settings.effect_names import EFFECTS
from ..settings.recipes import SWITCHES, Recipe, has, recipe_of, switched
from ..water.medium import Medium
from ..water.network import WaterNetwork
from .initial_water import InitialWater, initial_water, remove_water_from_colors
from .inputs import RunInputs
from .objective import Objective
from .state import RunState
from .trials import undetermined_effects
from .whole import Whole

SETTLED_AFTER = 500
"""Iterations after which Gaussians are near enough to their surfaces for a fit of the water: on the demo it is worse
than the water that is learned after 84 and 280, better after 700."""


class EffectSelection:
    """Effects of one run, from its recipe, its plan and the user's choices.

    Args:
        inputs: Images and settings of the run.
        plan: The plan that the run follows, None for a recipe without one.
        whole: Model of a larger scene, whose effects the run takes over and does not change.

    Attributes:
        to_try: Effects that the plan leaves undetermined, which trials decide; off until then.
        water: The water that the run started from.
    """

    def __init__(self, inputs: RunInputs, plan: Plan | None, whole: Whole | None = None) -> None:
        self.inputs, self.plan, self.whole = inputs, plan, whole
        self.to_try = undetermined_effects(plan) if inputs.validation and not whole else []
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
        """Return the effects to try, all off; in a part of a larger scene, what was chosen for the whole."""
        return dict(self.whole.choices) if self.whole else dict.fromkeys(self.to_try, False)

    def initial_effects(self, recipe: Recipe, cloud: GaussianCloud) -> SceneEffects:
        """Make the effects that a run starts with, and take their water out of the cloud's colors, in place."""
        if self.whole:
            effects = deepcopy(self.whole.effects).to(self.inputs.device)
            if isinstance(effects.medium, Medium) and not self.whole.start:
                remove_water_from_colors(cloud, effects.medium, self.inputs.training)
            self.water = InitialWater("The water is that of the whole survey.") if effects.medium else InitialWater()
            return effects
        self._find_water(recipe, cloud)
        return self._initial(recipe, self.water.medium)

    def switch(self, state: RunState, choices: Mapping[str, bool]) -> None:
        """Switch effects on or off in the middle of a run; those that stay keep what they have learned."""
        state.choices |= choices
        state.recipe = self.recipe(state.choices)
        medium = None
        if "attenuation" in state.recipe.effects:
            if state.effects.medium is None:
                with torch.no_grad():
                    self._find_water(state.recipe, state.cloud)
            medium = state.effects.medium or self.water.medium
        effects = self._initial(state.recipe, medium)
        effects.models |= {name: model for name, model in state.effects.models.items() if name in effects.models}
        state.optimizer.effects = effects
        state.optimizer.adopt()
        state.guarded.keep(state.optimizer)

    def switched_on(self, state: RunState) -> list[str]:
        """Return the effects and parts of the method that the run has on."""
        return [
            name
            for name in (*EFFECTS, *SWITCHES)
            if has(state.recipe, name) and (name != "moving_objects" or state.motion.masks)
        ]

    def _find_water(self, recipe: Recipe, cloud: GaussianCloud) -> None:
        self.water = initial_water(self.inputs, recipe, self.plan)
        if isinstance(self.water.medium, Medium) and self.plan:
            remove_water_from_colors(cloud, self.water.medium, self.inputs.training)

    def _initial(self, recipe: Recipe, medium: Medium | WaterNetwork | None) -> SceneEffects:
        """All effects of the recipe at their initial values: those of the plan, else neutral ones."""
        names = sorted(image.camera.name for image in self.inputs.training)
        camera = self.inputs.training[0].camera
        context = {
            name: InitialContext(
                self.plan.effects[name].start if self.plan else {},
                names,
                camera.width,
                camera.height,
                self.inputs.median_range,
            )
            for name in recipe.effects
        }
        return SceneEffects.initial(medium, recipe.effects, context).to(self.inputs.device)

    def fits_water(self, state: RunState) -> bool:
        """Return whether the water, and a lamp, are to be fitted again before the next iteration."""
        medium, recipe = state.effects.medium, state.recipe
        due = recipe.water_fit_at <= state.clock.fraction < recipe.stage_two_from and state.iteration >= SETTLED_AFTER
        fixed = state.water_final or self.whole
        return due and not fixed and isinstance(medium, Medium) and medium.light == "linear"

    def learning_rates(self, state: RunState) -> dict[str, float]:
        """Return Adam's step size at the start of the run by parameter name, for all effects that change."""
        if self.whole:
            return {}
        water = {
            name: state.recipe.B_inf_rate if name == "medium.background_sh" else state.recipe.water_rate
            for name in state.effects.parameters()
            if name.startswith("medium.")
        }
        rates = state.effects.learning_rates() | water
        fixed = ("medium.", "lamp.") if state.water_final else ()
        return {name: rate for name, rate in rates.items() if not name.startswith(fixed)}
