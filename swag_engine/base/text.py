"""Figures and lists as short texts, the same on the command line and in Blender."""

from collections.abc import Sequence

BLOCKS = "▁▂▃▄▅▆▇█"
"""Characters of a sparkline, from low to high."""


def time_text(seconds: float) -> str:
    """Format a duration as m:ss, or h:mm:ss."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


def first_names(names: Sequence[str]) -> str:
    """List the first three names, and show that there are more."""
    return f"{', '.join(names[:3])}{' ...' if len(names) > 3 else ''}"


def sparkline(values: Sequence[float], bars: str = BLOCKS) -> str:
    """Draw values as a row of bars between the lowest and the highest of them.

    Args:
        values: At least one value.
        bars: Characters from low to high.

    Returns:
        One character for each value.
    """
    low, span = min(values), max(max(values) - min(values), 1e-9)
    return "".join(bars[round((value - low) / span * (len(bars) - 1))] for value in values)
