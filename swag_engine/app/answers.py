"""What a command answers: text, or one JSON document with --json. Standard library only."""

import os
import sys
from collections.abc import Sequence
from typing import Any

from ..base.errors import InputError, missing_package_sentence
from ..base.strict_json import to_json
from ..base.text import printable

BROKEN_PIPE = 141
"""Exit code where the reader of stdout, such as `head`, has ended, as shells count SIGPIPE."""
UNUSABLE = 2
"""Exit code of bad input or usage."""


def show(document: dict[str, Any], as_json: bool, text: str) -> None:
    """Print the answer of a command on stdout.

    Args:
        document: The answer for machines.
        as_json: Whether to print the document.
        text: The answer for people.

    Raises:
        BrokenPipeError: Where the reader of stdout has ended.
        InputError: Where the disk of stdout is full.
    """
    print_answer(to_json(document, indent=2) if as_json else printable(text), end="\n")


def print_answer(text: str = "", end: str = "") -> None:
    """Write a text, and what was printed before, to stdout; raises as `show`."""
    try:
        print(text, end=end, flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python writes the rest when it closes stdout
        if isinstance(error, BrokenPipeError):
            raise
        raise InputError(f"The answer cannot be written: {error.strerror}; free some space on the disk.") from error


def refuse(sentence: str, arguments: Sequence[str], code: int = UNUSABLE, **more: Any) -> int:
    """Say on stderr why a command gave no answer, and with --json as a document on stdout too.

    Args:
        sentence: What is wrong and what to do.
        arguments: Words of the command line.
        code: Exit code.
        **more: Further fields of the document.

    Returns:
        The exit code.
    """
    if "--json" in arguments:
        print(to_json({"error": sentence} | more))
    try:
        print(printable(sentence), file=sys.stderr, flush=True)
    except OSError:  # nobody can read it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    return code


def refuse_missing(error: ModuleNotFoundError, arguments: Sequence[str]) -> int:
    """Name a package that this Python lacks, as `refuse` does.

    Args:
        error: What the import raised.
        arguments: Words of the command line.

    Returns:
        The exit code.

    Raises:
        ModuleNotFoundError: Where a module of the engine itself is missing, which is a bug.
    """
    sentence = missing_package(error)
    if not sentence:
        raise error
    return refuse(sentence, arguments)


def missing_package(error: Exception) -> str:
    """Return a sentence about the package that this Python lacks, "" for other errors and modules of the engine."""
    own = __package__.partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or not error.name or error.name.partition(".")[0] == own:
        return ""
    return missing_package_sentence(sys.executable, error.name)
