"""Methods as values of one configuration; docs/recipes.md says line by line what each shares with its namesake."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from ..base.errors import InputError
from .effect_names import EFFECTS, PARTS, parse_effects

Weights = tuple[float, float]
"""A loss weight at the start and at the end of the run; linear between, unless said otherwise."""


@dataclass(frozen=True)
class Photometric:
    """Weights of what compares picture and photograph: mean absolute error, 1 - SSIM and mean square error."""

    l1: Weights = (0.8, 0.8)
    ssim: float = 0.2
    l2: Weights = (0.0, 0.0)


TRUE_L2 = Photometric(l1=(0.05, 0.05), ssim=0.0, l2=(0.9, 0.9))
"""What PSNR measures; SWAGSplatting's own weights leave stage two to the absolute error (19:1 in gradient at 30 dB)."""


@dataclass(frozen=True)
class Recipe:
    """What a run computes beside plain Gaussian splatting (arXiv 2308.04079). A weight of 0 is not computed at all."""

    planned: bool = False
    """Let the plan of the scene (planning/plan.py) decide which effects to model; else only what the recipe names."""
    effects: frozenset[str] = frozenset()
    """Names of the effects that are modelled."""

    medium: Literal["analytic", "network"] = "analytic"
    """Coefficients of the whole scene (water/medium.py), or a network of direction and range (water/network.py)."""
    light: Literal["linear", "srgb"] = "linear"
    """What the water's formula works on."""
    water_from: float = 0.0
    """Share of the run after which the water joins."""
    water_rate: float = 3e-3
    """Adam's step size for the water's raw coefficients at the start; falls to 0 as a cosine."""
    veil_rate: float = 3e-3
    """The same for the water's colour: the sparse points see little of it where the water is endless."""
    veil_degrees_from: float = 0.4
    """Share of the run after which the water's colour may change with direction."""

    photometric: Photometric = Photometric()
    relative: bool = False
    """Divide residuals by the rendered brightness (WaterSplatting): dark, far parts count as much as bright ones."""

    stage_two_from: float = 1.0
    """Share of the run after which geometry and water are frozen, and only appearance goes on."""
    photometric_two: Photometric = TRUE_L2
    """Weights in stage two."""

    growth: Literal["default", "mcmc"] = "default"
    grow_until: float = 0.5
    """Share of the run after which the number of Gaussians stays."""
    undimmed_growth: bool = False
    """Weigh what a Gaussian is pulled with by how much of it the water lets through (UW-GS)."""
    reallocation: Literal["off", "balanced", "identical"] = "off"
    """Move Gaussians from where they show least to where the error is largest: clones that keep the picture, or
    identical copies."""

    dropout: float = 0.0
    """Largest fraction of the Gaussians that an iteration drops at random where the run overfits
    (training/dropout.py)."""

    depth_weight: float = 0.1
    """Weight of the depth prior at the start, where it is on; falls to a tenth geometrically until stage two."""
    grey_world: float = 0.0
    """Weight of the restored picture being grey on average."""
    grey_world_target: Literal["mean", "middle"] = "mean"
    """Grey like its own mean, or middle grey."""
    smoothness: float = 0.0
    """Weight of range being smooth where the picture is."""
    smoothness_edges: Literal["photograph", "render"] = "photograph"
    hinge: float = 0.0
    """Weight of the channels' attenuation keeping its order."""
    hinge_order: Literal["fitted", "oceanic"] = "fitted"
    """The order that the sparse points gave, or red over green over blue."""
    range_consistency: float = 0.0
    """Weight of the range that the network's transmission implies being the Gaussian's (recipe paper's L_ca)."""
    frame_weight: float = 0.1
    """Weight of interpolated frames, where they are on."""
    salient_growth: bool = False
    """Grow, and reallocate to, what stands out in the photographs more than the rest."""
    salient_pixels: bool = False
    """Let pixels of what stands out count more than the rest."""
    open_water: float = 0.0
    """Weight of open water being empty, and of the water's own colour being that of its pixels."""
    class_pruning: bool = False
    """Drop Gaussians of haze, fish and open water."""

    @property
    def uses_regions(self) -> bool:
        """Whether the photographs have to be parted into regions."""
        return "semantics" in self.effects or any(
            (self.salient_growth, self.salient_pixels, self.open_water, self.class_pruning)
        )


PAPER_LOSS = Photometric(l1=(0.56, 0.96), ssim=0.2, l2=(0.0, 0.1))
PAPER_LOSS_TWO = Photometric(l1=(0.7, 1.2), ssim=0.0, l2=(0.9, 0.9))

WATER = frozenset({"attenuation", "backscatter", "separate_backscatter"})
"""Effects of methods that always model the water."""

RECIPES: dict[str, Recipe] = {
    "swag": Recipe(planned=True, water_rate=1e-3, veil_rate=1e-2, stage_two_from=0.9, dropout=0.2),
    "3dgs": Recipe(),
    "seasplat": Recipe(
        effects=WATER, light="srgb", water_from=0.33, veil_degrees_from=1.0, grey_world=0.02, smoothness=0.05
    ),
    "uw-gs": Recipe(effects=WATER | {"depth_prior"}, light="srgb", veil_degrees_from=1.0, undimmed_growth=True),
    "watersplatting": Recipe(effects=WATER, light="srgb", veil_degrees_from=0.0, relative=True),
    "rusplatting": Recipe(effects=WATER | {"interpolation"}, light="srgb", veil_degrees_from=1.0, smoothness=0.05),
    "paper": Recipe(
        effects=WATER | {"depth_prior", "interpolation"},
        medium="network",
        light="srgb",
        photometric=PAPER_LOSS,
        stage_two_from=0.6,
        photometric_two=PAPER_LOSS_TWO,
        grow_until=0.4,
        reallocation="identical",
        grey_world=1.0,
        grey_world_target="middle",
        smoothness=0.05,
        smoothness_edges="render",
        hinge=1e-3,
        hinge_order="oceanic",
        range_consistency=0.1,
    ),
}

SWITCHES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "stages": ({"stage_two_from": 0.6}, {"stage_two_from": 1.0}),
    "dropout": ({"dropout": 0.2}, {"dropout": 0.0}),
    "reallocation": ({"reallocation": "balanced"}, {"reallocation": "off"}),
    "grey_world": ({"grey_world": 0.02}, {"grey_world": 0.0}),
    "smoothness": ({"smoothness": 0.05}, {"smoothness": 0.0}),
    "hinge": ({"hinge": 1e-3}, {"hinge": 0.0}),
    "salient_growth": ({"salient_growth": True}, {"salient_growth": False}),
    "salient_pixels": ({"salient_pixels": True}, {"salient_pixels": False}),
    "open_water": ({"open_water": 0.1}, {"open_water": 0.0}),
    "class_pruning": ({"class_pruning": True}, {"class_pruning": False}),
}
"""Values of the recipe with and without each part of the method."""
assert set(SWITCHES) == set(PARTS)


def recipe_of(name: str, effects: str = "", planned: Mapping[str, bool] | None = None) -> Recipe:
    """The recipe `name` with the effects that a plan has on (`planned`, by name), where the recipe takes a plan, and
    with switches such as "water=off,lamp=on" applied.

    Switching on what the recipe has keeps the recipe's own values. Raises InputError for unknown names and states.
    """
    if name not in RECIPES:
        raise InputError(f"The setting recipe must be one of {', '.join(RECIPES)}, not {name!r}.")
    recipe, choices = RECIPES[name], parse_effects(effects)
    if recipe.planned and planned:
        # Labels change no pixel and can be assigned after training (`label`): they are learned only on request.
        choices = {effect: on for effect, on in planned.items() if effect != "semantics"} | choices
    return switched(recipe, choices)


def switched(recipe: Recipe, choices: Mapping[str, bool]) -> Recipe:
    """Switch effects and parts of a recipe.

    Args:
        recipe: The recipe.
        choices: Whether each is on, by name; parts that are on already keep their values.

    Returns:
        The changed recipe.
    """
    for name, chosen in choices.items():
        if name in EFFECTS:
            recipe = replace(recipe, effects=recipe.effects | {name} if chosen else recipe.effects - {name})
        elif not chosen:
            recipe = replace(recipe, **SWITCHES[name][1])
        elif not has(recipe, name):
            recipe = replace(recipe, **SWITCHES[name][0])
    return recipe


def has(recipe: Recipe, name: str) -> bool:
    """Return whether a recipe has an effect or a part on."""
    if name in EFFECTS:
        return name in recipe.effects
    return any(getattr(recipe, field) != value for field, value in SWITCHES[name][1].items())
