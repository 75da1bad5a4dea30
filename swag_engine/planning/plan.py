"""Which effects a run simulates: each on, off or unknown, why, what it starts from, and what it costs.

plan = plan_scene(Path("SCENE"), out=Path("FOLDER"))    writes FOLDER/plan.json
print(describe(plan))
"""

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base.errors import InputError
from ..base.files import atomic_path
from ..base.strict_json import from_json, strict, to_json
from ..effects.caustics import Illumination, illuminated
from ..effects.depth_prior import depth_loss
from ..effects.exposure import Exposure, exposed
from ..effects.lamp import Lamp, lit
from ..evidence import observations as water_observations
from ..evidence.observations import FIT_WIDTH, observe
from ..gaussians.init import gaussians_from_points
from ..kernels.backends import device_for
from ..priors.depth import depth_priors
from ..priors.interpolate import admission, neighbour_pairs
from ..scene.cameras import Camera
from ..scene.colmap import Points, Scene, load_scene
from ..scene.images import TrainingImage, load_images, mask_of
from ..scene.split import split_views
from ..semantics.assign import EVERY, labels_in_view, semantic_loss
from ..semantics.embed import DIMENSIONS
from ..settings.effect_names import EFFECTS, parse_effects
from ..water.medium import Medium, open_water, through_water
from . import evidence
from .evidence import Finding, State, WaterFindings

DepthNetwork = Callable[[TrainingImage], np.ndarray]
FrameNetwork = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
TIMED_GAUSSIANS, TIMED_LABELS = 30_000, 8
TIMINGS = 5


@dataclass(frozen=True)
class Effect:
    """One line of the plan.

    evidence: figures, each beside its threshold (NAME_least, NAME_most). cost_ms: of one iteration on this machine.
    start: fitted values that training begins with. overruled: the user has decided, whatever the evidence says.
    """

    state: State
    evidence: dict[str, Any]
    reason: str
    cost_ms: float
    start: dict[str, Any] = field(default_factory=dict)
    overruled: bool = False


@dataclass(frozen=True)
class Plan:
    """effects by name, in the order of EFFECTS; water: fitted beta_D, beta_B, B_inf with what they are `per` and in
    which `light`, and their 95 % intervals; None where nothing was fitted. scene: what made_from gave for the scene."""

    effects: dict[str, Effect]
    water: dict[str, Any] | None
    scene: str

    def on(self, name: str) -> bool:
        """Whether a run simulates the effect: what is unknown stays off, but what moves, which only a run can see."""
        state = self.effects[name].state
        return state == "on" or (state == "unknown" and name == "moving_objects")

    def switches(self) -> dict[str, bool]:
        """Whether a run simulates each effect, by name."""
        return {name: self.on(name) for name in self.effects}

    def overruled(self, choices: Mapping[str, bool], reason: str = "The user's choice.") -> "Plan":
        """The plan with choices, those of EFFECTS, in place of its own."""
        changed = {
            name: replace(self.effects[name], state="on" if chosen else "off", reason=reason, overruled=True)
            for name, chosen in choices.items()
            if name in self.effects
        }
        return replace(self, effects=self.effects | changed)

    def to_json(self) -> dict[str, Any]:
        """As plan.json has it."""
        return {
            "effects": {
                name: {
                    "state": effect.state,
                    "evidence": effect.evidence,
                    "reason": effect.reason,
                    "cost_ms": effect.cost_ms,
                    "start": effect.start,
                    "overruled": effect.overruled,
                }
                for name, effect in self.effects.items()
            },
            "water": self.water,
            "scene": self.scene,
        }

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> "Plan":
        """What to_json gave. Raises InputError for anything else."""
        try:
            effects = {name: Effect(**document["effects"][name]) for name in EFFECTS}
            wrong = sorted({str(effect.state) for effect in effects.values()} - set(STATES))
            if wrong:
                raise InputError(f"This is no plan: a state is {wrong[0]!r}, not one of {', '.join(STATES)}.")
            return cls(effects, document["water"], str(document["scene"]))
        except (KeyError, TypeError) as error:
            raise InputError(f"This is no plan: {error} is missing or wrong; make it again.") from error


def read_plan(path: Path) -> Plan:
    """The plan in a plan.json. Raises InputError when it cannot be read."""
    try:
        document = from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as a plan: {error}.") from error
    try:
        return Plan.from_json(document)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def made_from(scene: Scene) -> str:
    """A word that changes with the photographs, the masks, the cameras and points, and with the code that plans."""
    hashed = hashlib.sha256()
    for view in scene.views:
        for path in (view.path, mask_of(scene, view)):
            hashed.update(f"{view.name} {path and path.stat().st_size} {path and path.stat().st_mtime_ns};".encode())
        hashed.update(view.camera.world_to_camera.tobytes())
    hashed.update(scene.points.positions.tobytes())
    for source in sorted((*Path(__file__).parent.glob("*.py"), Path(water_observations.__file__))):
        hashed.update(source.read_bytes())
    return hashed.hexdigest()[:16]


# Making it ------------------------------------------------------------------------------------------------------------


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
    """Look at a scene and decide; written to out/plan.json where `out` is given.

    labels: the user wants names for things. depth and interpolator: as depth_priors and admission take them; without
    them it stays unknown whether they would help.
    Raises InputError as load_scene and load_images do.
    """
    scene = load_scene(scene_folder)
    split = split_views([view.name for view in scene.views])
    seen = [view for view in scene.views if view.name not in set(split.test)]
    images = load_images(scene, seen, FIT_WIDTH)
    plan = make_plan(
        scene,
        images,
        labels=labels,
        depth=depth,
        interpolator=interpolator,
        width=width,
        backend=backend,
    )
    if out is not None:
        write_plan(out / "plan.json", plan)
    return plan


def plan_and_keep(scene_folder: Path, out: Path | None, effects: str, width: int = FIT_WIDTH) -> tuple[Plan, str]:
    """The plan of a scene with the user's choices, as parse_effects takes them, and a sentence on where it was written:
    to plan.json in `out`, else in the scene's folder, where training finds it.

    Raises InputError as plan_scene does, for wrong choices, and where `out` cannot be written.
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


def write_plan(path: Path, plan: Plan) -> None:
    """plan.json, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(to_json(plan.to_json(), indent=2) + "\n")


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
    """Decide from photographs of the scene that are not for testing, FIT_WIDTH wide or as wide as they are.

    width: pixels that training takes, which costs are measured at.
    """
    images = sorted(images, key=lambda image: image.camera.name)  # what is drawn at random is the same for all callers
    names = [image.camera.name for image in images]
    views = {view.name: view for view in scene.views}
    observations = observe(images, [views[name].point_indices for name in names], scene.points)
    centres = np.stack([image.camera.centre for image in images])
    caustics = evidence.caustics_finding(observations, centres, scene.points.positions)
    water = evidence.water_findings(observations, evidence.open_water_light(images, scene))
    findings = water.effects | {"caustics": caustics}
    separate = findings["separate_backscatter"]
    if findings["backscatter"].state == "on" and separate.state == "off":
        # Water has two coefficients (Akkaynak and Treibitz 2018) even where points cannot tell them apart, and one in
        # place of two costs colours: delta E 13.6 against 10.8 on the demo.
        findings["separate_backscatter"] = replace(
            separate, state="on", reason=f"Water has two coefficients, and the second costs nothing. {separate.reason}"
        )
    findings["moving_objects"] = evidence.moving_objects_finding(
        [name for name in names if mask_of(scene, views[name])]
    )
    findings["interpolation"] = _interpolation(scene, images, interpolator)
    findings["semantics"] = evidence.semantics_finding(labels, images, scene, findings["backscatter"].state == "on")
    findings["depth_prior"] = _depth_prior(scene, images, depth)
    trained = images[0].camera.resized(min(width, images[0].camera.width))
    costs = measured_costs(trained.width, trained.height, backend)
    starts = _starts(water, names)
    effects = {
        name: Effect(
            findings[name].state,
            strict(findings[name].evidence),
            findings[name].reason,
            round(costs[name], 3),
            starts.get(name, {}),
        )
        for name in EFFECTS
    }
    return Plan(effects, _water(water), made_from(scene))


def _interpolation(scene: Scene, images: Sequence[TrainingImage], network: FrameNetwork | None) -> Finding:
    """The network is only asked where the photographs call for it: it takes seconds a frame."""
    training = split_views([view.name for view in scene.views]).train
    pairs = neighbour_pairs([view.name for view in scene.views], training)
    finding = evidence.interpolation_finding(pairs, scene, None)
    if network is None or finding.state != "unknown":
        return finding
    by_name = {image.camera.name: image for image in images}
    return evidence.interpolation_finding(pairs, scene, admission(network, by_name, pairs))


def _depth_prior(scene: Scene, images: Sequence[TrainingImage], network: DepthNetwork | None) -> Finding:
    finding = evidence.depth_prior_finding(images, scene, None)
    if network is None or finding.state != "unknown":
        return finding
    _, alignments = depth_priors(network, images, scene)
    accepted = float(np.mean([alignment.accepted for alignment in alignments.values()]))
    return evidence.depth_prior_finding(images, scene, accepted)


def _starts(water: WaterFindings, names: Sequence[str]) -> dict[str, dict[str, Any]]:
    fit = water.fit
    if fit is None:
        return {}
    starts: dict[str, dict[str, Any]] = {}
    if water.effects["lamp"].state == "on":
        starts["lamp"] = {"tau": fit.tau}
    if water.effects["exposure"].state == "on":
        gains = dict.fromkeys(names, 0.0)
        gains.update(
            {names[image]: round(float(gain), 5) for image, gain in zip(water.images, fit.log_gains, strict=True)}
        )
        starts["exposure"] = {"log_gains": gains}
    return starts


def _water(water: WaterFindings) -> dict[str, Any] | None:
    fit = water.fit
    if fit is None or not fit.family.attenuation:
        return None
    values = {name: getattr(fit, name) for name in ("beta_D", "beta_B", "B")}

    def rounded(of: dict[str, np.ndarray]) -> dict[str, list[Any]]:
        names = {"B": "B_inf"}
        return {names.get(name, name): np.round(value.clip(min=0), 6).tolist() for name, value in of.items()}

    return rounded(values) | {"light": "linear", "per": "unit", "intervals": rounded(water.intervals)}


# What it costs --------------------------------------------------------------------------------------------------------


def measured_costs(width: int, height: int, backend: str = "auto") -> dict[str, float]:
    """Milliseconds that each effect adds to an iteration, forward and backward, at TIMED_GAUSSIANS Gaussians and
    pictures of width x height, with TIMED_LABELS labels where things get names; 0 for what changes only which
    photographs there are, or what is known already."""
    device = device_for(backend)
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator).to(device).requires_grad_()

    colors, picture, distances = random(TIMED_GAUSSIANS, 3), random(height, width, 3), random(height, width)
    offsets = random(TIMED_GAUSSIANS, 3).detach() + 1
    features, targets = random(TIMED_GAUSSIANS, DIMENSIONS), random(TIMED_GAUSSIANS, DIMENSIONS).detach()
    weights = random(height, width, 3).detach()
    medium = Medium.starting(2.0).to(device)
    lamp, exposure = Lamp(torch.zeros((), device=device), 2.0), Exposure(torch.zeros(1, 1, device=device), [""])
    illumination = Illumination.starting([""], width, height)
    illumination.log_light = illumination.log_light.to(device)
    for tensor in (*medium.parameters().values(), lamp.log_tau, exposure.raw, illumination.log_light):
        tensor.requires_grad_()
    camera = Camera("", width, height, width, width, width / 2, height / 2, np.eye(4))
    viewmat, K = (
        torch.as_tensor(matrix, dtype=torch.float32).to(device) for matrix in (camera.world_to_camera, camera.K)
    )
    solid = torch.ones(height, width, device=device)
    places = np.random.default_rng(0).uniform(-1, 1, (TIMED_GAUSSIANS, 3)) * [1, height / width, 0.01] + [0, 0, 2]
    unseen = np.zeros(len(places))
    cloud = gaussians_from_points(
        Points(places, np.zeros(places.shape, np.uint8), unseen, unseen), len(places), 0, 0, np.zeros(3)
    ).to(device)
    labels = np.arange(width) * TIMED_LABELS // width + np.ones((height, 1), int)

    def names() -> Tensor:
        return semantic_loss(features, targets, labels_in_view(cloud, camera, labels, backend) > 0)

    def prior() -> Tensor:
        return depth_loss(distances + 1, solid, solid * 0.5, 2.0)

    work: dict[str, Callable[[], Tensor]] = {
        "attenuation": lambda: through_water(colors, offsets, medium, backend=backend).sum(),
        "backscatter": lambda: (open_water(medium, viewmat, K, width, height, backend=backend) * weights).sum(),
        "lamp": lambda: lit(colors, offsets.norm(dim=1), lamp).sum(),
        "exposure": lambda: (exposed(picture, exposure, "") * weights).sum(),
        "caustics": lambda: (illuminated(picture, illumination, "") * weights).sum(),
        "semantics": names,
        "depth_prior": prior,
    }
    costs = dict.fromkeys(EFFECTS, 0.0) | {name: _milliseconds(once, device) for name, once in work.items()}
    return costs | {"semantics": costs["semantics"] / EVERY}


def _milliseconds(once: Callable[[], Tensor], device: torch.device) -> float:
    """Least time of a forward and backward pass: what else the machine does is not the effect's."""
    times = []
    for _ in range(TIMINGS + 1):
        started = time.perf_counter()
        once().backward()
        if device.type == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - started)
    return 1000 * min(times[1:])


# Showing it -----------------------------------------------------------------------------------------------------------

STATES = {"on": "on", "off": "off", "unknown": "cannot tell"}


def describe(plan: Plan) -> str:
    """The plan as a table for a terminal: effect, state, cost, reason; then the water that training starts from."""
    lines = []
    for name, effect in plan.effects.items():
        title = name.replace("_", " ")
        lines.append(f"{title:<21}{STATES[effect.state]:<13}{effect.cost_ms:6.2f} ms  {effect.reason}")
    if plan.water and plan.on("attenuation"):
        lines.append("")
        titles = {"beta_D": "attenuation per unit"}
        if plan.on("backscatter"):
            titles |= {"beta_B": "backscatter per unit", "B_inf": "open water"}
        for key, title in titles.items():
            figures = "  ".join(
                f"{color} {value:.4f} ({low:.4f} to {high:.4f})"
                for color, value, low, high in zip(
                    ("red", "green", "blue"), plan.water[key], *plan.water["intervals"][key], strict=True
                )
            )
            lines.append(f"{title:<21}{figures}")
    return "\n".join(lines)
