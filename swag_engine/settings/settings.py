"""The one configuration of a training run. Command line and Blender mirror it; nothing else defines a setting."""

from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal

from ..base.errors import InputError
from .jerlov import water_of_type
from .presets import PRESETS, Preset, seconds_of
from .recipes import RECIPES, recipe_of

BACKENDS = ("auto", "cpu", "cuda", "torch")
SIZES = ("iterations", "width", "max_gaussians")
"""What a preset or a time budget chooses, where the user does not."""


@dataclass(frozen=True)
class TrainSettings:
    """What a user chooses about a run. Raises InputError for a value that cannot be trained with."""

    recipe: Literal["swag", "3dgs", "seasplat", "uw-gs", "watersplatting", "rusplatting", "paper"] = "swag"
    """The method: swag models the water and takes it away, 3dgs shows the place as photographed; the others follow
    published ones (docs/recipes.md)."""
    effects: str = ""
    """Parts of the method switched by hand, as in water=off,lamp=on (docs/recipes.md has their names)."""
    water_type: str = "auto"
    """Water to start from: auto asks the photographs; a Jerlov type (I IA IB II III 1C 3C 5C 7C 9C), or attenuation of
    red, green and blue per metre as in 0.3,0.1,0.06."""
    words: str = ""
    """What to label while training with semantics=on, as in coral, wreck, open water; needs networks."""
    masks: str = ""
    """Folder of masks to label by instead; without both, the scene's own folder labels, or what stands out."""
    metres_per_unit: float = 0.0
    """Metres that one unit of the scene's coordinates is; 0 where that is not known."""
    preset: Preset = "standard"
    """How fine: draft to see whether it works, standard, or high for the result to keep."""
    time_budget: str = ""
    """Time that the whole run may take, as in 90s, 10m or 1h30m, in place of a preset: what this machine can do in it
    is found by measuring."""
    iterations: int = 0
    """Number of optimisation steps, each looks at one photograph; 0: as many as the preset has."""
    width: int = 0
    """Width in pixels that the photographs are trained at, smaller ones keep their size; 0: as the preset has it."""
    max_gaussians: int = 0
    """Most Gaussians that the scene may grow to; 0: as many as the preset has."""
    stop_when_flat: bool = False
    """End early when a fifth of the run has gained less than .05 dB on the validation photographs."""
    sh_degree: int = 3
    """Degree of the spherical harmonics that let colour change with direction, 0 to 3."""
    seed: int = 0
    """Seed of everything random: the same seed on the same machine gives the same result."""
    backend: Literal["auto", "cpu", "cuda", "torch"] = "auto"
    """What computes: the native CPU kernels, the CUDA kernels, plain torch (slow), or the fastest that runs here."""

    def __post_init__(self) -> None:
        limits = {
            "iterations": (1, 10_000_000),
            "width": (8, 20_000),
            "max_gaussians": (1, 100_000_000),
            "sh_degree": (0, 3),
            "seed": (0, 2**31 - 1),
        }
        for setting in fields(self):
            value = getattr(self, setting.name)
            if isinstance(setting.default, str) and not isinstance(value, str):
                raise InputError(f"The setting {setting.name.replace('_', ' ')} must be a text, not {value!r}.")
        for name, choices in (("recipe", RECIPES), ("backend", BACKENDS), ("preset", PRESETS)):
            value = getattr(self, name)
            if value not in choices:
                raise InputError(f"The setting {name} must be one of {', '.join(choices)}, not {value!r}.")
        if not isinstance(self.time_budget, str):
            raise InputError(f"The time budget must be a text such as 10m, not {self.time_budget!r}.")
        if not isinstance(self.stop_when_flat, bool):
            raise InputError(f"The setting stop when flat must be true or false, not {self.stop_when_flat!r}.")
        if self.budget and self.iterations:
            raise InputError("Give a number of iterations or a time budget, not both.")
        for name, (least, most) in limits.items():
            value = getattr(self, name)
            if name in SIZES and value == 0 and not isinstance(value, bool):
                continue
            if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
                title = name.replace("_", " ")
                raise InputError(f"The setting {title} must be a whole number from {least} to {most}, not {value!r}.")
        recipe_of(self.recipe, self.effects)
        if not (isinstance(self.metres_per_unit, int | float) and 0 <= self.metres_per_unit < 1e9):
            raise InputError(
                f"The setting metres per unit must be a positive number, or 0 where it is not known, not "
                f"{self.metres_per_unit!r}."
            )
        if self.water_type != "auto":
            water_of_type(self.water_type, self.metres_per_unit)

    def sized(self) -> "TrainSettings":
        """With the preset's numbers where none are given, and no time budget takes their place."""
        if self.budget:
            return self
        preset = PRESETS[self.preset]
        return replace(self, **{name: getattr(self, name) or getattr(preset, name) for name in SIZES})

    @property
    def budget(self) -> float:
        """Seconds that the run may take; 0 where only its iterations limit it."""
        return seconds_of(self.time_budget)

    def to_json(self) -> dict[str, Any]:
        """A plain dict that `from_json` reads back."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "TrainSettings":
        """Settings from a plain dict; names left out take their defaults. Raises InputError for unknown names."""
        unknown = sorted(set(values) - {field.name for field in fields(cls)})
        if unknown:
            raise InputError(f"Unknown training setting: {', '.join(unknown)}.")
        return cls(**values)
