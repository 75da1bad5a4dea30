"""Formats of splat files as operators and panels show them, from the engine's registry."""

import bpy

from ..swag_engine.formats.gltf import COLMAP_UP
from ..swag_engine.formats.registry import FORMATS, SUFFIXES, find_format

__all__ = ["COLMAP_UP", "FILE_ENDINGS", "FILE_FILTER", "FORMATS", "SUFFIXES", "find_format", "menu_text"]

FILE_FILTER = ";".join(f"*{suffix}" for suffix in SUFFIXES)
"""Value of the `filter_glob` of a file browser."""
FILE_ENDINGS = ";".join(SUFFIXES)
"""Value of the `bl_file_extensions` of a file handler."""


def menu_text() -> str:
    """Return the text of the entries in File > Import and File > Export, in the user's language."""
    return f"{bpy.app.translations.pgettext_iface('Gaussian Splats')} ({', '.join(SUFFIXES)})"
