"""The plan that a run follows, and what its effects begin with."""

from collections.abc import Sequence
from pathlib import Path

import torch

from ..base.errors import InputError
from ..effects.caustics import Illumination
from ..effects.exposure import Exposure
from ..effects.lamp import Lamp
from ..effects.scene_effects import Simulated
from ..evidence.observations import FIT_WIDTH
from ..planning.plan import Plan, made_from, make_plan, read_plan
from ..priors.depth import InverseDepth
from ..priors.interpolate import Interpolator
from ..scene.cameras import Camera
from ..scene.colmap import Scene
from ..scene.images import TrainingImage
from ..settings.effect_names import parse_effects
from ..settings.recipes import RECIPES, Recipe
from ..settings.settings import TrainSettings
from ..water.medium import Medium
from ..water.network import WaterNetwork
from ..weights.registry import find
from .prepare import DEPTH_NETWORK, FRAME_NETWORK, at_least_wide


def plan_of_run(
    scene: Scene,
    known: Sequence[TrainingImage],
    settings: TrainSettings,
    stored: Path,
    weights_dir: Path | None,
    resume: bool,
) -> Plan | None:
    """The plan with the user's choices in it; None for a recipe that takes none.

    known: the photographs that may be looked at. stored: the run's plan.json, which a run that is resumed goes on with.
    Otherwise it, or the scene's own plan.json, is taken where it was made from what the scene is now; else one is made.
    """
    if not RECIPES[settings.recipe].planned:
        return None
    if resume and stored.exists():
        return read_plan(stored)
    plan = _fitting(scene, (stored, scene.folder / "plan.json"))
    if plan is None:
        depth, frames = (_network(name, weights_dir) for name in (DEPTH_NETWORK, FRAME_NETWORK))
        network = InverseDepth(depth) if depth else None
        plan = make_plan(
            scene,
            at_least_wide(scene, known, FIT_WIDTH),
            depth=(lambda image: network(image.pixels)) if network else None,
            interpolator=Interpolator(frames) if frames else None,
            width=settings.width,
            backend=settings.backend,
        )
    choices = parse_effects(settings.effects)
    if settings.water_type != "auto":
        choices = {"attenuation": True, "backscatter": True, "separate_backscatter": True} | choices
    return plan.overruled(choices)


def _fitting(scene: Scene, paths: Sequence[Path]) -> Plan | None:
    """The first of the plans in these files that was made from what the scene is now."""
    for path in paths:
        try:
            plan = read_plan(path)
        except InputError:
            continue
        if plan.scene == made_from(scene):
            return plan
    return None


def _network(name: str, weights_dir: Path | None) -> Path | None:
    try:
        return find(name, weights_dir)
    except InputError:
        return None


class Starts:
    """What each effect of a run begins with: what the plan fitted, else nothing but its own formula's middle.

    names: of the photographs that are trained on; camera: of one of them; unit_range: the scene's median range.
    """

    def __init__(self, plan: Plan | None, names: Sequence[str], camera: Camera, unit_range: float) -> None:
        self.plan, self.names, self.unit_range = plan, sorted(names), unit_range
        self.size = camera.width, camera.height

    def _fitted(self, effect: str) -> dict[str, object]:
        return self.plan.effects[effect].start if self.plan else {}

    def lamp(self) -> Lamp:
        tau = self._fitted("lamp").get("tau")
        return Lamp.starting(self.unit_range, float(tau) if isinstance(tau, int | float) else self.unit_range**2)

    def exposure(self) -> Exposure:
        gains = self._fitted("exposure").get("log_gains")
        known = gains if isinstance(gains, dict) else {}
        return Exposure.starting({name: float(known.get(name, 0.0)) for name in self.names})

    def caustics(self) -> Illumination:
        return Illumination.starting(self.names, *self.size)

    def of(self, recipe: Recipe, medium: Medium | WaterNetwork | None, device: torch.device) -> Simulated:
        """All effects that the recipe has; the medium is given."""
        return Simulated(
            medium,
            self.lamp() if recipe.lamp else None,
            self.exposure() if recipe.exposure else None,
            self.caustics() if recipe.caustics else None,
        ).to(device)
