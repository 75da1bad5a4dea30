"""Size of a run: three presets, and the sizes between and beyond them that a time budget chooses from.

Presets are typical sizes: training/pacing/preset_size.py suits them to the photos and the machine.
"""

import re
from dataclasses import dataclass, field
from typing import Any

from ..base.errors import InputError


@dataclass(frozen=True)
class Size:
    """Size of a run.

    Attributes:
        iterations: Number of optimisation steps.
        width: Width of the training images in pixels.
        max_gaussians: Largest number of Gaussians.
        description: What a preset of this size is for.
    """

    iterations: int
    width: int
    max_gaussians: int
    description: str = field(default="", compare=False)

    def numbers(self) -> dict[str, Any]:
        """Return the numbers by the names of the settings that they stand for."""
        return {name: getattr(self, name) for name in SIZES}


SIZES = ("iterations", "width", "max_gaussians")
"""Settings that a preset or a time budget chooses where the user does not."""
FEWEST = 5_000
"""Gaussians that a run may always have."""


@dataclass(frozen=True)
class Surface:
    """Surface that the photos of a scene show.

    Attributes:
        width: Width of the largest photo, pixels.
        pixels: Area of the surface in pixels of photos of this width.
    """

    width: int
    pixels: float

    def gaussians(self, width: int, pixels_each: float = 1.0) -> int:
        """Return how many Gaussians the surface calls for: at most one for each pixel (docs/accuracy.md).

        Args:
            width: Width of the training images, pixels.
            pixels_each: Pixels of the surface that one Gaussian is for.

        Returns:
            Number of Gaussians.
        """
        return max(FEWEST, round(self.pixels * (min(width, self.width) / self.width) ** 2 / pixels_each))


PRESETS: dict[str, Size] = {
    "draft": Size(1500, 480, 45_000, "To see whether a scene works"),
    "standard": Size(3000, 640, 60_000, "A good result in moderate time"),
    "high": Size(9000, 960, 150_000, "For a result to keep"),
}

CARD_PRESETS: dict[str, Size] = {
    "draft": Size(3000, 960, 500_000),
    "standard": Size(7000, 1600, 2_000_000),
    "high": Size(30_000, 20_000, 20_000_000),
}
"""The largest sizes of the presets on a graphics card: what the photos and the memory hold limits them."""

LADDER = (Size(60, 240, 5_000), *PRESETS.values(), Size(30_000, 1600, 1_000_000))
"""Sizes in ascending order, from a run of seconds to one that only a fast graphics card finishes."""


def size_at(rung: float) -> Size:
    """Interpolate between the sizes of LADDER.

    Args:
        rung: Position in LADDER, from 0 to len(LADDER) - 1; values outside are clamped.

    Returns:
        The size, each number interpolated geometrically.
    """
    rung = min(max(rung, 0.0), len(LADDER) - 1)
    below = min(int(rung), len(LADDER) - 2)
    part = rung - below
    pairs = zip(LADDER[below].numbers().values(), LADDER[below + 1].numbers().values(), strict=True)
    return Size(*(round(low ** (1 - part) * high**part) for low, high in pairs))


def seconds_of(budget: str) -> float:
    """Read a duration.

    Args:
        budget: Text such as 90s, 10m, 1h30m or 600 (seconds).

    Returns:
        Seconds; 0 for an empty text.

    Raises:
        InputError: For any other text, for less than a second and for more than 100 days.
    """
    if not budget:
        return 0.0
    number = r"(\d+(?:\.\d+)?)"
    match = re.fullmatch(rf"(?:{number}h)?\s*(?:{number}m(?:in)?)?\s*(?:{number}s?)?", budget.strip())
    hours, minutes, rest = (float(value or 0) for value in match.groups()) if match else (0.0, 0.0, 0.0)
    seconds = 3600 * hours + 60 * minutes + rest
    if not 1 <= seconds <= 8.64e6:
        raise InputError(f"The time budget must be a time such as 90s, 10m or 1h30m, not {budget!r}.")
    return seconds
