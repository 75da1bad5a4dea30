"""Names of labels that nobody named: the color without the water, and the place in the photos."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..splats.splats import Splats
from ..splats.transform import C0
from .embed import nearest_color
from .regions import SceneRegions

SIDE = 0.1
"""Distance from the middle of the photos, as a fraction of their width or height, beyond which a place has a side."""


def describe_labels(regions: SceneRegions, splats: Splats, labels: np.ndarray) -> SceneRegions:
    """Rename the labels that were named by the colors of the photos.

    Args:
        regions: The regions.
        splats: Splats (N) of the run, whose colors are without water.
        labels: Number (N,) of the label of each splat.

    Returns:
        The regions with names such as "brown", or "brown, top left" where several are brown.
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
        if weights.sum() > 0:
            color = nearest_color(np.average(colors[own], axis=0, weights=weights))
            described[number] = color, _place(regions.maps, number)
        else:
            described[number] = regions.labels[number - 1].rstrip(" 0123456789"), _place(regions.maps, number)
    names = unique_names(list(described.values()), taken)
    renamed = dict(zip(described, names, strict=True))
    return replace(regions, labels=tuple(renamed.get(i, label) for i, label in enumerate(regions.labels, start=1)))


def unique_names(described: Sequence[tuple[str, str]], taken: set[str]) -> list[str]:
    """Return a name for each label: its color, with its place where that is needed, and else with a number.

    Args:
        described: Color and place of each label, the largest one first.
        taken: Names of other labels.
    """
    names: list[str] = []
    colors = [color for color, _ in described]
    for color, place in described:
        wanted = color if colors.count(color) == 1 and color not in taken else f"{color}, {place}"
        name, number = wanted, 1
        while name in taken or name in names:
            number += 1
            name = f"{wanted} ({number})"
        names.append(name)
    return names


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
