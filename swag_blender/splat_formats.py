"""Formats of splat files in file browsers and menus, from the engine's registry."""

from pathlib import Path

import bpy

from ..swag_engine.base.foreign_files import FOREIGN_FILES
from ..swag_engine.formats.registry import SUFFIXES

FILE_FILTER = ";".join(f"*{suffix}" for suffix in SUFFIXES)
"""Value of the `filter_glob` of a file browser."""
FILE_ENDINGS = ";".join((*SUFFIXES, *FOREIGN_FILES))
"""Value of the `bl_file_extensions` of a file handler: with files to which the import says how to convert them."""


def is_splat_file(path: Path) -> bool:
    """Whether the file's name has the ending of a format."""
    return path.suffix.lower() in SUFFIXES


def menu_text() -> str:
    """Return the text of the entries in File > Import and File > Export, in the user's language."""
    return f"{bpy.app.translations.pgettext_iface('Gaussian Splats')} ({', '.join(SUFFIXES)})"
