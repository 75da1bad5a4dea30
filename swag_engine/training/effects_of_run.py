"""What of a trainer concerns effects: which are on, what they begin with, switching them in the middle of a run."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..effects.moving_objects import LEAST_IMAGES, moving_mask, residual, residuals_elsewhere, share_with_objects
from ..effects.scene_effects import Simulated
from ..evaluation.metrics import picture
from ..formats.run_folder import RunFolder
from ..gaussians.cloud import GaussianCloud
from ..planning.plan import Plan, write_plan
from ..scene.colmap import Scene
from ..scene.images import TrainingImage
from ..settings.recipes import SWITCHES, has, recipe_of, switched
from ..settings.settings import TrainSettings
from ..water.medium import Medium
from ..water.network import WaterNetwork
from .guard import Guard, copies
from .objective import Objective
from .optimizer import Optimizer
from .prepare import find_water, take_water_away
from .run_plan import Starts
from .targets import Target
from .trials import doubtful

RATES = {"lamp": 1e-2, "exposure": 5e-3, "caustics": 2e-2}
"""Adam's step sizes at the start; they fall to 0 as a cosine."""
MASKED_AT = (0.3, 0.6)
"""Shares of the run at which what moves is looked for."""


class EffectsOfRun:
    """Base of the trainer. recipe: what the run computes now; moved: by photograph, the mask of what moved in it."""

    scene: Scene
    run: RunFolder
    settings: TrainSettings
    device: torch.device
    training: list[TrainingImage]
    validation: list[TrainingImage]
    median_range: float
    levels: dict[int, list[Target]]
    optimizer: Optimizer
    guard: Guard

    def begin_effects(self, plan: Plan | None, cloud: GaussianCloud) -> Simulated:
        """Take up a plan; returns what the run simulates at first, its water taken out of the cloud's colours."""
        self.plan = plan
        if plan:
            write_plan(self.run.plan, plan)
        self.doubtful = doubtful(plan) if self.validation else []
        self.choices = dict.fromkeys(self.doubtful, False)
        self.trials: list[dict[str, Any]] = []
        self.moved: dict[str, np.ndarray] = {}
        self.masked = 0
        self.order: tuple[int, int, int] | None = None
        names = [image.camera.name for image in self.training]
        self.starts = Starts(plan, names, self.training[0].camera, self.median_range)
        self.choose({})
        return self.starts.of(self.recipe, self.find_water(cloud), self.device)

    @property
    def cloud(self) -> GaussianCloud:
        return self.optimizer.cloud

    @property
    def simulated(self) -> Simulated:
        return self.optimizer.simulated

    @property
    def medium(self) -> Medium | WaterNetwork | None:
        return self.simulated.medium

    def choose(self, choices: dict[str, bool]) -> None:
        """Take effects on or off beside what the plan and the user say; what they begin with is not made here."""
        self.choices |= choices
        self.recipe = switched(
            recipe_of(self.settings.recipe, self.settings.effects, self.plan.switches() if self.plan else None),
            self.choices,
        )
        self.objective = Objective(self.recipe, self.median_range, self.order, self.settings.backend)

    def find_water(self, cloud: GaussianCloud) -> Medium | WaterNetwork | None:
        """The water that the recipe begins with."""
        known = self.training + self.validation
        self.water_note, medium, self.order = find_water(
            self.scene, known, self.recipe, self.plan, self.settings, self.median_range
        )
        if isinstance(medium, Medium) and self.plan:
            take_water_away(cloud, medium, self.training)
        self.choose({})
        return medium

    def switch(self, choices: dict[str, bool]) -> None:
        """Take effects on or off in the middle of the run."""
        self.choose(choices)
        with torch.no_grad():
            medium = (self.medium or self.find_water(self.cloud)) if self.recipe.attenuation else None
        effects = self.starts.of(self.recipe, medium, self.device)
        for name, effect in self.simulated.owners().items():
            if getattr(effects, name) is not None:
                setattr(effects, name, effect)
        self.optimizer.simulated = effects
        self.optimizer.adopt()
        self.guard.good = copies(self.optimizer)

    def effect_rates(self, falling: float) -> dict[str, float]:
        """Step size by parameter; falling: 1 at the start of the run, 0 at its end."""
        rates = RATES | {"medium": self.recipe.water_rate, "medium.veil": self.recipe.veil_rate}
        return {
            name: falling * rates.get(name, rates.get(name.partition(".")[0], 0.0))
            for name in self.simulated.parameters()
        }

    # -- moving objects -----------------------------------------------------------------------------------------------

    def leave_out_moving(self, fraction: float) -> None:
        """Look for what moves when that is due, `fraction` (0..1) of the way through the run."""
        due = sum(fraction >= share for share in MASKED_AT)
        if due > self.masked:
            self.masked = due
            self.find_moving()

    def find_moving(self) -> None:
        """Leave out of the training photographs what the place as it is learned now does not explain."""
        residuals = []
        for image in self.training:
            shown = picture(self.cloud, image.camera, self.settings.sh_degree, self.settings.backend, self.simulated)
            residuals.append(residual(image.pixels / np.float32(255), shown.numpy(), image.valid))
        cameras = [image.camera for image in self.training]
        elsewhere = residuals_elsewhere(self.cloud, cameras, residuals, self.settings.backend)
        masks = {
            image.camera.name: moving_mask(here, others, image.valid)
            for image, here, others in zip(self.training, residuals, elsewhere, strict=True)
        }
        found = share_with_objects(list(masks.values())) >= LEAST_IMAGES
        self.moved = {name: mask for name, mask in masks.items() if found and mask.any()}
        self.levels.clear()

    def still(self, image: TrainingImage) -> TrainingImage:
        """A training photograph without what moved in it."""
        mask = self.moved.get(image.camera.name)
        return image if mask is None else replace(image, valid=image.valid & ~mask)

    # -- figures and checkpoints --------------------------------------------------------------------------------------

    def effect_figures(self) -> dict[str, Any]:
        """For metrics.json: the effects and parts that are on, and what was tried."""
        simulated = [name for name in SWITCHES if has(self.recipe, name) and (name != "moving_objects" or self.moved)]
        return {"effects": simulated, "trials": self.trials}

    @property
    def moving_note(self) -> str:
        """A sentence for the user, empty where nothing moved."""
        if not self.moved:
            return ""
        share = 100 * np.mean([mask.mean() for mask in self.moved.values()])
        return f"{len(self.moved)} photographs show what moves, on {share:.1f} % of their pixels: left out."

    def effect_tensors(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        moved = {f"moved.{name}": torch.from_numpy(np.packbits(mask)) for name, mask in self.moved.items()}
        return self.simulated.parameters() | moved

    def effect_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        own = {"choices": dict(self.choices), "trials": list(self.trials), "masked": self.masked}
        return self.simulated.state() | own

    def load_effects(self, tensors: dict[str, Tensor], state: dict[str, Any]) -> Simulated:
        """What effect_tensors and effect_state gave."""
        self.trials, self.masked = list(state["trials"]), state["masked"]
        self.moved = {}
        for image in self.training:
            bits = tensors.get(f"moved.{image.camera.name}")
            if bits is not None:
                flat = np.unpackbits(bits.cpu().numpy(), count=image.valid.size)
                self.moved[image.camera.name] = flat.reshape(image.valid.shape).astype(bool)
        self.levels.clear()
        self.choices = {}
        self.choose(state["choices"])
        return Simulated.from_checkpoint(tensors, state).to(self.device)
