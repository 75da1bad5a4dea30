"""Work in steps, so that the window is drawn and Escape is read between them."""

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")

Steps = Generator[float, None, T]
"""Work that yields the fraction that is done, 0..1, before each step of a tenth of a second or so, and returns T."""


def run_to_end(steps: Steps[T]) -> T:
    """Take all steps at once; returns what they return."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value
