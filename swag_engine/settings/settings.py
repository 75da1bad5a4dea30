"""The one configuration of a training run; command line, Blender and docs/cli.md are made from its fields."""

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from ..base.errors import InputError
from .field import check_settings, setting
from .jerlov import water_of_type
from .presets import PRESETS, Size, seconds_of
from .recipes import RECIPES, recipe_of

BACKENDS = {
    "auto": "The fastest that runs on this machine",
    "cpu": "Native code on the processor",
    "cuda": "Native code on an NVIDIA graphics card",
    "wgpu": "Native code on a graphics card of any make, through Vulkan, Metal or DirectX 12",
    "torch": "PyTorch without native code: slow, the reference for the others",
}
"""What computes, with a description of each."""


@dataclass(frozen=True)
class TrainSettings:
    """What a user chooses about a run.

    Raises:
        InputError: For a value that cannot be trained with.
    """

    recipe: str = setting(
        "swag",
        "Method",
        "Which method trains the scene (docs/recipes.md)",
        choices={name: recipe.description for name, recipe in RECIPES.items()},
    )
    preset: str = setting(
        "standard",
        "Quality",
        "How long to train and at which size",
        choices={name: size.description for name, size in PRESETS.items()},
    )
    time_budget: str = setting(
        "",
        "Time Budget",
        "Time that the whole run may take, such as 90s, 10m or 1h30m; the size is then chosen by measuring this "
        "machine, in place of a preset",
    )
    iterations: int = setting(
        0,
        "Iterations",
        "Number of optimisation steps, each on one image",
        least=1,
        most=10_000_000,
        zero="as many as the preset has",
    )
    width: int = setting(
        0,
        "Width",
        "Width in pixels of the training images; smaller images keep their size",
        least=8,
        most=20_000,
        unit="px",
        zero="as the preset has it",
    )
    max_gaussians: int = setting(
        0,
        "Max Gaussians",
        "Largest number of Gaussians that densification may reach",
        least=1,
        most=100_000_000,
        zero="as many as the preset has",
    )
    stop_when_flat: bool = setting(
        False,
        "Stop Early",
        "End early when a fifth of the run has improved the validation PSNR by less than 0.05 dB",
    )
    effects: str = setting(
        "",
        "Effects",
        "Effects and parts of the method to switch by hand, such as water=off,lamp=on (docs/recipes.md lists them)",
    )
    words: str = setting(
        "",
        "Words",
        "What to label while training with semantics on, such as coral, wreck, open water; needs pretrained networks",
    )
    masks: str = setting(
        "",
        "Masks",
        "Folder of mask images to label by instead of words; without both, masks in the scene's folder labels are "
        "used, or else saliency",
        is_folder=True,
    )
    water_type: str = setting(
        "auto",
        "Water Type",
        "Initial attenuation of the water: auto fits it to the photos; or a Jerlov type (I IA IB II III 1C 3C 5C 7C "
        "9C), or three numbers per metre for red, green and blue, such as 0.3,0.1,0.06",
    )
    metres_per_unit: float = setting(
        0.0,
        "Metres per Unit",
        "Length in metres of one unit of the scene's coordinates",
        least=1e-9,
        most=1e9,
        unit="m",
        zero="that of the scene's scale.json, unknown without the file",
    )
    sh_degree: int = setting(
        3,
        "SH Degree",
        "Degree of the spherical harmonics, which let color change with the viewing direction",
        least=0,
        most=3,
    )
    seed: int = setting(
        0,
        "Seed",
        "Seed of everything random: the same seed on the same machine gives the same result",
        least=0,
        most=2**31 - 1,
    )
    backend: str = setting("auto", "Backend", "What computes", choices=BACKENDS)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.budget and self.iterations:
            raise InputError("Give a number of iterations or a time budget, not both.")
        recipe_of(self.recipe, self.effects)
        if self.water_type != "auto":
            # Without a scale the scene may have one: that shows when it is read.
            water_of_type(self.water_type, self.metres_per_unit or 1.0)

    def sized(self) -> "TrainSettings":
        """Return the settings with the preset's numbers where none are given; unchanged with a time budget."""
        if self.budget:
            return self
        preset = PRESETS[self.preset].numbers()
        return replace(self, **{name: getattr(self, name) or number for name, number in preset.items()})

    @property
    def size(self) -> Size:
        """The sizes, 0 where the user gave none."""
        return Size(self.iterations, self.width, self.max_gaussians)

    @property
    def budget(self) -> float:
        """Seconds that the run may take; 0 where only its iterations limit it."""
        return seconds_of(self.time_budget)

    def to_json(self) -> dict[str, Any]:
        """Return a plain dict that `from_json` reads."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "TrainSettings":
        """Read settings from a plain dict.

        Args:
            values: Values by name; missing ones take their defaults.

        Returns:
            The settings.

        Raises:
            InputError: For an unknown name or a wrong value.
        """
        unknown = sorted(set(values) - {field.name for field in fields(cls)})
        if unknown:
            raise InputError(f"Unknown training setting: {', '.join(unknown)}.")
        return cls(**values)
