"""Reader of the compressed PLY of SuperSplat, PlayCanvas and gsplat. numpy only, Blender imports it.

Element `chunk` has bounds for every 256 splats. Element `vertex` has four 32-bit words a splat: position and logarithms
of the scales as fractions between the bounds (11, 10 and 11 bits, highest bits first); the quaternion wxyz as the index
of its largest component (2 bits) and the other three (10 bits each, from -1/sqrt(2) to 1/sqrt(2)); color and opacity
(8 bits each). Element `sh` has one byte for each further coefficient, from -4 to 4. The format is described at
https://blog.playcanvas.com/compressing-gaussian-splats; details were checked against files that splat-transform made of
known splats.
"""

import numpy as np

from ..splats.splats import Splats
from ..splats.transform import C0

WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
"""Properties of the element `vertex`."""
CHUNK = 256
"""Splats that share bounds."""
BOUNDS = tuple(f"{end}_{axis}" for end in ("min", "max") for axis in ("x", "y", "z", "scale_x", "scale_y", "scale_z"))
"""Properties of the element `chunk` that every file has."""
BLOCK = 32 * CHUNK
"""Splats unpacked at a time: whole chunks."""


def unpack(chunks: np.ndarray, vertices: np.ndarray, coefficients: np.ndarray | None) -> Splats:
    """Unpack splats from the elements of a file.

    Args:
        chunks: Element `chunk`, a structured array with the file's properties.
        vertices: Element `vertex`, (N,).
        coefficients: Element `sh`, (N,), None for splats of degree 0.

    Returns:
        The N splats.

    Raises:
        ValueError: If there are too few chunks, or the coefficients are not those of degree 0 to 3.
    """
    count = len(vertices)
    if len(chunks) * CHUNK < count or not set(BOUNDS) <= set(chunks.dtype.names or ()):
        raise ValueError("splats without bounds")
    rest = len(coefficients.dtype) if coefficients is not None else 0
    if rest not in (0, 9, 24, 45) or (coefficients is not None and len(coefficients) != count):
        raise ValueError("coefficients of no degree of spherical harmonics")
    positions, rotations = np.empty((count, 3), np.float32), np.empty((count, 4), np.float32)
    scales, opacities = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    sh = np.empty((count, 1 + rest // 3, 3), np.float32)
    for start in range(0, count, BLOCK):
        part = slice(start, min(start + BLOCK, count))
        rows = vertices[part]
        chunk = chunks[start // CHUNK + np.arange(len(rows)) // CHUNK]
        positions[part] = _within(chunk, _vector_fractions(rows["packed_position"]), "{}_x", "{}_y", "{}_z")
        log_scales = _vector_fractions(rows["packed_scale"])
        scales[part] = np.exp(_within(chunk, log_scales, "{}_scale_x", "{}_scale_y", "{}_scale_z"))
        rotations[part] = _rotations(rows["packed_rotation"])
        color = np.stack([_fraction(rows["packed_color"], shift, 8) for shift in (24, 16, 8)], axis=1)
        if "min_r" in chunks.dtype.names:
            color = _within(chunk, color, "{}_r", "{}_g", "{}_b")
        sh[part, 0] = (color - 0.5) / C0
        opacities[part] = _fraction(rows["packed_color"], 0, 8)
        if coefficients is not None:
            for i in range(rest):
                channel, index = divmod(i, rest // 3)
                step = coefficients[f"f_rest_{i}"][part]
                fraction = np.where(step == 0, 0, np.where(step == 255, 1, (step + 0.5) / 256))
                sh[part, 1 + index, channel] = (fraction - 0.5) * 8
    return Splats(positions, rotations, scales, opacities, sh)


def _fraction(words: np.ndarray, shift: int, bits: int) -> np.ndarray:
    """Return the number in the `bits` bits above `shift` of each word, scaled to 0..1."""
    largest = 2**bits - 1
    return ((words >> np.uint32(shift)) & np.uint32(largest)) / largest


def _vector_fractions(words: np.ndarray) -> np.ndarray:
    """Return (N, 3) in 0..1 from words of 11, 10 and 11 bits."""
    return np.stack([_fraction(words, 21, 11), _fraction(words, 11, 10), _fraction(words, 0, 11)], axis=1)


def _within(chunk: np.ndarray, fractions: np.ndarray, *names: str) -> np.ndarray:
    """Interpolate between each splat's lower and upper bounds by fractions (N, 3)."""
    lower, upper = (np.stack([chunk[name.format(end)] for name in names], axis=1) for end in ("min", "max"))
    return lower * (1 - fractions) + upper * fractions


def _rotations(words: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) wxyz."""
    others = np.stack([_fraction(words, shift, 10) - 0.5 for shift in (20, 10, 0)], axis=1) * np.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    place = (words >> np.uint32(30)).astype(np.intp)[:, None]
    # The index of each of the three others is one higher where the largest comes before it.
    columns = np.arange(3) + (np.arange(3) >= place)
    rotations = np.empty((len(words), 4))
    np.put_along_axis(rotations, columns, others, axis=1)
    np.put_along_axis(rotations, place, largest[:, None], axis=1)
    return rotations
