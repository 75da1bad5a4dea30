"""Methods as sets of switches on one configuration."""

from dataclasses import dataclass

RECIPE_NAMES = ("swag", "3dgs")


@dataclass(frozen=True)
class Recipe:
    """What a run computes beside plain Gaussian splatting."""

    water: bool = False
    """Model the water, where the scene's points say that there is some."""
    water_rate: float = 3e-3
    """Adam's step size for the water's raw parameters at the start; falls to 0 as a cosine."""
    veil_degrees_from: float = 0.4
    """Share of the run after which the water's colour may change with direction."""


RECIPES = {"swag": Recipe(water=True), "3dgs": Recipe()}
