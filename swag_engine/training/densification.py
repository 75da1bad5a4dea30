"""When Gaussians are added, dropped and relocated during a run."""

import torch
from torch import Tensor

from ..base.timing import part
from ..gaussians.densify import DensificationStrategy, McmcStrategy, SplitStrategy, random_of
from ..gaussians.relocate import relocate
from ..gaussians.sizes import enforce_sizes, nearest_offsets, sampling, size_limits
from ..rendering.importance import scores, visibility
from ..settings.recipes import Recipe
from ..water.medium import Medium
from ..water.network import WaterNetwork
from .effect_selection import EffectSelection
from .guidance import Guidance
from .inputs import RunInputs
from .state import RunState
from .target_cache import Targets
from .targets import Target

FULL_AFTER = 0.8
"""Fraction of densification after which the number of Gaussians is at its limit, so that late ones can settle."""


def strategy_of(recipe: Recipe) -> DensificationStrategy:
    """Return the densification strategy of a recipe."""
    return McmcStrategy() if recipe.densification == "mcmc" else SplitStrategy()


class Densification:
    """Adds, drops and relocates the Gaussians of a run.

    Args:
        inputs: Images and settings of the run.
        selection: Gives the loss of the recipe that the state has.
        targets: The targets, over which importance is summed.
        guidance: Regions of the images that weigh the scores, if any.
    """

    def __init__(
        self, inputs: RunInputs, selection: EffectSelection, targets: Targets, guidance: Guidance | None
    ) -> None:
        self.inputs, self.selection, self.targets, self.guidance = inputs, selection, targets, guidance

    def due(self, state: RunState) -> bool:
        """Return whether `after_step` may read or change the cloud after this iteration."""
        every_step = not isinstance(strategy_of(state.recipe), SplitStrategy)
        final = state.clock.fraction >= state.recipe.stage_two_from
        return (
            every_step or final or state.iteration % self.inputs.schedule.densify_every == 0 or self._relocates(state)
        )

    def _relocates(self, state: RunState) -> bool:
        """Whether Gaussians are relocated after this iteration."""
        schedule, recipe, fraction = self.inputs.schedule, state.recipe, state.clock.fraction
        every = max(1, round(schedule.relocate_every * state.clock.iterations))
        last = recipe.stage_two_from - schedule.relocate_every
        return recipe.reallocation != "off" and not state.iteration % every and recipe.densify_until <= fraction <= last

    def after_step(self, state: RunState, means_rate: float, sh_degree: int, water_degree: int) -> None:
        """Change the cloud where that is due after an iteration outside stage two.

        Args:
            state: State of the run; changed in place.
            means_rate: Step size of the means in this iteration.
            sh_degree: Degree of the Gaussians' colors, 0..3.
            water_degree: Degree of the background light, 0..2.
        """
        random = random_of(self.inputs.settings.seed, state.iteration)
        with part("densification"):
            strategy_of(state.recipe).perturb(state.free_cloud, means_rate, self.inputs.median_range, random)
            self._densify(state, random)
            self._relocate(state, sh_degree, water_degree)
            self._enforce_limits(state)

    @torch.no_grad()
    def _enforce_limits(self, state: RunState) -> None:
        """Keep Gaussians from being too thin or too large, and remove those before all surfaces that no image sees.

        As often as others are added, and when geometry is final.
        """
        final = state.clock.fraction >= state.recipe.stage_two_from
        if not final and state.iteration % self.inputs.schedule.densify_every:
            return
        cameras = [image.camera for image in self.inputs.training]
        cloud, median_range = state.free_cloud, self.inputs.median_range
        rates, spacings = sampling(cloud.means, cameras, median_range)
        offsets = nearest_offsets(cloud.means, cameras)
        distances, seen = offsets.norm(dim=1), self._visibility(state.effects.medium, offsets)
        enforce_sizes(cloud, *size_limits(rates, spacings, distances, seen, median_range))
        kept = ((rates > 0) | (distances >= self.inputs.least_range)).nonzero().squeeze(-1)
        if 0 < len(kept) < len(cloud):
            state.replace_free(cloud.rows(kept), kept)

    def _visibility(self, medium: Medium | WaterNetwork | None, offsets: Tensor) -> Tensor:
        """Return the fraction (N,) of light that reaches a camera; none is assumed where its loss is not known."""
        if medium is not None:
            return visibility(medium, offsets)
        water = self.selection.plan.effects["attenuation"] if self.selection.plan else None
        clear = water is not None and water.state == "off" and not water.overruled
        return offsets.new_full((len(offsets),), float(clear))

    def _densify(self, state: RunState, random: torch.Generator) -> None:
        schedule, fraction, until = self.inputs.schedule, state.clock.fraction, state.recipe.densify_until
        if state.iteration % schedule.densify_every or not schedule.densify_from <= fraction <= until:
            return
        progress = (fraction - schedule.densify_from) / (until - schedule.densify_from)
        most = state.relief.most or self.inputs.settings.max_gaussians
        budget = state.start_count + int((most - state.start_count) * min(1.0, progress / FULL_AFTER))
        weight = None
        if self.guidance:
            self.guidance.prune(state.free_cloud)
            weight = self.guidance.densification_weights(state.free_cloud)
        with torch.no_grad():
            statistics = state.statistics.first(state.free_count)
            state.replace_free(
                *strategy_of(state.recipe).densify(
                    state.free_cloud, statistics, budget, self.inputs.median_range, random, weight
                )
            )

    def _relocate(self, state: RunState, sh_degree: int, water_degree: int) -> None:
        """Move Gaussians to where the error is, a few times between densification and stage two."""
        if not self._relocates(state):
            return
        recipe, fraction = state.recipe, state.clock.fraction
        objective = self.selection.objective(recipe)

        def loss(color: Tensor, target: Target) -> Tensor:
            shown = state.effects.apply_to_image(color, target.camera.name)
            return objective.reconstruction(shown, target, fraction)

        views = [
            (target.camera, lambda color, target=target: loss(color, target))
            for target in self.targets.at(state, fraction)
            if not target.interpolated
        ]
        backend = self.inputs.settings.backend
        effects = state.effects
        S, E = scores(state.cloud, views, sh_degree, effects.medium, water_degree, backend, effects.lamp)
        if self.guidance and (weight := self.guidance.densification_weights(state.cloud)) is not None:
            E = E * weight
        free, count = state.free_cloud, state.free_count
        state.replace_free(*relocate(free, S[:count], E[:count], identical=recipe.reallocation == "identical"))
