"""Figures and lists as short texts, the same on the command line and in Blender."""

import os
import re
import shlex
from collections.abc import Sequence

BLOCKS = "▁▂▃▄▅▆▇█"
"""Characters of a sparkline, from low to high."""


def text_encoding(start: bytes) -> str:
    """Return the encoding of a text by its first bytes: UTF-16 with a byte order mark, else UTF-8."""
    return "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"


def time_text(seconds: float) -> str:
    """Format a duration as m:ss, or h:mm:ss."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


def first_names(names: Sequence[str]) -> str:
    """List the first three names, and show that there are more."""
    return f"{', '.join(names[:3])}{' ...' if len(names) > 3 else ''}"


def command_text(words: Sequence[str], windows: bool = os.name == "nt") -> str:
    """Format a command for a terminal to paste: no name of a folder can end it and start another one.

    A word with characters that act within quotes in one of the two shells of Windows is written as NAME.
    """
    if not windows:
        return shlex.join(words)
    quoted = ("NAME" if re.search('[%$`!"\u201c-\u201f\x00-\x1f]', word) else word for word in words)
    return " ".join(word if re.fullmatch(r"[\w.:/\\-]+", word) else f'"{word}"' for word in quoted)


def printable(text: str) -> str:
    """Replace characters that a terminal would obey, and those that it cannot show, by their escapes."""
    acting = "[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
    return re.sub(acting, lambda found: found[0].encode("unicode_escape").decode(), text)


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
