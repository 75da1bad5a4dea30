"""One iteration: a photograph is drawn, its loss taken, and parameters and Gaussians moved."""

import math
from dataclasses import asdict

import numpy as np
import torch
from torch import Tensor

from ..base.timing import part
from ..gaussians.densify import Growth, GrowthStatistics, McmcGrowth, random_of
from ..gaussians.relocate import reallocate
from ..rendering.importance import scores, visibility
from ..rendering.render import Picture, render
from ..scene.images import TrainingImage
from ..water.medium import MAX_DEGREE, Medium
from ..water.network import WaterNetwork
from .dropout import kept
from .effects_of_run import EffectsOfRun
from .guidance import Guidance
from .pacing.clock import Clock
from .pacing.memory import Relief, fewer, within_memory
from .schedule import SETTLED_BY, LearningRates, Schedule
from .targets import Target

GEOMETRY = ("means", "quats", "log_scales", "features")
"""What stage two freezes."""


class Iteration(EffectsOfRun):
    """What of a trainer an iteration is. iteration: how many were made; start_count: Gaussians at the start;
    statistics: what growth goes by; dropout: share of the Gaussians that is left out; depth: by photograph, inverse
    depth (H, W) of a network; frames: made between photographs."""

    iteration: int
    clock: Clock
    schedule: Schedule
    relief: Relief
    growth: Growth | McmcGrowth
    start_count: int
    statistics: GrowthStatistics
    dropout: float
    depth: dict[str, np.ndarray]
    frames: list[TrainingImage]
    guidance: Guidance | None

    def step(self) -> float:
        """One iteration; returns its loss. One that memory does not reach for is given up, and the run cut down."""
        if (loss := within_memory(self.iterate)) is not None:
            return loss
        self.optimizer.restart(self.guard.good)
        self.optimizer.replace(*fewer(self.cloud))
        self.guard.keep(self.optimizer)
        self.relief.relieve(len(self.cloud))
        self.levels = {}
        self.statistics = GrowthStatistics.zeros(len(self.cloud), self.device)
        return float("nan")

    def iterate(self) -> float:
        fraction = self.clock.fraction
        if self.objective.in_stage_two(fraction):
            for name in GEOMETRY:
                getattr(self.cloud, name).requires_grad_(False)
        target = self.next_target(fraction)
        medium = self.medium if fraction >= self.recipe.water_from else None
        left = None
        if self.dropout and target.weight == 1:
            random = random_of(self.settings.seed, self.iteration)
            left = kept(len(self.cloud), self.dropout, random, self.device)
        picture = render(
            self.cloud,
            target.camera,
            self.sh_degree(fraction),
            medium,
            self.water_degree,
            with_range=self.objective.needs_range(target, fraction),
            with_restored=self.objective.needs_restored(medium, fraction),
            backend=self.settings.backend,
            lamp=self.simulated.lamp,
            kept=left,
        )
        picture.color = self.simulated.developed(picture.color, target.camera.name)
        with part("losses"):
            loss = self.objective(picture, target, medium, fraction)
        if (regularisation := self.growth.regularisation(self.cloud, self.median_range)) is not None:
            loss = loss + regularisation
        if self.guidance and target.weight == 1 and not self.objective.in_stage_two(fraction):
            with part("semantics"):
                guided = self.guidance.loss(
                    self.cloud, picture.alpha, target, medium, self.water_degree, self.iteration, fraction
                )
            loss = loss + guided
        with part("backward between kernels"):
            loss.backward()
        self.iteration += 1
        self.clock.advance(self.iteration)
        phase = f"{list(self.levels)} {medium is not None} {self.objective.in_stage_two(fraction)} {self.dropout > 0}"
        if self.guard.admits(loss, self.optimizer, target.camera.name, phase if target.weight == 1 else ""):
            self.learn(picture, target, medium, fraction)
        else:
            self.optimizer.clear_gradients()
        if self.guard.puts_back(self.optimizer, self.iteration):
            self.statistics = GrowthStatistics.zeros(len(self.cloud), self.device)
        return float(loss.detach())

    def learn(self, picture: Picture, target: Target, medium: Medium | WaterNetwork | None, fraction: float) -> None:
        """Move the parameters by their gradients, and now and then the Gaussians."""
        gradient = picture.rendering.means2d.grad
        if gradient is not None and target.weight == 1:
            if self.recipe.undimmed_growth and medium is not None:
                gradient = gradient / visibility(medium, picture.offsets).detach()[:, None]
            self.statistics.add(gradient, picture.rendering.radii, target.camera.width)
        rates = {name: self.guard.ease * rate for name, rate in self.learning_rates(fraction).items()}
        with part("optimiser"):
            self.optimizer.step(rates)
        if not self.objective.in_stage_two(fraction):
            random = random_of(self.settings.seed, self.iteration)
            with part("growth"):
                self.growth.perturb(self.cloud, rates["means"], self.median_range, random)
                self.grow(random)
                self.reallocate()
            if self.recipe.moving_objects:
                self.leave_out_moving(self.clock.fraction)

    def sh_degree(self, fraction: float) -> int:
        """SH degree of the Gaussians' colours, `fraction` (0..1) of the way through the run."""
        return min(self.settings.sh_degree, sum(fraction >= start for start in self.schedule.sh_degrees))

    @property
    def water_degree(self) -> int:
        """SH degree of the water's colour at this iteration."""
        return MAX_DEGREE if self.clock.fraction >= self.recipe.veil_degrees_from else 0

    def learning_rates(self, fraction: float) -> dict[str, float]:
        """Step size by name, `fraction` (0..1) of the way through the run."""
        rates = asdict(LearningRates())
        end = rates.pop("means_end")
        rates["means"] *= (end / rates["means"]) ** fraction * self.median_range
        # Else they have the time to wander to where a few photographs alone would have them.
        rates["means"] *= min(1.0, math.sqrt(SETTLED_BY / max(1, self.clock.iterations)))
        if self.objective.in_stage_two(fraction):
            return {name: rate for name, rate in rates.items() if name not in GEOMETRY}
        return rates | self.effect_rates(0.5 * (1 + math.cos(math.pi * fraction)))

    def next_target(self, fraction: float) -> Target:
        """The photograph of this iteration: every epoch in its own order, which depends on the seed alone."""
        targets = self.targets_at(fraction)
        epoch, position = divmod(self.iteration, len(targets))
        order = np.random.default_rng((self.settings.seed, epoch)).permutation(len(targets))
        return targets[order[position]]

    def targets_at(self, fraction: float) -> list[Target]:
        """All photographs, and frames made between them, at the size that is trained at then."""
        factor = next((factor for until, factor in self.schedule.coarse if fraction < until), 1)
        factor = max(factor, self.relief.shrink)
        if factor not in self.levels:
            photographs = [
                Target.shrunk(self.still(image), factor, self.device, self.depth.get(image.camera.name))
                for image in self.training
            ]
            made = [Target.shrunk(image, factor, self.device, None, self.recipe.interpolation) for image in self.frames]
            if self.guidance:
                self.guidance.emphasise(photographs)
            self.levels = {factor: photographs + made}
        return self.levels[factor]

    def grow(self, random: torch.Generator) -> None:
        schedule, fraction = self.schedule, self.clock.fraction
        if self.iteration % schedule.grow_every or not schedule.grow_from <= fraction <= self.recipe.grow_until:
            return
        progress = (fraction - schedule.grow_from) / (self.recipe.grow_until - schedule.grow_from)
        # The number grows to its limit evenly in time, so that late Gaussians still have time to settle.
        most = self.relief.most or self.settings.max_gaussians
        budget = self.start_count + int((most - self.start_count) * min(1.0, 1.25 * progress))
        weight = None
        if self.guidance:
            self.guidance.prune(self.cloud)
            weight = self.guidance.growth_weights(self.cloud)
        with torch.no_grad():
            cloud, source = self.growth.event(self.cloud, self.statistics, budget, self.median_range, random, weight)
        self.optimizer.replace(cloud, source)
        self.statistics = GrowthStatistics.zeros(len(cloud), self.device)

    def reallocate(self) -> None:
        """Move Gaussians to where the error is, a few times between the end of growth and stage two."""
        every = max(1, round(self.schedule.reallocate_every * self.clock.iterations))
        fraction = self.clock.fraction
        last = self.recipe.stage_two_from - self.schedule.reallocate_every
        if (
            self.recipe.reallocation == "off"
            or self.iteration % every
            or not self.recipe.grow_until <= fraction <= last
        ):
            return

        def loss(color: Tensor, target: Target) -> Tensor:
            developed = self.simulated.developed(color, target.camera.name)
            return self.objective.reconstruction(developed, target, fraction)

        views = [
            (target.camera, lambda color, target=target: loss(color, target))
            for target in self.targets_at(fraction)
            if target.weight == 1
        ]
        degree = self.sh_degree(fraction)
        S, E = scores(
            self.cloud, views, degree, self.medium, self.water_degree, self.settings.backend, self.simulated.lamp
        )
        if self.guidance and (weight := self.guidance.growth_weights(self.cloud)) is not None:
            E = E * weight
        cloud, source = reallocate(self.cloud, S, E, identical=self.recipe.reallocation == "identical")
        self.optimizer.replace(cloud, source)
        self.statistics = GrowthStatistics.zeros(len(cloud), self.device)
