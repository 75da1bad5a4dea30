"""The plan that a run follows."""

from collections.abc import Sequence
from pathlib import Path

from ..base.errors import InputError
from ..evidence.observations import FIT_WIDTH
from ..planning.plan import Plan, made_from, make_plan, read_plan
from ..priors.depth import InverseDepth
from ..priors.interpolate import Interpolator
from ..scene.colmap import Scene
from ..settings.effect_names import parse_effects
from ..settings.recipes import RECIPES
from .initial_water import at_least_wide
from .inputs import RunInputs
from .network_priors import DEPTH_NETWORK, FRAME_NETWORK, network_path


def plan_of_run(inputs: RunInputs, stored: Path, weights_dir: Path | None, resume: bool) -> Plan | None:
    """Find or make the plan of a run, with the user's choices in it.

    Args:
        inputs: Images and settings of the run.
        stored: The run's plan.json, which a resumed run continues with. Otherwise it, or the scene's own plan.json,
            is taken where it was made from the scene as it is now.
        weights_dir: Folder where networks are looked for first.
        resume: Whether the run continues.

    Returns:
        The plan, None for a recipe that takes none.
    """
    scene, settings = inputs.scene, inputs.settings
    if not RECIPES[settings.recipe].planned:
        return None
    if resume and stored.exists():
        return read_plan(stored)
    plan = _matching(scene, (stored, scene.folder / "plan.json"))
    if plan is None:
        depth, frames = (network_path(name, weights_dir) for name in (DEPTH_NETWORK, FRAME_NETWORK))
        network = InverseDepth(depth) if depth else None
        plan = make_plan(
            scene,
            at_least_wide(scene, inputs.known, FIT_WIDTH),
            depth=(lambda image: network(image.pixels)) if network else None,
            interpolator=Interpolator(frames) if frames else None,
            width=settings.width,
            backend=settings.backend,
        )
    choices = parse_effects(settings.effects)
    if settings.water_type != "auto":
        choices = {"attenuation": True, "backscatter": True, "separate_backscatter": True} | choices
    return plan.overruled(choices)


def _matching(scene: Scene, paths: Sequence[Path]) -> Plan | None:
    """The first plan in these files that was made from the scene as it is now."""
    for path in paths:
        try:
            plan = read_plan(path)
        except InputError:
            continue
        if plan.scene == made_from(scene):
            return plan
    return None
