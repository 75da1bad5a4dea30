"""Child processes and packages that take no code and no settings from the current folder."""

import contextlib
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""Folder from which Python imports the engine."""


def child_environment() -> dict[str, str]:
    """Return environment variables for a Python that runs the engine, and nothing from the current folder."""
    search = filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])
    return os.environ | {
        "PYTHONPATH": os.pathsep.join(search), "PYTHONSAFEPATH": "1", "PYTHONIOENCODING": "utf-8"
    }  # fmt: skip


def import_matplotlib() -> None:
    """Import matplotlib, which would read a file `matplotlibrc` in the current folder, from another folder."""
    if "matplotlib" not in sys.modules:
        with contextlib.chdir(ROOT):
            import matplotlib  # noqa: F401
