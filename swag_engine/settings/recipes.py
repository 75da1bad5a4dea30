"""Training methods as values of one configuration; docs/recipes.md compares each with the published method."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from ..base.errors import InputError
from .effect_names import EFFECTS, PARTS, parse_effects

Weights = tuple[float, float]
"""A loss weight at the start and at the end of the run, interpolated linearly unless stated otherwise."""


@dataclass(frozen=True)
class Photometric:
    """Weights of the terms that compare a rendered image with its training image.

    Attributes:
        l1: Weight of the mean absolute error.
        ssim: Weight of 1 - SSIM.
        l2: Weight of the mean squared error.
    """

    l1: Weights = (0.8, 0.8)
    ssim: float = 0.2
    l2: Weights = (0.0, 0.0)


TRUE_L2 = Photometric(l1=(0.05, 0.05), ssim=0.0, l2=(0.9, 0.9))
"""The error that PSNR measures. With SWAGSplatting's own weights the absolute error dominates stage two: its gradient
is 19 times that of the squared error at 30 dB."""


@dataclass(frozen=True)
class Recipe:
    """A training method: what it computes in addition to 3D Gaussian splatting (arXiv 2308.04079).

    A loss term of weight 0 is not computed.
    """

    description: str = field(default="", compare=False)
    """One line for the user, without a full stop."""
    planned: bool = False
    """Whether the scene's plan (planning/plan.py) decides which effects to model; otherwise `effects` does."""
    effects: frozenset[str] = frozenset()
    """Names of the effects that are modelled."""

    medium: Literal["analytic", "network"] = "analytic"
    """Water model: coefficients for the whole scene (water/medium.py), or a network of viewing direction and range
    (water/network.py)."""
    light: Literal["linear", "srgb"] = "linear"
    """Values that the water model works on: linear light or sRGB display values."""
    water_from: float = 0.0
    """Fraction of the run after which the water is modelled."""
    water_rate: float = 3e-3
    """Initial learning rate (Adam) of the water's unconstrained coefficients; decays to 0 as a cosine."""
    B_inf_rate: float = 3e-3
    """Initial learning rate of the background light. It may be larger: sparse points show little of that light."""
    B_inf_degrees_from: float = 0.4
    """Fraction of the run after which the background light may change with direction."""
    water_fit_at: float = 1.0
    """Fraction of the run at which the water is fitted to the light of the Gaussians (training/water_fit.py); then it
    stays as it is."""

    photometric: Photometric = Photometric()
    relative: bool = False
    """Whether residuals are divided by the rendered brightness (WaterSplatting), so that dark, distant parts count as
    much as bright ones."""

    stage_two_from: float = 1.0
    """Fraction of the run after which geometry and water are frozen and only appearance is optimised."""
    photometric_two: Photometric = TRUE_L2
    """Weights in stage two."""

    densification: Literal["default", "mcmc"] = "default"
    """Strategy that adds and removes Gaussians (gaussians/densify.py)."""
    densify_until: float = 0.6
    """Fraction of the run after which the number of Gaussians stays the same."""
    undimmed_densification: bool = False
    """Whether the gradients that densification compares are divided by the water's transmission (UW-GS)."""
    reallocation: Literal["off", "balanced", "identical"] = "off"
    """Whether Gaussians that contribute least are moved to where the error is largest: as clones whose opacities keep
    the rendered image, or as identical copies."""

    dropout: float = 0.0
    """Largest fraction of the Gaussians that an iteration drops at random where the run overfits
    (training/dropout.py)."""

    depth_weight: float = 0.1
    """Initial weight of the depth prior, where it is on; decays geometrically to a tenth until stage two."""
    grey_world: float = 0.0
    """Weight of the term that makes the restored image grey on average."""
    grey_world_target: Literal["mean", "middle"] = "mean"
    """Grey of the restored image's own mean, or middle grey."""
    coverage: float = 0.0
    """Weight of the term that makes surfaces opaque in front of open water."""
    coverage_of_color: float = 0.0
    """Weight of the term that makes surfaces opaque in front of a learned background color."""
    smoothness: float = 0.0
    """Weight of the term that makes range smooth where the image is smooth."""
    smoothness_edges: Literal["image", "render"] = "image"
    """Image whose edges allow edges in range."""
    hinge: float = 0.0
    """Weight of the term that keeps the order of attenuation between the channels."""
    hinge_order: Literal["fitted", "oceanic"] = "fitted"
    """The order fitted to the sparse points, or red above green above blue."""
    range_consistency: float = 0.0
    """Weight of the difference between the Gaussians' range and the range that the network's transmission implies
    (L_ca of SWAGSplatting)."""
    frame_weight: float = 0.1
    """Weight of interpolated frames, where they are on."""
    salient_densification: bool = False
    """Whether salient regions are densified, and reallocated to, first."""
    salient_pixels: bool = False
    """Whether pixels of salient regions weigh more in the loss."""
    open_water: float = 0.0
    """Weight of the terms that keep open water free of Gaussians and fit the background light to its pixels."""
    class_pruning: bool = False
    """Whether Gaussians of haze, fish and open water are removed."""

    @property
    def uses_regions(self) -> bool:
        """Whether the images have to be segmented into regions."""
        return "semantics" in self.effects or any(
            (self.salient_densification, self.salient_pixels, self.open_water, self.class_pruning)
        )


PAPER_LOSS = Photometric(l1=(0.56, 0.96), ssim=0.2, l2=(0.0, 0.1))
PAPER_LOSS_TWO = Photometric(l1=(0.7, 1.2), ssim=0.0, l2=(0.9, 0.9))

WATER = frozenset({"attenuation", "backscatter", "separate_backscatter"})
"""Effects of methods that always model the water."""

DROPOUT = 0.1
"""Largest fraction that is dropped: .2 blurs, and without dropout long runs overfit (docs/accuracy.md)."""

RECIPES: dict[str, Recipe] = {
    "swag": Recipe(
        "Models the water and the effects that the scene calls for, and removes them",
        planned=True,
        water_rate=1e-3,
        B_inf_rate=1e-2,
        water_fit_at=0.7,
        stage_two_from=0.9,
        dropout=DROPOUT,
        coverage=0.3,
        coverage_of_color=0.03,
    ),
    "3dgs": Recipe("Plain Gaussian splatting: the scene as photographed"),
    "seasplat": Recipe(
        "Follows SeaSplat",
        effects=WATER,
        light="srgb",
        water_from=0.33,
        B_inf_degrees_from=1.0,
        grey_world=0.02,
        smoothness=0.05,
    ),
    "uw-gs": Recipe(
        "Follows UW-GS",
        effects=WATER | {"depth_prior"},
        light="srgb",
        B_inf_degrees_from=1.0,
        undimmed_densification=True,
    ),
    "watersplatting": Recipe(
        "Follows WaterSplatting", effects=WATER, light="srgb", B_inf_degrees_from=0.0, relative=True
    ),
    "rusplatting": Recipe(
        "Follows RUSplatting", effects=WATER | {"interpolation"}, light="srgb", B_inf_degrees_from=1.0, smoothness=0.05
    ),
    "paper": Recipe(
        "Follows SWAGSplatting as published",
        effects=WATER | {"depth_prior", "interpolation"},
        medium="network",
        light="srgb",
        photometric=PAPER_LOSS,
        stage_two_from=0.6,
        photometric_two=PAPER_LOSS_TWO,
        densify_until=0.4,
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
    "dropout": ({"dropout": DROPOUT}, {"dropout": 0.0}),
    "reallocation": ({"reallocation": "balanced"}, {"reallocation": "off"}),
    "grey_world": ({"grey_world": 0.02}, {"grey_world": 0.0}),
    "smoothness": ({"smoothness": 0.05}, {"smoothness": 0.0}),
    "hinge": ({"hinge": 1e-3}, {"hinge": 0.0}),
    "salient_densification": ({"salient_densification": True}, {"salient_densification": False}),
    "salient_pixels": ({"salient_pixels": True}, {"salient_pixels": False}),
    "open_water": ({"open_water": 0.1}, {"open_water": 0.0}),
    "class_pruning": ({"class_pruning": True}, {"class_pruning": False}),
}
"""Values of the recipe with and without each part of the method."""
assert set(SWITCHES) == set(PARTS)


def recipe_of(name: str, effects: str = "", planned: Mapping[str, bool] | None = None) -> Recipe:
    """Return a recipe with the plan's effects and the user's choices applied.

    Args:
        name: Name of the recipe.
        effects: Choices such as "water=off,lamp=on"; they override the plan.
        planned: Whether the plan has each effect on, by name; used only by recipes that follow a plan.

    Returns:
        The recipe. A part that is switched on and was on already keeps the recipe's values.

    Raises:
        InputError: For an unknown recipe, effect or state.
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
