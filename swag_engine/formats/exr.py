"""OpenEXR images of one float channel: depth for compositing. numpy only.

Written as https://openexr.com/en/latest/OpenEXRFileLayout.html describes: scan lines, ZIP compression in blocks of 16.
OpenCV's own writer is switched off unless a variable is set before the process starts.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

from ..base.files import atomic_path

MAGIC = struct.pack("<ii", 20000630, 2)
"""Magic number and version of a file with one part of scan lines."""
CHANNEL = b"Y"
"""Name of the channel: luminance, which all programs read; many ignore a channel Z without colors."""
BLOCK_LINES = 16
"""Lines of one block of ZIP compression."""
FLOAT, ZIP = 2, 3
"""Numbers of the pixel type and of the compression in the header."""


def write_exr(path: Path, values: np.ndarray) -> None:
    """Write an image of one channel in 32-bit floats.

    Args:
        path: The file.
        values: (H, W) numbers.

    Raises:
        InputError: If the file cannot be written.
    """
    height, width = values.shape
    lines = np.ascontiguousarray(values, "<f4")
    blocks = []
    for start in range(0, height, BLOCK_LINES):
        packed = _compressed(lines[start : start + BLOCK_LINES].tobytes())
        blocks.append(struct.pack("<ii", start, len(packed)) + packed)
    header = MAGIC + _header(width, height)
    first = len(header) + 8 * len(blocks)
    offsets = first + np.cumsum([0, *map(len, blocks[:-1])])
    with atomic_path(path) as temporary:
        temporary.write_bytes(header + offsets.astype("<u8").tobytes() + b"".join(blocks))


def _header(width: int, height: int) -> bytes:
    window = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    attributes = {
        ("channels", "chlist"): CHANNEL + b"\0" + struct.pack("<iB3xii", FLOAT, 0, 1, 1) + b"\0",
        ("compression", "compression"): bytes([ZIP]),
        ("dataWindow", "box2i"): window,
        ("displayWindow", "box2i"): window,
        ("lineOrder", "lineOrder"): b"\0",
        ("pixelAspectRatio", "float"): struct.pack("<f", 1.0),
        ("screenWindowCenter", "v2f"): struct.pack("<ff", 0.0, 0.0),
        ("screenWindowWidth", "float"): struct.pack("<f", 1.0),
    }
    parts = [
        f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value
        for (name, kind), value in attributes.items()
    ]
    return b"".join(parts) + b"\0"


def _compressed(raw: bytes) -> bytes:
    """Compress a block as OpenEXR's ZIP does; a block that would not become smaller is stored as it is."""
    split = np.frombuffer(raw, np.uint8)
    # The bytes at even places, then those at odd ones; each is replaced by its difference from the one before.
    split = np.concatenate([split[::2], split[1::2]])
    differences = split.copy()
    differences[1:] = split[1:] - split[:-1] + np.uint8(128)
    packed = zlib.compress(differences.tobytes(), 4)
    return packed if len(packed) < len(raw) else raw
