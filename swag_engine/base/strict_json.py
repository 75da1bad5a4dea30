"""JSON that every parser reads: no NaN, no infinity."""

import json
import math
from typing import Any


def to_json(message: dict[str, Any], indent: int | None = None) -> str:
    """Format an object as strict JSON.

    Args:
        message: The object; numbers that are not finite become null.
        indent: Spaces of indentation, None for one line.

    Returns:
        The JSON text.
    """
    return json.dumps(replace_nonfinite(message), indent=indent, allow_nan=False)


def from_json(text: str | bytes) -> Any:
    """Parse a JSON document.

    Args:
        text: The document.

    Returns:
        Its value.

    Raises:
        ValueError: When it is not valid JSON.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def replace_nonfinite(value: Any) -> Any:
    """Replace numbers that are not finite by None.

    Args:
        value: Dicts, lists and tuples of numbers, texts and None, nested.

    Returns:
        A copy; tuples become lists.
    """
    if isinstance(value, dict):
        return {key: replace_nonfinite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nonfinite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
