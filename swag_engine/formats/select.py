"""Selection of the splats, and of their properties, that an export writes. numpy only, Blender imports it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..base.errors import DAMAGE, InputError, make_labels
from ..splats.splats import Splats
from .run_folder import read_json

LABEL = "label"
"""Extra of splats with the number of their label, 0 for none."""


@dataclass(frozen=True, eq=False)
class SplatSelection:
    """Conditions that splats must meet, and the properties that they keep; by default everything.

    Attributes:
        labels: Values of the extra `label`, None for all splats.
        box: (4, 4) matrix from the splats' world to a space in which the box reaches from -1 to 1 on each axis (see
            `box_between`), None for all splats.
        min_opacity: Smallest opacity, 0..1.
        sh_degree: Highest degree of spherical harmonics, 0..3.
        extras: Whether extras such as labels are kept.
    """

    labels: frozenset[int] | None = None
    box: np.ndarray | None = None
    min_opacity: float = 0.0
    sh_degree: int = 3
    extras: bool = True

    def apply(self, splats: Splats) -> Splats:
        """Select from splats.

        Args:
            splats: Splats to select from.

        Returns:
            Those that meet all conditions, which may be none.

        Raises:
            InputError: If labels are asked for and the splats have none.
        """
        kept = splats.opacities >= self.min_opacity
        if self.labels is not None:
            if LABEL not in splats.extras:
                raise InputError("The splats have no labels to select by; label them first, or leave labels empty.")
            kept &= np.isin(splats.extras[LABEL], list(self.labels))
        if self.box is not None:
            kept &= inside_box(splats.positions, self.box)
        chosen = splats if kept.all() else splats.subset(kept)
        sh = chosen.sh[:, : (self.sh_degree + 1) ** 2]
        extras = chosen.extras if self.extras else {}
        return replace(chosen, sh=sh, extras=extras)


def inside_box(positions: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return which positions (N, 3) lie in a box, (N,) bool; `box` as in `SplatSelection`."""
    return (np.abs(positions @ box[:3, :3].T + box[:3, 3]) <= 1).all(axis=1)


def require_splats(splats: Splats) -> Splats:
    """Return the splats that a selection left.

    Raises:
        InputError: If there are none.
    """
    if not len(splats):
        raise InputError("No splat is left by this selection; widen the box, add labels or lower the least opacity.")
    return splats


def box_between(lower: Sequence[float], upper: Sequence[float]) -> np.ndarray:
    """Make the matrix of an axis-aligned box for `SplatSelection`.

    Args:
        lower: Corner (3,) with the smallest coordinates.
        upper: Corner (3,) with the largest coordinates.

    Returns:
        Matrix (4, 4) that takes the corners to -1 and 1 on each axis.

    Raises:
        InputError: If the box is empty or a coordinate is not finite.
    """
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise InputError("The first corner of the box must be below the second in x, y and z.")
    matrix = np.diag([*(2 / (high - low)), 1.0])
    matrix[:3, 3] = -(high + low) / (high - low)
    return matrix


def label_ids(wanted: Sequence[str], table: Path) -> frozenset[int]:
    """Find the numbers of labels.

    Args:
        wanted: Labels by name, upper or lower case, or by number.
        table: The run's labels.json, which need not exist.

    Returns:
        Their numbers.

    Raises:
        InputError: If a name is unknown or the file is damaged.
    """
    known: dict[str, int] = {}
    if table.is_file():
        document = read_json(table, "")
        try:
            known = {str(entry["name"]).casefold(): int(entry["id"]) for entry in document["labels"]}
        except DAMAGE as error:
            raise InputError(f"{table} does not list labels; label the run again.") from error
    found = set()
    for word in wanted:
        word = word.strip()
        if word.casefold() in known:
            found.add(known[word.casefold()])
        elif word.isdecimal():
            found.add(int(word))
        else:
            there = ", ".join(known) or f"none with a name; {make_labels()}"
            raise InputError(f"There is no label named {word}; there are {there}.")
    return frozenset(found)
