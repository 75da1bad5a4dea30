"""The size of a run that suits its photos and its machine, where the user leaves it to a preset."""

from dataclasses import asdict, dataclass, replace
from typing import Any

from ...kernels.hardware import hardware_of
from ...scene.colmap import Scene
from ...scene.resolved_width import resolved_width
from ...settings.presets import CARD_PRESETS, LADDER, PRESETS, SIZES, Size, size_at
from ...settings.recipes import recipe_of
from ...settings.settings import TrainSettings
from .memory import fit_memory
from .speed import Extent, Speed, measure_speed, predicted_seconds


@dataclass(frozen=True)
class Fit:
    """How a preset follows the photos.

    Attributes:
        least: Iterations that it may always have, where there are few photos.
        visits: How often it sees each training photo at most: longer runs of few photos overfit (docs/accuracy.md).
        pixels_each: Pixels of the surface that one Gaussian is for.
    """

    least: int
    visits: int
    pixels_each: float


ON_PROCESSOR = {"draft": Fit(1000, 32, 6.0), "standard": Fit(1500, 120, 4.0), "high": Fit(2000, 150, 3.0)}
"""By preset: with few Gaussians, adding Gaussians raises PSNR more than adding iterations (docs/accuracy.md)."""
ON_CARD = {"draft": Fit(1000, 80, 3.0), "standard": Fit(1500, 120, 3.0), "high": Fit(2000, 200, 3.0)}
"""The same on a graphics card: large scenes in the literature have 1 to 5 million Gaussians."""
MOST_GROWTH, MOST_ON_PROCESSOR = 3, 180_000
"""Largest number of Gaussians on a processor, for scenes of much surface, as a factor of the preset's, and whatever the
preset is: more of them double the time of `high` and gain nothing (docs/accuracy.md)."""
DRAFT_SECONDS = 100.0
"""Predicted time of a draft up to which it is not reduced: with planning and the report it then ends in two minutes."""
DRAFT_STEPS = 40
"""Sizes below that of the draft that are tried."""


def fit_of(settings: TrainSettings) -> Fit:
    """Return how the preset of a run follows the photos on the machine that trains."""
    return (ON_CARD if hardware_of(settings).card else ON_PROCESSOR)[settings.preset]


def suitable_gaussians(extent: Extent, width: int, pixels_each: float) -> int:
    """Estimate how many Gaussians the surface in a scene's photos calls for.

    Args:
        extent: Size of the scene.
        width: Width of the training images, pixels.
        pixels_each: Pixels of the surface that one Gaussian is for.

    Returns:
        Number of Gaussians.
    """
    return extent.surface.gaussians(width, pixels_each)


def suited(settings: TrainSettings, size: Size, extent: Extent, widest: int) -> Size:
    """Return the sizes of a run: those that the user chose, and suitable ones.

    Args:
        settings: What the user chose.
        size: The largest sizes.
        extent: Size of the scene.
        widest: Width that the photos resolve, pixels.

    Returns:
        The sizes.
    """
    width = settings.width or min(size.width, widest)
    most = suitable_gaussians(extent, width, fit_of(settings).pixels_each)
    gaussians = settings.max_gaussians or min(size.max_gaussians, most)
    return Size(settings.iterations or size.iterations, width, gaussians)


def fit_preset(
    scene: Scene, settings: TrainSettings, speed: Speed | None = None, resolved: int | None = None
) -> TrainSettings:
    """Fill in the sizes that the user left to the preset: no larger than the photos and the machine call for.

    The width is at most what the photos resolve, the number of Gaussians follows the surface that they show, that of
    iterations the number of photos, and a draft is reduced where the machine would need more than two minutes.

    Args:
        scene: The scene.
        settings: What the user chose.
        speed: Speed of the machine on the scene; None to measure it where it matters.
        resolved: Width that the photos resolve, pixels; None to read photos where it matters.

    Returns:
        The settings; unchanged with a time budget.

    Raises:
        InputError: If a photo cannot be read.
    """
    if settings.budget or all(settings.size.numbers().values()):
        return settings
    extent, largest = Extent.of(scene), largest_size(settings)
    fit = fit_of(settings)
    enough = max(fit.least, fit.visits * extent.training)
    largest = replace(largest, iterations=min(largest.iterations, enough))
    widest = settings.width or min(largest.width, resolved or resolved_width(scene, largest.width))
    found = suited(settings, largest, extent, widest)
    if settings.preset == "draft" and not hardware_of(settings).card:
        speed = speed or measure_speed(scene, settings)
        densify_until = recipe_of(settings.recipe, settings.effects).densify_until
        for step in range(1, DRAFT_STEPS):
            if predicted_seconds(speed, extent, found, densify_until) <= DRAFT_SECONDS:
                break
            smaller = size_at(LADDER.index(PRESETS["draft"]) * (1 - step / DRAFT_STEPS))
            smaller = replace(_grown(smaller), iterations=min(smaller.iterations, enough))
            found = suited(settings, smaller, extent, widest)
    return replace(settings, **found.numbers())


def sizes_of_presets(scene: Scene, settings: TrainSettings, speed: Speed | None = None) -> dict[str, Any]:
    """Return the sizes that a run of each preset has on this machine with the memory that is free now.

    Args:
        scene: The scene.
        settings: Settings of the run; its preset, time budget and sizes are not used.
        speed: Speed of the machine on the scene; None to measure it where it matters.

    Returns:
        {"presets": {name: {"iterations", "width", "max_gaussians", "lowered": whether memory lowered them}},
        "surface": fields of `Surface`, which limits the number of Gaussians at other widths}.

    Raises:
        InputError: If a photo cannot be read, or memory does not suffice for the smallest run.
    """
    by_preset: dict[str, Any] = dict.fromkeys(SIZES, 0)
    runs = [replace(settings, preset=name, time_budget="", **by_preset) for name in PRESETS]
    extent, free = Extent.of(scene), hardware_of(settings).free_memory()
    resolved = resolved_width(scene, max(largest_size(run).width for run in runs))
    presets: dict[str, dict[str, Any]] = {}
    for run in runs:
        limited, _ = limit_gaussians(scene, fit_preset(scene, run, speed, resolved))
        fitted, note = fit_memory(extent, limited, free)
        presets[run.preset] = fitted.size.numbers() | {"lowered": bool(note)}
    return {"presets": presets, "surface": asdict(extent.surface)}


def limit_gaussians(scene: Scene, settings: TrainSettings) -> tuple[TrainSettings, str]:
    """Lower a number of Gaussians that is larger than the photos have pixels of the surface.

    Args:
        scene: The scene.
        settings: Settings of the run; a number of 0 stays.

    Returns:
        The settings, and a sentence for the user where the number was lowered, else an empty text.
    """
    most = Extent.of(scene).surface.gaussians(settings.width)
    if settings.max_gaussians <= most:
        return settings, ""
    note = (
        f"At most {most} Gaussians instead of {settings.max_gaussians}: one for each pixel of the surface that the "
        f"photos show at {settings.width} pixels width. More of them would overfit."
    )
    return replace(settings, max_gaussians=most), note


def largest_size(settings: TrainSettings) -> Size:
    """Return the largest sizes that a preset takes on the machine that trains."""
    if hardware_of(settings).card:
        return CARD_PRESETS[settings.preset]
    return _grown(PRESETS[settings.preset])


def _grown(size: Size) -> Size:
    """Allow the Gaussians of a scene of much surface."""
    return replace(size, max_gaussians=min(MOST_GROWTH * size.max_gaussians, MOST_ON_PROCESSOR))
