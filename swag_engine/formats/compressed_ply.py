"""The compressed PLY of SuperSplat, PlayCanvas and gsplat. numpy only, Blender's Python imports it.

`chunk` has bounds for every 256 splats; `vertex` has four 32-bit words a splat, which say where between the bounds its
position and the logarithms of its scales lie (11, 10 and 11 bits from the top down), which component of its quaternion
is the largest (2 bits) and what the other three are (10 bits each, from -1/sqrt(2) to 1/sqrt(2), wxyz), and colour and
opacity (8 bits each); `sh` has a byte for each further coefficient, from -4 to 4. Described by the format's authors at
https://blog.playcanvas.com/compressing-gaussian-splats and told by what splat-transform makes of known splats.
"""

import numpy as np

from ..splats.splats import Splats

WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
CHUNK = 256
BOUNDS = tuple(f"{end}_{axis}" for end in ("min", "max") for axis in ("x", "y", "z", "scale_x", "scale_y", "scale_z"))
C0 = 0.28209479177387814
# Splats handled at a time: whole chunks.
BLOCK = 32 * CHUNK


def unpack(chunks: np.ndarray, vertices: np.ndarray, coefficients: np.ndarray | None) -> Splats:
    """The splats of the elements `chunk`, `vertex` and `sh`, structured arrays with the file's properties.

    Raises ValueError when there are too few chunks or the coefficients are no whole degree.
    """
    count = len(vertices)
    if len(chunks) * CHUNK < count or not set(BOUNDS) <= set(chunks.dtype.names or ()):
        raise ValueError("splats without bounds")
    rest = len(coefficients.dtype) if coefficients is not None else 0
    if rest not in (0, 9, 24, 45) or (coefficients is not None and len(coefficients) != count):
        raise ValueError("no whole degree of spherical harmonics")
    positions, rotations = np.empty((count, 3), np.float32), np.empty((count, 4), np.float32)
    scales, opacities = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    sh = np.empty((count, 1 + rest // 3, 3), np.float32)
    for start in range(0, count, BLOCK):
        part = slice(start, min(start + BLOCK, count))
        rows = vertices[part]
        chunk = chunks[start // CHUNK + np.arange(len(rows)) // CHUNK]
        positions[part] = _between(chunk, _three(rows["packed_position"]), "{}_x", "{}_y", "{}_z")
        scales[part] = np.exp(_between(chunk, _three(rows["packed_scale"]), "{}_scale_x", "{}_scale_y", "{}_scale_z"))
        rotations[part] = _rotation(rows["packed_rotation"])
        color = np.stack([_share(rows["packed_color"], shift, 8) for shift in (24, 16, 8)], axis=1)
        if "min_r" in chunks.dtype.names:
            color = _between(chunk, color, "{}_r", "{}_g", "{}_b")
        sh[part, 0] = (color - 0.5) / C0
        opacities[part] = _share(rows["packed_color"], 0, 8)
        if coefficients is not None:
            for i in range(rest):
                channel, index = divmod(i, rest // 3)
                step = coefficients[f"f_rest_{i}"][part]
                share = np.where(step == 0, 0, np.where(step == 255, 1, (step + 0.5) / 256))
                sh[part, 1 + index, channel] = (share - 0.5) * 8
    return Splats(positions, rotations, scales, opacities, sh)


def _share(words: np.ndarray, shift: int, bits: int) -> np.ndarray:
    """The `bits` bits above `shift` of each word, from 0 to 1."""
    most = 2**bits - 1
    return ((words >> np.uint32(shift)) & np.uint32(most)) / most


def _three(words: np.ndarray) -> np.ndarray:
    """(N, 3) from 0 to 1 of words of 11, 10 and 11 bits."""
    return np.stack([_share(words, 21, 11), _share(words, 11, 10), _share(words, 0, 11)], axis=1)


def _between(chunk: np.ndarray, shares: np.ndarray, *names: str) -> np.ndarray:
    """`shares` (N, 3) of the way from each splat's lower to its upper bounds."""
    lower, upper = (np.stack([chunk[name.format(end)] for name in names], axis=1) for end in ("min", "max"))
    return lower * (1 - shares) + upper * shares


def _rotation(words: np.ndarray) -> np.ndarray:
    """(N, 4) quaternions wxyz."""
    others = np.stack([_share(words, shift, 10) - 0.5 for shift in (20, 10, 0)], axis=1) * np.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    place = (words >> np.uint32(30)).astype(np.intp)[:, None]
    # Each of the three goes to its own place, or one further where the largest comes before it.
    columns = np.arange(3) + (np.arange(3) >= place)
    rotations = np.empty((len(words), 4))
    np.put_along_axis(rotations, columns, others, axis=1)
    np.put_along_axis(rotations, place, largest[:, None], axis=1)
    return rotations
