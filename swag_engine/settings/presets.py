"""How large a run is: three presets, and the sizes between and beyond them that a time budget chooses from."""

import re
from dataclasses import dataclass
from typing import Literal

from ..base.errors import InputError

Preset = Literal["draft", "standard", "high"]


@dataclass(frozen=True)
class Size:
    """iterations: optimisation steps; width in pixels that photographs are trained at; most Gaussians."""

    iterations: int
    width: int
    max_gaussians: int


PRESETS: dict[Preset, Size] = {
    "draft": Size(1500, 480, 45_000),
    "standard": Size(3000, 640, 60_000),
    "high": Size(9000, 960, 150_000),
}

LADDER = (Size(60, 240, 5_000), *PRESETS.values(), Size(30_000, 1600, 1_000_000))
"""Sizes that belong together, from what seconds suffice for to what only a fast graphics card finishes."""


def size_at(rung: float) -> Size:
    """The size at a place of LADDER, 0 to len(LADDER) - 1; between two of them geometrically."""
    rung = min(max(rung, 0.0), len(LADDER) - 1)
    below = min(int(rung), len(LADDER) - 2)
    part = rung - below
    pairs = zip(_numbers(LADDER[below]), _numbers(LADDER[below + 1]), strict=True)
    return Size(*(round(low ** (1 - part) * high**part) for low, high in pairs))


def _numbers(size: Size) -> tuple[int, int, int]:
    return size.iterations, size.width, size.max_gaussians


def seconds_of(budget: str) -> float:
    """Seconds that a text such as 90s, 10m, 1h30m or 600 says; 0 for an empty one.

    Raises InputError for anything else, and for less than a second or more than a hundred days.
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
