"""Which splats leave, and how much of each. numpy only, Blender's Python imports it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..base.errors import InputError
from ..splats.splats import Splats
from .run_folder import read_json

LABEL = "label"


@dataclass(frozen=True, eq=False)
class Choice:
    """What to keep of some splats; by default everything.

    labels: values of the extra `label`. box: a matrix (4, 4) from the splats' space to one in which the corners of the
    box are at -1 and 1 (see box_between). extras: whether properties such as labels stay.
    """

    labels: frozenset[int] | None = None
    box: np.ndarray | None = None
    min_opacity: float = 0.0
    sh_degree: int = 3
    extras: bool = True

    def of(self, splats: Splats) -> Splats:
        """What is kept of `splats`, which may be nothing. Raises InputError for labels that they do not have."""
        kept = splats.opacities >= self.min_opacity
        if self.labels is not None:
            if LABEL not in splats.extras:
                raise InputError("The splats have no labels to choose by; label them first, or leave labels empty.")
            kept &= np.isin(splats.extras[LABEL], list(self.labels))
        if self.box is not None:
            inside = splats.positions @ self.box[:3, :3].T + self.box[:3, 3]
            kept &= (np.abs(inside) <= 1).all(axis=1)
        chosen = splats if kept.all() else splats.subset(kept)
        sh = chosen.sh[:, : (self.sh_degree + 1) ** 2]
        extras = chosen.extras if self.extras else {}
        return Splats(chosen.positions, chosen.rotations, chosen.scales, chosen.opacities, sh, extras)


def something(splats: Splats) -> Splats:
    """`splats`, where there are any. Raises InputError where a choice left none."""
    if not len(splats):
        raise InputError("No splat is left by this choice; widen the box, add labels or lower the least opacity.")
    return splats


def box_between(lower: Sequence[float], upper: Sequence[float]) -> np.ndarray:
    """The matrix of an upright box with these corners (3,). Raises InputError when it is empty."""
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise InputError("The first corner of the box must be below the second in x, y and z.")
    matrix = np.diag([*(2 / (high - low)), 1.0])
    matrix[:3, 3] = -(high + low) / (high - low)
    return matrix


def label_ids(wanted: Sequence[str], table: Path) -> frozenset[int]:
    """Labels by number or by name, whatever the case; `table` is the run's labels.json, which may be absent.

    Raises InputError for an unknown name, or where the file is damaged.
    """
    known: dict[str, int] = {}
    if table.is_file():
        document = read_json(table, "")
        try:
            known = {str(entry["name"]).casefold(): int(entry["id"]) for entry in document["labels"]}
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{table} does not list labels; label the run again.") from error
    found = set()
    for word in wanted:
        word = word.strip()
        if word.casefold() in known:
            found.add(known[word.casefold()])
        elif word.isdecimal():
            found.add(int(word))
        else:
            there = ", ".join(known) or "none with a name; name them with `label`"
            raise InputError(f"There is no label named {word}; there are {there}.")
    return frozenset(found)
