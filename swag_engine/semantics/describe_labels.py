"""Names of labels that nobody named: the color without the water, its tone, and the place in the photos."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base.color_difference import lab
from ..splats.splats import Splats
from ..splats.transform import C0
from .embed import nearest_color
from .regions import SceneRegions

SIDE = 0.1
"""Distance from the middle of the photos, as a fraction of their width or height, beyond which a place has a side."""

TONE = 6.0
"""Difference in lightness (L* of CIELAB) from the mean of the labels of a color beyond which one is dark or light."""


@dataclass(frozen=True)
class Description:
    """What is seen of a label.

    Attributes:
        color: name of its color.
        lightness: L* of CIELAB.
        place: where it is in the photos, in words.
    """

    color: str
    lightness: float
    place: str


def describe_labels(regions: SceneRegions, splats: Splats, labels: np.ndarray) -> SceneRegions:
    """Rename the labels that were named by the colors of the photos.

    Args:
        regions: The regions.
        splats: Splats (N) of the run, whose colors are without water.
        labels: Number (N,) of the label of each splat.

    Returns:
        The regions with names such as "brown", or "dark brown" and "brown, top left" where several are brown.
    """
    colors = np.clip(splats.sh[:, 0] * C0 + 0.5, 0, 1)
    if splats.development is not None and not splats.development.applied:
        colors = splats.development.development.apply(colors)
    taken = set(regions.labels) - regions.described
    chosen = [number for number, label in enumerate(regions.labels, start=1) if label in regions.described]
    described = {}
    for number in chosen:
        own = labels == number
        weights = splats.opacities[own] * np.maximum(splats.scales[own].mean(1), 1e-9) ** 2
        place = _place(regions.maps, number)
        if weights.sum() > 0:
            color = np.average(colors[own], axis=0, weights=weights)
            described[number] = Description(nearest_color(color), float(lab(color)[0]), place)
        else:
            described[number] = Description(regions.labels[number - 1].rstrip(" 0123456789"), 0.0, place)
    names = unique_names(list(described.values()), taken)
    renamed = dict(zip(described, names, strict=True))
    return replace(regions, labels=tuple(renamed.get(i, label) for i, label in enumerate(regions.labels, start=1)))


def unique_names(described: Sequence[Description], taken: set[str]) -> list[str]:
    """Return a name for each label: its color, with tone and place where these are needed, and else with a number.

    Args:
        described: What is seen of each label, the largest one first.
        taken: Names of other labels.
    """
    toned = [_with_tone(one, described) for one in described]
    choices = [
        [one.color for one in described],
        toned,
        [f"{tone}, {one.place}" for tone, one in zip(toned, described, strict=True)],
    ]
    counts = [Counter(names) for names in choices]
    found: list[str] = []
    for row in zip(*choices, strict=True):
        free = [name for name, count in zip(row, counts, strict=True) if count[name] == 1 and name not in taken]
        name, number = free[0] if free else row[-1], 1
        while name in taken or name in found:
            number += 1
            name = f"{row[-1]} ({number})"
        found.append(name)
    return found


def _with_tone(one: Description, described: Sequence[Description]) -> str:
    """Return the color of a label with "dark" or "light" where it differs from others of that color."""
    apart = one.lightness - np.mean([other.lightness for other in described if other.color == one.color])
    return f"dark {one.color}" if apart < -TONE else f"light {one.color}" if apart > TONE else one.color


def _place(maps: Mapping[str, np.ndarray], number: int) -> str:
    """Return where a label is in the photos on average."""
    total, count = np.zeros(2), 0
    for index in maps.values():
        rows, columns = np.nonzero(index == number)
        total += ((rows + 0.5) / index.shape[0]).sum(), ((columns + 0.5) / index.shape[1]).sum()
        count += len(rows)
    row, column = total / max(count, 1) - 0.5
    across = "left" if column < -SIDE else "right" if column > SIDE else ""
    upright = "top" if row < -SIDE else "bottom" if row > SIDE else ""
    return f"{upright} {across}".strip() or "center"
