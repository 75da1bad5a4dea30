"""The runs that a tradeoff compares. The command line imports this at its start: no heavy packages here."""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

from ..base.errors import InputError
from ..settings.field import check_settings, setting
from ..settings.presets import PRESETS
from ..settings.recipes import RECIPES
from ..settings.settings import TrainSettings

DEFAULT = "default"
"""Word for the effects of the plan."""


@dataclass(frozen=True)
class Grid:
    """Runs of a tradeoff: all combinations of these values.

    Raises:
        InputError: For a value of another type, or a preset or method that there is not. The ranges of numbers are
            those of `TrainSettings`, which `runs` checks.
    """

    presets: tuple[str, ...] = setting(
        tuple(PRESETS),
        "Presets",
        "Presets to train with",
        choices={name: size.description for name, size in PRESETS.items()},
    )
    iterations: tuple[int, ...] = setting(
        (0,), "Iterations", "Numbers of optimisation steps", zero="as many as the preset has"
    )
    widths: tuple[int, ...] = setting(
        (0,), "Widths", "Widths in pixels of the training images", zero="as the preset has it"
    )
    max_gaussians: tuple[int, ...] = setting(
        (0,), "Max Gaussians", "Largest numbers of Gaussians", zero="as many as the preset has"
    )
    effects: tuple[str, ...] = setting(
        (DEFAULT, "water=off"),
        "Effects",
        "Sets of effects switched by hand, as in --effects of train; default stands for none",
    )
    recipe: str = setting(
        "swag",
        "Method",
        "Method of all runs (docs/recipes.md)",
        choices={name: recipe.description for name, recipe in RECIPES.items()},
    )
    seed: int = setting(0, "Seed", "Seed of all random numbers")

    def __post_init__(self) -> None:
        check_settings(self)

    def runs(self) -> list["Run"]:
        """List all combinations in the order of the grid, each run once.

        Returns:
            The runs.

        Raises:
            InputError: For a value that cannot be trained with, or when there is no run.
        """
        found: list[Run] = []
        alike: list[TrainSettings] = []
        for preset, effects, width, iterations, gaussians in product(
            self.presets, self.effects, self.widths, self.iterations, self.max_gaussians
        ):
            choices: dict[str, Any] = {"preset": preset, "recipe": self.recipe, "seed": self.seed}
            choices |= {"iterations": iterations, "width": width, "max_gaussians": gaussians}
            settings = TrainSettings(effects="" if effects == DEFAULT else effects, **choices)
            left_to_preset = not all(settings.size.numbers().values())
            if (unlike := settings if left_to_preset else replace(settings, preset=TrainSettings.preset)) in alike:
                continue
            alike.append(unlike)
            own = ["" if effects == DEFAULT else effects, f"{iterations} iterations" if iterations else ""]
            own += [f"{width} px" if width else "", f"{gaussians} Gaussians" if gaussians else ""]
            several = [
                len(set(values)) > 1 for values in (self.effects, self.iterations, self.widths, self.max_gaussians)
            ]
            varied = [word for word, varies in zip(own, several, strict=True) if word and varies]
            name = ", ".join([*([preset] if len(self.presets) > 1 or not varied else []), *varied])
            words = [word.replace(",", "-").replace(" ", "") for word in own]
            parts = (self.recipe, preset if left_to_preset else "", *words, f"seed{self.seed}")
            found.append(Run(name, "-".join(filter(None, parts)), settings))
        if not found:
            raise InputError(
                "There is nothing to run: give at least one preset, width, number of iterations and set of effects."
            )
        return found


@dataclass(frozen=True)
class Run:
    """One run of a grid.

    Attributes:
        name: The values in which it differs from the other runs.
        folder: Name of its folder, which does not depend on the other runs.
        settings: Its settings, in which sizes that are left to the preset are 0.
    """

    name: str
    folder: str
    settings: TrainSettings
