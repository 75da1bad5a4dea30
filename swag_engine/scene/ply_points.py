"""Sparse points of a PLY file of any program: positions, and colors where it has them."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..base.errors import InputError
from ..base.files import regular
from .lenses import Lens

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "double": "f8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_MOST_POINTS = 200_000
"""Points that are kept, at random: a dense cloud has more than training starts from."""
FEWEST_VISIBLE = 0.1
"""Fraction of the points of a PLY file in front of the cameras below which it has other coordinates."""
_SAMPLE = 2000
"""Maximum number of points and of cameras that this fraction is estimated from."""


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the vertices of a PLY file.

    Args:
        path: The file, binary or text.

    Returns:
        Positions (P, 3) float64, and colors (P, 3) uint8, (0, 3) where the file has none; at most
        200 000 points.

    Raises:
        InputError: When it cannot be read.
    """
    try:
        with open(path, "rb", opener=regular) as file:
            data = np.memmap(file, np.uint8, "r")
        header = bytes(data[:20_000])
    except (OSError, ValueError) as error:
        reason = "it is empty" if isinstance(error, ValueError) else error.strerror or str(error)
        raise InputError(f"Cannot read {path}: {reason}.") from error
    ending = re.search(rb"end_header[^\n]*\n", header)
    if not header.startswith(b"ply") or not ending:
        raise InputError(f"{path} is no PLY file.")
    form, count, fields = _layout(path, header[: ending.start()].decode("latin-1"))
    try:
        if form == "ascii":
            text = bytes(data[ending.end() :]).decode("latin-1").splitlines()
            rows = np.array([line.split()[: len(fields)] for line in text[:count]], np.float64).reshape(-1, len(fields))
            columns = {name: rows[:, index] for index, (name, _) in enumerate(fields)}
            length = len(rows)
        else:
            order = "<" if form == "binary_little_endian" else ">"
            kind = np.dtype([(name, order + type_name) for name, type_name in fields])
            table = np.frombuffer(data, kind, count, ending.end())
            columns, length = {name: table[name] for name, _ in fields}, len(table)
    except ValueError as error:
        raise InputError(f"{path} is damaged or was cut short: export it again.") from error
    if length < count:
        raise InputError(f"{path} is damaged or was cut short: export it again.")
    keep = np.arange(count)
    if count > _MOST_POINTS:
        keep = np.sort(np.random.default_rng(0).choice(count, _MOST_POINTS, replace=False))
    positions = np.stack([columns[axis][keep] for axis in "xyz"], -1).astype(np.float64)
    colors = np.zeros((0, 3), np.uint8)
    for names in (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")):
        if set(names) <= set(columns):
            values = np.stack([columns[name][keep] for name in names], -1).astype(np.float64)
            kinds = dict(fields)
            if kinds[names[0]] == "u2":
                values /= 257
            elif kinds[names[0]].startswith("f"):
                values *= 255
            colors = np.clip(np.round(values), 0, 255).astype(np.uint8)
            break
    finite = np.isfinite(positions).all(1)
    if not finite.any():
        raise InputError(f"{path} has no points.")
    return positions[finite], colors[finite] if len(colors) else colors


def _layout(path: Path, header: str) -> tuple[str, int, list[tuple[str, str]]]:
    """Return the form, the number of vertices, and name and numpy type of each property of a vertex."""
    form, count, fields, in_vertices = "", -1, [], False
    for line in header.splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == ["element"] and len(words) > 2:
            if count < 0 and words[1] != "vertex":
                raise InputError(f"{path} does not begin with vertices: export it as a point cloud.")
            in_vertices = words[1] == "vertex"
            count = int(words[2]) if in_vertices else count
        elif words[:1] == ["property"] and in_vertices:
            if len(words) != 3 or words[1] not in _TYPES:
                raise InputError(f"{path} has a property that points do not have: {line.strip()}.")
            fields.append((words[2].lower(), _TYPES[words[1]]))
    if form not in ("ascii", "binary_little_endian", "binary_big_endian") or not {"x", "y", "z"} <= dict(fields).keys():
        raise InputError(f"{path} is no PLY file of points: it has no x, y and z.")
    return form, count, fields


def visible_fraction(positions: np.ndarray, cameras: Sequence[tuple[np.ndarray, Lens]]) -> float:
    """Return the fraction of points (P, 3) that a sample of the cameras, poses (3, 4) and lenses, sees."""
    random = np.random.default_rng(0)
    sample = positions[random.permutation(len(positions))[:_SAMPLE]]
    seen = np.zeros(len(sample), bool)
    for number in random.permutation(len(cameras))[:_SAMPLE]:
        seen[points_inside(sample, *cameras[number])[0]] = True
    return float(seen.mean())


def points_inside(positions: np.ndarray, pose: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Find the points that project into a photo.

    Args:
        positions: Points (P, 3).
        pose: Transform (3, 4) or (4, 4) from the world to the camera.
        lens: Lens of the photo.

    Returns:
        Indices (N,) of the points, and their pixels (N, 2).
    """
    local = positions @ pose[:3, :3].T + pose[:3, 3]
    in_front = np.flatnonzero(local[:, 2] > 1e-9)
    pixels = np.asarray(lens.camera.img_from_cam(np.ascontiguousarray(local[in_front]))).reshape(-1, 2)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0).all(1) & (pixels[:, 0] < lens.width) & (pixels[:, 1] < lens.height)
    return in_front[inside], pixels[inside]
