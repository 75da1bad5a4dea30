"""The exception whose message is shown to the user, remedies on the command line and in Blender, common sentences."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class InputError(Exception):
    """Input that cannot be used.

    The message is one sentence: what is wrong, in which file or setting, what to do. Command line, worker and Blender
    show it without a traceback; the exit code is 2, and no file is left incomplete.
    """


DAMAGE = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, ZeroDivisionError)
"""What Python raises where a value of a file is missing, of a wrong type or out of range."""


@contextmanager
def reading(path: Path, remedy: str = "restore it from a copy, or remove it") -> Iterator[None]:
    """Raise InputError that names a file where the block meets a value of it that cannot be used."""
    try:
        yield
    except DAMAGE as error:
        raise InputError(f"{path} is damaged ({error!r}): {remedy}.") from error


_names_buttons = False
"""Whether the user of this process has Blender's buttons in front of them, and not a terminal."""


def name_buttons() -> None:
    """Let remedies name buttons from now on: the worker that Blender drives and the extension call this."""
    global _names_buttons
    _names_buttons = True


def remedy(command: str, button: str) -> str:
    """Return what the user can do: `command` on the command line, `button` in Blender."""
    return button if _names_buttons else command


def program() -> str:
    """Return the words that start the command line, as the user wrote them: `swag`, or `python -m swag_engine`.

    Blender and a command that starts others pass theirs on in SWAG_PROG.
    """
    started = "swag" if Path(sys.argv[0]).stem == "swag" else "python -m swag_engine"
    return os.environ.get("SWAG_PROG", started)


def continue_run() -> str:
    """Return how to continue a run."""
    return remedy("continue it with train --resume", "open it and press Continue in the panel Train")


def make_labels() -> str:
    """Return how to label a run."""
    return remedy("make them with `label`", "press Label in the panel Labels")


def missing_package_sentence(python: str, package: str) -> str:
    """Say that a Python lacks a package of the engine, and what to do."""
    return (
        f"{python} lacks the package {package}: install the packages of requirements.txt there, or press Install "
        "Engine in Blender's preferences of SWAG Splatting."
    )
