"""All export formats by name. A new format is one file here and one line in MODULES."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..base.errors import InputError
from ..base.foreign_files import refuse_foreign
from .export_format import ExportFormat

MODULES = (
    "ply",
    "gltf",
    "spz",
)
"""Files of this folder that define a FORMAT, in the order in which the interface shows them."""
FORMATS: dict[str, ExportFormat] = {
    format.name: format for format in (import_module(f".{name}", __package__).FORMAT for name in MODULES)
}
"""Name -> format."""
SUFFIXES: dict[str, ExportFormat] = {format.suffix: format for format in FORMATS.values()}
"""Ending of a file's name, lower case, with the dot -> format."""

if TYPE_CHECKING:
    FormatName = str
else:
    FormatName = Literal[tuple(FORMATS)]
"""Type of a format's name, from which the command line and the worker take the choices."""


def find_format(path: Path) -> ExportFormat:
    """Find the format of a file by the ending of its name.

    Args:
        path: The file, which need not exist.

    Returns:
        The format.

    Raises:
        InputError: If no format has this ending.
    """
    refuse_foreign(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{path.name or 'A file without a name'} is not a splat file: choose a name that ends in "
            f"{' or '.join(SUFFIXES)}."
        )
    return SUFFIXES[path.suffix.lower()]
