"""What a part of a larger scene is trained with."""

from dataclasses import dataclass, field

from ..effects.scene_effects import SceneEffects
from ..evidence.noise import Noise
from ..gaussians.cloud import GaussianCloud
from ..planning.plan import Plan
from ..rendering.restoration import SceneColors


@dataclass(frozen=True)
class Whole:
    """A model of a whole scene, as far as runs of its parts take it over and do not change it.

    Attributes:
        plan: Plan of the scene, None for a recipe without one.
        choices: Effects that trials switched on or off.
        effects: Water, lamp, exposure of each image, and other effects.
        surroundings: Gaussians around the part, which are drawn, and the background color.
        colors: How the restored colors of the scene are distributed; None where colors are not restored.
        noise: Noise of the images; None where colors are not restored.
        start: Trained Gaussians that the part starts from; None where it starts from sparse points.
    """

    plan: Plan | None
    effects: SceneEffects
    surroundings: GaussianCloud
    choices: dict[str, bool] = field(default_factory=dict)
    colors: SceneColors | None = None
    noise: Noise | None = None
    start: GaussianCloud | None = None
