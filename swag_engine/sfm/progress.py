"""How the stages of structure from motion report."""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""A function of the stage and its fraction (0..1)."""
