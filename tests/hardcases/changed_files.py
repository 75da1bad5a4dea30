"""Splats and changes of files for the tests of damaged input."""

import json
import struct

import numpy as np

from swag_engine.splats.splats import Splats

NUMBERS = [0, 1, -1, 3, 255, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 10**18, 10**400, -(10**18), 1e308, float("nan"), 0.5]
"""Numbers that a file may declare."""
THINGS = [*NUMBERS, None, True, "", "x", "../../etc/passwd", "file:///dev/zero", [], {}, [0] * 50, [[]], {"a": {}}]
"""Values that a JSON document may hold."""


def some_splats(count: int = 6, degree: int = 1) -> Splats:
    random = np.random.default_rng(degree)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal((count, *shape), np.float32)

    label = np.arange(count, dtype=np.int32)
    return Splats(normal(3), normal(4), np.exp(normal(3)), random.random(count, np.float32),
                  normal((degree + 1) ** 2, 3), {"label": label, "likeness": normal()})  # fmt: skip


def bytes_changed(data: bytes, random: np.random.Generator) -> bytes:
    """Set, remove, repeat or replace some bytes, more often near the beginning, where headers are."""
    changed = bytearray(data)
    for _ in range(random.integers(1, 4)):
        place = int(len(changed) * random.random() ** random.choice([0.5, 2]))
        length = int(random.integers(1, 40))
        match random.integers(6):
            case 0:
                changed[place : place + 1] = random.bytes(1)
            case 1:
                del changed[place : place + length]
            case 2:
                changed[place:place] = changed[place : place + length]
            case 3:
                changed[place : place + 4] = struct.pack("<I", int(random.choice([0, 1, 2**31, 2**32 - 1])))
            case 4:
                changed[place : place + 4] = struct.pack("<f", random.choice([np.nan, np.inf, -1e38, 1e-45]))
            case 5:
                del changed[place:]
    return bytes(changed)


def values_changed(data: bytes, random: np.random.Generator) -> bytes:
    """Replace or remove values somewhere in a JSON document, or replace the whole document."""
    if random.random() < 0.05:
        return json.dumps(THINGS[int(random.integers(len(THINGS)))]).encode()
    document = json.loads(data)
    for _ in range(random.integers(1, 4)):
        place: dict | list = document
        while isinstance(place, dict | list) and place:
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            key = keys[int(random.integers(len(keys)))]
            if isinstance(place[key], dict | list) and place[key] and random.random() < 0.7:
                place = place[key]
                continue
            if random.random() < 0.2:
                del place[key]
            else:
                place[key] = THINGS[int(random.integers(len(THINGS)))]
            break
    return json.dumps(document).encode()
