"""Which runs a tradeoff compares. Imported by the command line: nothing heavy here."""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

from ..base.errors import InputError
from ..settings.presets import PRESETS
from ..settings.settings import TrainSettings

DEFAULT = "default"
"""The word for a recipe's own effects."""


@dataclass(frozen=True)
class Grid:
    """The runs: all combinations of these. 0 stands for what the preset has."""

    presets: tuple[str, ...] = tuple(PRESETS)
    """How fine: draft, standard, high."""
    iterations: tuple[int, ...] = (0,)
    """Numbers of optimisation steps, in place of the presets' own."""
    widths: tuple[int, ...] = (0,)
    """Widths in pixels that the photographs are trained at, in place of the presets' own."""
    max_gaussians: tuple[int, ...] = (0,)
    """Most Gaussians that the scene may grow to, in place of the presets' own."""
    effects: tuple[str, ...] = (DEFAULT, "water=off")
    """Sets of parts switched by hand (docs/recipes.md), and default for none."""
    recipe: str = "swag"
    """The method."""
    seed: int = 0
    """Seed of everything random."""

    def runs(self) -> list["Run"]:
        """Every combination, in the order of the grid; of those that mean the same run the first.

        Raises InputError for a value that cannot be trained with, or no run at all.
        """
        found: list[Run] = []
        alike: list[TrainSettings] = []
        for preset, effects, width, iterations, gaussians in product(
            self.presets, self.effects, self.widths, self.iterations, self.max_gaussians
        ):
            choices: dict[str, Any] = {"preset": preset, "recipe": self.recipe, "seed": self.seed}
            choices |= {"iterations": iterations, "width": width, "max_gaussians": gaussians}
            settings = TrainSettings(effects="" if effects == DEFAULT else effects, **choices).sized()
            if (without_preset := replace(settings, preset="standard")) in alike:
                continue
            alike.append(without_preset)
            own = ["" if effects == DEFAULT else effects, f"{settings.iterations} iterations" if iterations else ""]
            own += [f"{settings.width} px" if width else "", f"{settings.max_gaussians} Gaussians" if gaussians else ""]
            several = [
                len(set(values)) > 1 for values in (self.effects, self.iterations, self.widths, self.max_gaussians)
            ]
            varied = [word for word, varies in zip(own, several, strict=True) if word and varies]
            name = ", ".join([*([preset] if len(self.presets) > 1 or not varied else []), *varied])
            sizes = f"{settings.iterations}-{settings.width}px-{settings.max_gaussians}"
            folder = "-".join(filter(None, (self.recipe, own[0].replace(",", "-"), sizes, f"seed{self.seed}")))
            found.append(Run(name, folder, settings))
        if not found:
            raise InputError("There is nothing to run: name at least one preset, width, length and set of effects.")
        return found


@dataclass(frozen=True)
class Run:
    """One run of a grid. name: what tells it from the others; folder: the same whatever else the grid holds."""

    name: str
    folder: str
    settings: TrainSettings
