"""Where splats lie, as all formats of files say it. numpy only, Blender imports it."""

from typing import Any

import numpy as np

from ..scene.georeference import Placement
from ..splats.splats import Splats

LARGEST = 1e12
"""Largest coordinate of an origin; anything on Earth is within 1e8 metres."""


def place_to_json(splats: Splats) -> dict[str, Any]:
    """Return a plain dict that `place_from_json` reads: empty for splats that lie nowhere in particular."""
    origin = {"origin": list(splats.origin)} if any(splats.origin) else {}
    return (splats.placement.to_json() if splats.placement else {}) | origin


def place_from_json(document: Any) -> tuple[Placement | None, tuple[float, float, float]]:
    """Return the placement and the origin of splats, None and zeros where the document does not tell them."""
    try:
        placement = Placement.from_json(document)
    except ValueError:
        placement = None
    try:
        x, y, z = np.array(document["origin"], np.float64).tolist()
        if max(abs(x), abs(y), abs(z)) <= LARGEST:
            return placement, (x, y, z)
    except (KeyError, TypeError, ValueError):
        pass
    return placement, (0.0, 0.0, 0.0)
