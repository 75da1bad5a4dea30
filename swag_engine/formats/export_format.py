"""What an export format is: its name, its words for the user, and its functions. numpy only, Blender imports it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ..scene.cameras import Camera
from ..splats.splats import Splats

Direction = Sequence[float] | np.ndarray
"""Three numbers; their length does not matter."""
Option = Literal["up", "cameras", "extras"]
"""An export option that only some formats take."""


@dataclass(frozen=True)
class ExportFormat:
    """One file format that splats are exported to. Its file defines one as FORMAT, formats/registry.py lists it.

    Attributes:
        name: Name on the command line and in requests.
        suffix: Ending of the file's name, lower case, with the dot.
        title: Label of the format in the interface.
        description: What the format is for, one sentence for the user.
        options: Which of these it takes. `up`: the file has the axes that the user chose; without it y is up.
            `cameras`: the file holds cameras; without it they are only beside the file. `extras`: the file holds
            further properties such as labels, and every number as it is; without it numbers are rounded, and such
            properties are left out.
        write: Writes splats to a file, which is whole or absent. Arguments: path; splats; the direction that is up in
            their world; cameras of that world. Raises InputError where that cannot be done.
        size: Size in bytes of the file that `write` makes of the same arguments; raises what `write` raises before it
            writes.
        read: Reads a file. Arguments: path; the direction that shall be up in the world of the splats. Raises
            InputError where the file cannot be read.
    """

    name: str
    suffix: str
    title: str
    description: str
    options: frozenset[Option]
    write: Callable[[Path, Splats, Direction, Sequence[Camera]], None]
    size: Callable[[Path, Splats, Direction, Sequence[Camera]], int]
    read: Callable[[Path, Direction], Splats]

    def notes(self, splats: Splats) -> list[str]:
        """Return sentences for the user about what a file of this format says or leaves out of splats."""
        notes = []
        if splats.extras and "extras" not in self.options:
            names = ", ".join(splats.extras)
            notes = [
                f"{self.title} has no place for these properties, which were left out: {names}. PLY and GLB keep them."
            ]
        if any(splats.origin):
            origin = " ".join(f"{value:.15g}" for value in splats.origin)
            notes.append(f"Coordinates in the file are relative to the origin {origin} (docs/formats.md).")
        return notes
