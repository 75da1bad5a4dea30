"""The plan of a scene: each effect on, off or unknown, why, what training starts from, and what it costs."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path, read_text
from ..base.strict_json import from_json, replace_nonfinite, to_json
from ..effects.registry import REGISTRY
from ..evidence.decision import Decision, State
from ..evidence.observations import FIT_WIDTH
from ..evidence.scene_evidence import DepthNetwork, FrameNetwork, SceneEvidence
from ..scene.colmap import Scene, load_scene
from ..scene.images import TrainingImage, describe_empty, load_images
from ..settings.effect_names import EFFECTS, parse_effects
from .costs import measured_costs

PLAN_VERSION = 2
"""Raised when decisions change so that stored plans of unchanged scenes are out of date."""
STATES: dict[State, str] = {"on": "on", "off": "off", "unknown": "undetermined"}
"""Words for the states."""


@dataclass(frozen=True)
class PlannedEffect:
    """One line of the plan.

    Attributes:
        state: Whether the scene calls for the effect.
        evidence: Figures, each beside its threshold (NAME_least, NAME_most).
        reason: The decision in one sentence.
        cost_ms: Processor time of one iteration on this machine, ms.
        start: Fitted values that training starts from.
        overruled: Whether the user has decided, whatever the evidence says.
    """

    state: State
    evidence: dict[str, Any]
    reason: str
    cost_ms: float
    start: dict[str, Any] = field(default_factory=dict)
    overruled: bool = False


NOT_EXAMINED = PlannedEffect("off", {}, "Not examined: the plan was made before this effect existed.", 0.0)
"""An effect that a stored plan does not have."""


@dataclass(frozen=True)
class Plan:
    """Decisions about all effects of a scene.

    Attributes:
        effects: By name, in the order of EFFECTS.
        water: Fitted beta_D, beta_B, B_inf with what they are `per`, in which `light`, and their 95 % intervals; None
            where nothing was fitted.
        scene: Key of the scene, as `made_from` returned it.
    """

    effects: dict[str, PlannedEffect]
    water: dict[str, Any] | None
    scene: str

    def on(self, name: str) -> bool:
        """Return whether a run models the effect."""
        state = self.effects[name].state
        return state == "on" or (state == "unknown" and REGISTRY[name].on_when_unknown)

    def switches(self) -> dict[str, bool]:
        """Return whether a run models each effect, by name."""
        return {name: self.on(name) for name in self.effects}

    def overruled(self, choices: Mapping[str, bool], reason: str = "The user's choice.") -> "Plan":
        """Return the plan with choices of the user in place of its own; names that are no effects are ignored."""
        changed = {
            name: replace(self.effects[name], state="on" if chosen else "off", reason=reason, overruled=True)
            for name, chosen in choices.items()
            if name in self.effects
        }
        return replace(self, effects=self.effects | changed)

    def to_json(self) -> dict[str, Any]:
        """Return the document of plan.json."""
        effects = {name: asdict(effect) for name, effect in self.effects.items()}
        return {"effects": effects, "water": self.water, "scene": self.scene}

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> "Plan":
        """Read the document of a plan.json; effects that it does not have are off.

        Raises:
            InputError: If the document is not a plan.
        """
        try:
            stored = {name: PlannedEffect(**effect) for name, effect in document["effects"].items()}
            water, scene = document["water"], str(document["scene"])
        except (AttributeError, KeyError, TypeError) as error:
            raise InputError(f"This is not a plan: {error} is missing or wrong; make the plan again.") from error
        if unknown := sorted(set(stored) - set(EFFECTS)):
            raise InputError(f"This plan has an effect that is not known here, {unknown[0]}: make the plan again.")
        if not set(stored) >= {"attenuation", "lamp"}:
            raise InputError("This is not a plan: it has no decisions; make the plan again.")
        if wrong := sorted({str(effect.state) for effect in stored.values()} - set(get_args(State))):
            raise InputError(f"This is not a plan: a state is {wrong[0]!r}, not one of {', '.join(get_args(State))}.")
        return cls({name: stored.get(name, NOT_EXAMINED) for name in EFFECTS}, water, scene)


def read_plan(path: Path) -> Plan:
    """Read a plan.json.

    Raises:
        InputError: If it cannot be read.
    """
    try:
        document = from_json(read_text(path))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as a plan: {error}.") from error
    try:
        return Plan.from_json(document)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def write_plan(path: Path, plan: Plan) -> None:
    """Write a plan.json, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(to_json(plan.to_json(), indent=2) + "\n")


def made_from(scene: Scene) -> str:
    """Compute the key of a scene: it changes with images, masks, cameras, points, and the version of the planner."""
    hashed = hashlib.sha256(f"plan {PLAN_VERSION};".encode())
    for view in scene.views:
        for path in (view.path, scene.masks.of.get(view.path)):
            hashed.update(f"{view.name} {path and path.stat().st_size} {path and path.stat().st_mtime_ns};".encode())
        hashed.update(view.camera.world_to_camera.tobytes())
    hashed.update(scene.points.positions.tobytes())
    return hashed.hexdigest()[:16]


def plan_scene(
    scene_folder: Path,
    out: Path | None = None,
    *,
    labels: bool = False,
    depth: DepthNetwork | None = None,
    interpolator: FrameNetwork | None = None,
    width: int = FIT_WIDTH,
    backend: str = "auto",
) -> Plan:
    """Plan a scene.

    Args:
        scene_folder: Folder of the scene.
        out: Folder for plan.json; not written without it.
        labels: Whether the user wants labels.
        depth: Depth network; without one the depth prior may remain unknown.
        interpolator: Frame interpolation network; without one interpolation may remain unknown.
        width: Width that will be trained at, at which costs are measured, pixels.
        backend: What computes.

    Returns:
        The plan.

    Raises:
        InputError: If the scene cannot be read.
    """
    scene = load_scene(scene_folder)
    split = scene.split
    seen = [view for view in scene.views if view.name not in set(split.test)]
    loaded = load_images(scene, seen, FIT_WIDTH)
    images = [image for image in loaded if image.valid.any()]
    if not images:
        raise InputError(f"No photo is left to plan from. {describe_empty(loaded)} In masks, black is what is ignored.")
    plan = make_plan(scene, images, labels=labels, depth=depth, interpolator=interpolator, width=width, backend=backend)
    if out is not None:
        write_plan(out / "plan.json", plan)
    return plan


def plan_and_keep(scene_folder: Path, out: Path | None, effects: str, width: int = FIT_WIDTH) -> tuple[Plan, str]:
    """Plan a scene with the user's choices and keep the plan where training finds it.

    Args:
        scene_folder: Folder of the scene.
        out: Folder for plan.json; the scene's own folder without it.
        effects: Choices as `parse_effects` takes them.
        width: Width that will be trained at, pixels.

    Returns:
        The plan, and a sentence on where it was written.

    Raises:
        InputError: If the scene cannot be read, for wrong choices, and where `out` cannot be written.
    """
    choices = parse_effects(effects)
    plan = plan_scene(scene_folder, width=width).overruled(choices)
    path = (out or scene_folder) / "plan.json"
    try:
        write_plan(path, plan)
    except InputError as error:
        if out:
            raise
        return plan, f"Not kept: {error}"  # a scene that is read-only can be planned all the same
    return plan, f"Written to {path}."


def make_plan(
    scene: Scene,
    images: Sequence[TrainingImage],
    *,
    labels: bool = False,
    depth: DepthNetwork | None = None,
    interpolator: FrameNetwork | None = None,
    width: int = FIT_WIDTH,
    backend: str = "auto",
) -> Plan:
    """Plan a scene from images that are not for testing, FIT_WIDTH wide or as wide as they are; see `plan_scene`."""
    # Sorted, so that what is drawn at random is the same for all callers.
    images = sorted(images, key=lambda image: image.camera.name)
    evidence = SceneEvidence(scene, images, labels, depth, interpolator)
    decisions = decide_all(evidence)
    trained = images[0].camera.resized(min(width, images[0].camera.width))
    costs = measured_costs(trained.width, trained.height, backend)
    effects = {
        name: PlannedEffect(
            decision.state,
            replace_nonfinite(decision.evidence),
            decision.reason,
            round(costs[name], 3),
            REGISTRY[name].fitted(evidence) if decision.state == "on" else {},
        )
        for name, decision in decisions.items()
    }
    return Plan(effects, _water(evidence), made_from(scene))


def decide_all(evidence: SceneEvidence) -> dict[str, Decision]:
    """Decide about all effects, in the order of the registry."""
    decisions: dict[str, Decision] = {}
    for name, effect in REGISTRY.items():
        decisions[name] = effect.decide(evidence, decisions)
    return decisions


def _water(evidence: SceneEvidence) -> dict[str, Any] | None:
    """The fitted water as plan.json has it."""
    terms = evidence.water_terms
    if terms is None or not terms.fit.family.attenuation:
        return None
    values = {name: getattr(terms.fit, name) for name in ("beta_D", "beta_B", "B")}

    def rounded(of: dict[str, np.ndarray]) -> dict[str, list[Any]]:
        names = {"B": "B_inf"}
        return {names.get(name, name): np.round(value.clip(min=0), 6).tolist() for name, value in of.items()}

    return rounded(values) | {"light": "linear", "per": "unit", "intervals": rounded(terms.intervals)}


def describe(plan: Plan) -> str:
    """Return the plan as a table for a terminal: effect, state, cost, reason; then the water training starts from."""
    lines = []
    for name, effect in plan.effects.items():
        title = name.replace("_", " ")
        lines.append(f"{title:<21}{STATES[effect.state]:<14}{effect.cost_ms:6.2f} ms  {effect.reason}")
    if plan.water and plan.on("attenuation"):
        lines.append("")
        titles = {"beta_D": "attenuation per unit"}
        if plan.on("backscatter"):
            titles |= {"beta_B": "backscatter per unit", "B_inf": "background light"}
        for key, title in titles.items():
            figures = "  ".join(
                f"{color} {value:.4f} ({low:.4f} to {high:.4f})"
                for color, value, low, high in zip(
                    ("red", "green", "blue"), plan.water[key], *plan.water["intervals"][key], strict=True
                )
            )
            lines.append(f"{title:<21}{figures}")
    return "\n".join(lines)
