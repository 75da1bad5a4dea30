"""JSON that every reader takes."""

import json
import math
from typing import Any


def to_json(message: dict[str, Any], indent: int | None = None) -> str:
    """Strict JSON: figures that are not finite become null."""
    return json.dumps(strict(message), indent=indent, allow_nan=False)


def from_json(text: str | bytes) -> Any:
    """What a JSON document holds. Raises ValueError where it is none that can be read."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: strict(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [strict(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
