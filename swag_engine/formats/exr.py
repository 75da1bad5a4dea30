"""OpenEXR images for compositing: depth in 32-bit floats, colors in 16-bit floats. numpy only.

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
DEPTH_CHANNEL = "Y"
"""Name of the channel of depth: luminance, which all programs read; many ignore a channel Z without colors."""
BLOCK_LINES = 16
"""Lines of one block of ZIP compression."""
HALF, FLOAT, ZIP = 1, 2, 3
"""Numbers of the pixel types and of the compression in the header."""
LARGEST_HALF = 65504.0
"""Largest 16-bit float: light above it is cut."""


def write_exr(path: Path, values: np.ndarray) -> None:
    """Write an image of one channel in 32-bit floats.

    Args:
        path: The file.
        values: (H, W) numbers.

    Raises:
        InputError: If the file cannot be written.
    """
    _write(path, {DEPTH_CHANNEL: values}, "<f4", FLOAT)


def write_light_exr(path: Path, light: np.ndarray) -> None:
    """Write an image of linear light in 16-bit floats.

    Args:
        path: The file.
        light: (H, W, 3) red, green, blue (Rec. 709 primaries, white 1); or (H, W, 4), premultiplied by alpha.

    Raises:
        InputError: If the file cannot be written.
    """
    within = light.clip(-LARGEST_HALF, LARGEST_HALF)
    _write(path, dict(zip("RGBA", np.moveaxis(within, -1, 0), strict=False)), "<f2", HALF)


def _write(path: Path, channels: dict[str, np.ndarray], dtype: str, pixel_type: int) -> None:
    names = sorted(channels)  # the order that the format prescribes
    lines = np.ascontiguousarray(np.stack([channels[name] for name in names], axis=1), dtype)
    height, _, width = lines.shape
    blocks = []
    for start in range(0, height, BLOCK_LINES):
        packed = _compressed(lines[start : start + BLOCK_LINES].tobytes())
        blocks.append(struct.pack("<ii", start, len(packed)) + packed)
    header = MAGIC + _header(width, height, names, pixel_type)
    first = len(header) + 8 * len(blocks)
    offsets = first + np.cumsum([0, *map(len, blocks[:-1])])
    with atomic_path(path) as temporary:
        temporary.write_bytes(header + offsets.astype("<u8").tobytes() + b"".join(blocks))


def _header(width: int, height: int, names: list[str], pixel_type: int) -> bytes:
    window = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    channels = b"".join(name.encode() + b"\0" + struct.pack("<iB3xii", pixel_type, 0, 1, 1) for name in names)
    attributes = {
        ("channels", "chlist"): channels + b"\0",
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
