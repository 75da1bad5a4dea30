"""The packages of the extra `science`, which the rest of the engine runs without."""

import importlib
import sys
from typing import Any

from ..base.errors import InputError

PACKAGES = ("rasterio", "pyproj", "shapely")
"""Packages of the extra `science` (pyproject.toml)."""


def require_packages() -> Any:
    """Import the packages of the extra `science`.

    Returns:
        The module rasterio.

    Raises:
        InputError: If one of them is not installed.
    """
    for name in PACKAGES:
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise InputError(
                f"{sys.executable} lacks the package {name}, which maps and tables need: install the extra science "
                f"with {sys.executable} -m pip install {' '.join(PACKAGES)}."
            ) from error
    return importlib.import_module("rasterio")
