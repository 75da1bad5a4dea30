"""3DGS PLY, the layout of Kerbl et al. 2023 that splat programs read. numpy only, Blender imports it.

Binary little-endian, one element `vertex`: x y z nx ny nz f_dc_0..2 f_rest_0.. (all of R, then G, then B) opacity
(logit) scale_0..2 (natural logarithm) rot_0..3 (wxyz), then the extras under their own names and types. The comments
`crs NAME` and `crs_offset X Y Z` say where splats with a placement lie: offset + position, z up, in metres. A comment
`origin X Y Z` says what was subtracted from coordinates that were too large for float32. Comments
`development_NAME NUMBERS` have the values of `SplatDevelopment.to_json`: 1 or 0 for `applied`, a matrix row by row.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from itertools import islice
from math import isqrt
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path, regular
from ..base.foreign_files import refuse_foreign
from ..base.local_origin import local_origin
from ..scene.georeference import Placement
from ..splats.development import SplatDevelopment
from ..splats.splats import Splats, clean_splats
from ..splats.transform import C0
from .compressed_ply import WORDS, unpack
from .export_format import ExportFormat
from .place import place_from_json, place_to_json

log = logging.getLogger(__name__)

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""PLY's names of types -> numpy's codes, without the byte order."""
TYPE_NAMES = {code: name for name, code in reversed(TYPES.items())}
"""numpy's codes -> the names that are written."""
BASE = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
NORMAL = ("nx", "ny", "nz")
COLOR = ("f_dc_0", "f_dc_1", "f_dc_2")
PLAIN_COLORS = (("red", "green", "blue"), ("r", "g", "b"))
"""Properties of plain colors, which are read where f_dc is missing: 0..1, 0..255 or 0..65535."""
FILTER = "filter_3D"
"""Standard deviation of the 3D smoothing filter of Mip-Splatting (Yu et al. 2024, equation 9), world units."""
FLATNESS = 1e-3
"""Thickness of a 2D Gaussian, which has two scales, over the smaller of them."""
BLOCK = 8192
"""Rows read or written at a time: few enough to stay in the processor's cache, which makes column access fast."""
MAX_HEADER = 1 << 20
"""Bytes of a header; real ones are a few kilobytes, and one without end must not fill the memory."""
SMALLEST_OPACITY = 1e-8
"""Distance from 0 and 1 that opacities are clipped to, where float32 logits still differ; 1 is read back as 1."""


def write_ply(path: Path, splats: Splats) -> None:
    """Write splats as a 3DGS PLY of their own degree. The file is whole or absent.

    Extras keep their dtype (bool becomes uchar, 64-bit integers int, half floats float).

    Args:
        path: File to write.
        splats: Splats to write.

    Raises:
        InputError: If there are no splats, the name of an extra is in use or holds a space, its integers do not fit 32
            bits, or the file cannot be written.
    """
    write_ply_parts(path, [splats], len(splats))


def write_ply_parts(path: Path, parts: Iterable[Splats], count: int) -> None:
    """Write splats that come in parts as one 3DGS PLY, with one part in memory. The file is whole or absent.

    Args:
        path: File to write.
        parts: The splats in their order, all of the same SH degree, extras (and dtypes of these), placement and
            development.
        count: Number of splats of all parts together.

    Raises:
        InputError: As `write_ply`.
        ValueError: If parts differ in their properties, or hold another number of splats.
    """
    left, known = count, b""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        for part in parts:
            header, row, extras = _layout(path, part, count)
            if not known:
                file.write(header)
                rows = np.zeros(BLOCK, row)
            elif header != known:
                raise ValueError(f"parts of {path} differ in their properties")
            known = header
            _write_rows(file, part, rows, extras)
            left -= len(part)
        if left or not known:
            raise ValueError(f"the parts of {path} hold {count - left} splats, not {count}")


def _write_rows(file: BinaryIO, splats: Splats, rows: np.ndarray, extras: dict[str, np.ndarray]) -> None:
    """Append splats to a file, through `rows` of its dtype."""
    for start in range(0, len(splats), BLOCK):
        part = slice(start, min(start + BLOCK, len(splats)))
        block = rows[: part.stop - start]
        opacities = splats.opacities[part].astype(np.float64).clip(SMALLEST_OPACITY, 1 - SMALLEST_OPACITY)
        scales = splats.scales[part].astype(np.float64).clip(np.finfo(np.float32).tiny)
        block["position"] = splats.positions[part]
        block["f_dc"] = splats.sh[part, 0]
        block["f_rest"] = splats.sh[part, 1:].transpose(0, 2, 1).reshape(len(block), -1)
        block["opacity"] = np.log(opacities / (1 - opacities))
        block["scale"] = np.log(scales)
        block["rotation"] = splats.rotations[part]
        for name, values in extras.items():
            block[f"extra {name}"] = values[part]
        file.write(block.data)


def ply_size(path: Path, splats: Splats) -> int:
    """Return the size in bytes of the file that `write_ply` makes of the same arguments.

    Raises:
        InputError: As `write_ply` before it writes.
    """
    header, row, _ = _layout(path, splats, len(splats))
    return len(header) + len(splats) * row.itemsize


def _layout(path: Path, splats: Splats, count: int) -> tuple[bytes, np.dtype, dict[str, np.ndarray]]:
    """Return the header for `count` splats like these, the dtype of a row, and the extras in dtypes that PLY has."""
    if not count:
        raise InputError(f"There are no splats to write to {path}; choose at least one.")
    rest = (splats.sh.shape[1] - 1) * 3
    names = ["x", "y", "z", *NORMAL, "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", *ROTATION]
    extras = {name: _storable(path, name, values) for name, values in splats.extras.items()}
    if taken := [name for name in extras if name in names or not name or len(name.split()) != 1]:
        raise InputError(f"Cannot write {path}: a PLY cannot hold a property of the name '{taken[0]}'; rename it.")
    comments = _place_comments(splats) + _development_comments(splats.development)
    header = ["ply", "format binary_little_endian 1.0", *comments]
    header += [f"element vertex {count}"]
    header += [f"property float {name}" for name in names]
    header += [f"property {TYPE_NAMES[values.dtype.str[1:]]} {name}" for name, values in extras.items()]
    row: list[tuple] = [
        ("position", "<f4", 3), ("normal", "<f4", 3), ("f_dc", "<f4", 3), ("f_rest", "<f4", rest), ("opacity", "<f4"),
        ("scale", "<f4", 3), ("rotation", "<f4", 4),
    ]  # fmt: skip
    row += [(f"extra {name}", values.dtype.newbyteorder("<")) for name, values in extras.items()]
    return ("\n".join([*header, "end_header"]) + "\n").encode(), np.dtype(row), extras


@np.errstate(over="ignore", invalid="ignore")  # numbers beyond float32 become infinities, and their splats are dropped
def read_ply(path: Path) -> Splats:
    """Read a 3DGS PLY: ASCII or binary of either byte order, any order and type of properties, degree 0 to 3.

    The compressed PLY of SuperSplat is read too. Plain colors stand in for f_dc, two scales are a flat Gaussian, one is
    a sphere, and the filter of Mip-Splatting is applied. Normals are dropped, other properties become extras of their
    own dtype, degrees above 3 are dropped with a warning. Quaternions are normalised; splats with a NaN or an infinity
    are dropped with a warning (an infinite logit is an opacity of 0 or 1 and is kept).

    Args:
        path: The file.

    Returns:
        The splats.

    Raises:
        InputError: If the file is missing, not a PLY, without Gaussian splats, damaged or cut off.
    """
    try:
        with open(path, "rb", opener=regular) as file:
            refuse_foreign(path)
            return _read(path, file)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)  # name, numpy code or "list"

    @property
    def is_packed(self) -> bool:
        return set(WORDS) <= {name for name, code in self.properties if code == "u4"}


def _read(path: Path, file: BinaryIO) -> Splats:
    order, elements, comments = _read_header(path, file)
    vertex, sources = _splat_element(path, elements)
    if vertex.is_packed:
        return _read_packed(path, file, order, elements)
    names = [name for name, _ in vertex.properties]
    rest = sum(name.startswith("f_rest_") for name in names)
    per_channel = rest // 3
    side = isqrt(per_channel + 1)
    whole = rest == 3 * per_channel and side * side == per_channel + 1
    if not whole or not {f"f_rest_{i}" for i in range(rest)} <= set(names):
        raise InputError(
            f"{path} has {rest} f_rest properties, which are not those of a degree of spherical harmonics; write the "
            "file again."
        )
    coefficients = min(side, 4) ** 2
    if side > 4:
        log.warning("%s: spherical harmonics above degree 3 were dropped", path)

    read_rows = _row_reader(path, file, order, elements, vertex)
    count = vertex.count
    positions = np.empty((count, 3), np.float64)
    base = np.empty((count, len(BASE)), np.float32)
    rotations = np.zeros((count, 4), np.float32)
    sh = np.empty((count, coefficients, 3), np.float32)
    known = {*sources.values(), *NORMAL, *(f"f_rest_{i}" for i in range(rest))}
    extras = {name: np.empty(count, code) for name, code in vertex.properties if name not in known}
    for start in range(0, count, BLOCK):
        part = slice(start, min(start + BLOCK, count))
        rows = read_rows(part.stop - start)
        for column, name in enumerate(BASE):
            (positions if column < 3 else base)[part, column] = rows[sources[name]]
        for column, name in enumerate(ROTATION):
            if name in sources:
                rotations[part, column] = rows[name]
        for i in range(1, coefficients):
            for channel in range(3):
                sh[part, i, channel] = rows[f"f_rest_{channel * per_channel + i - 1}"]
        for name, values in extras.items():
            values[part] = rows[name]
    sh[:, 0] = base[:, 3:6]
    if sources["f_dc_0"] != "f_dc_0":
        largest = sh[:, 0][np.isfinite(sh[:, 0])].max(initial=0)
        is_float = dict(vertex.properties)[sources["f_dc_0"]].startswith("f")
        white = 1 if is_float and largest <= 2 else 255 if largest <= 255 else 65535
        sh[:, 0] = (sh[:, 0] / white - 0.5) / C0
    opacities = 1 / (1 + np.exp(-base[:, 6].astype(np.float64)))
    scales = np.exp(base[:, 7:].astype(np.float64))
    axes = 2 if sources["scale_2"] == "scale_1" else 3
    if FILTER in extras:
        wide = np.hypot(scales, extras.pop(FILTER)[:, None])
        opacities *= (scales / wide)[:, :axes].prod(axis=1)
        scales = wide
    if axes == 2:
        scales[:, 2] = FLATNESS * scales[:, :2].min(axis=1)
    placement, origin = _place(comments)
    for name, found in (("crs_offset", placement is not None), ("origin", any(origin))):
        if name in comments and not found:
            log.warning("%s: the comment %s is not three usable numbers and was left out", path, name)
    finite = np.isfinite(positions).all(axis=1)
    if dict(vertex.properties)["x"] == "f8" and finite.any():
        own = local_origin(positions[finite])
        positions -= own
        x, y, z = (own + origin).tolist()
        origin = x, y, z
    positions = positions.astype(np.float32)
    splats = Splats(positions, rotations, scales.astype(np.float32), opacities.astype(np.float32), sh, extras)
    return clean_splats(replace(splats, placement=placement, development=_development(comments), origin=origin), path)


def _place_comments(splats: Splats) -> list[str]:
    """Return the lines of a header that say where the splats lie; doubles are written so that they are read back."""
    place = place_to_json(splats)
    words = {"crs": [place.get("crs")], "crs_offset": place.get("offset"), "origin": place.get("origin")}
    return [
        " ".join(["comment", name, *map(str, values)])
        for name, values in words.items()
        if values and values[0] is not None
    ]


def _place(comments: dict[str, list[str]]) -> tuple[Placement | None, tuple[float, float, float]]:
    """Return what the comments of a header say of where the splats lie, by the first word of each."""
    document: dict[str, Any] = {"crs": comments["crs"][0] if comments.get("crs") else None}
    for name, key in (("crs_offset", "offset"), ("origin", "origin")):
        try:
            document[key] = [float(word) for word in comments.get(name, ())]
        except ValueError:
            continue
    return place_from_json(document)


def _development_comments(development: SplatDevelopment | None) -> list[str]:
    """Return the lines of a header that name the development, each short, since some programs limit the length."""
    if development is None:
        return []
    values = {name: np.ravel(value).astype(float) for name, value in development.to_json().items()}
    return [f"comment development_{name} {' '.join(map(repr, value.tolist()))}" for name, value in values.items()]


def _development(comments: dict[str, list[str]]) -> SplatDevelopment | None:
    """Return the development that the comments of a header name, None without them."""
    prefix = "development_"
    try:
        values = {
            name.removeprefix(prefix): [float(word) for word in words] if len(words) > 1 else float(words[0])
            for name, words in comments.items()
            if name.startswith(prefix)
        }
        return SplatDevelopment.from_json(values | {"applied": bool(values["applied"])})
    except (InputError, KeyError, IndexError, ValueError):
        return None


def _read_header(path: Path, file: BinaryIO) -> tuple[str, list[_Element], dict[str, list[str]]]:
    """Return the byte order ("<", ">" or "" for ASCII), the elements, and the comments by their first words.

    `file` is then at the first byte of data.
    """
    start = file.read(4)
    if not start:
        raise InputError(f"{path} is empty.")
    if start[:2] in (b"\x1f\x8b", b"PK") or start == b"NGSP":
        raise InputError(
            f"{path} is a compressed splat file, not a PLY: give an SPZ file the ending .spz, a SOG file .sog."
        )
    if start[:3] != b"ply" or start[3:] not in (b"\n", b"\r"):
        raise InputError(f"{path} is not a PLY file.")
    file.seek(3)
    file.readline()
    order: str | None = None
    elements: list[_Element] = []
    comments: dict[str, list[str]] = {}
    try:
        while (line := file.readline(65536).decode("utf-8", "replace")) != "":
            if file.tell() > MAX_HEADER:
                raise ValueError("a header without end")
            match line.split():
                case ["end_header"]:
                    if order is None:
                        raise ValueError("no format")
                    return order, elements, comments
                case ["comment", name, *words]:
                    comments[name] = words
                case ["format", name, *_]:
                    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[name]
                case ["element", name, number]:
                    elements.append(_Element(name, int(number)))
                    if not 0 <= elements[-1].count < 2**60:
                        raise ValueError("not a number of splats")
                case ["property", "list", _, _, name]:
                    elements[-1].properties.append((name, "list"))
                case ["property", kind, name]:
                    elements[-1].properties.append((name, TYPES[kind]))
                case ["property" | "element", *_]:
                    raise ValueError(line)
                case _:  # obj_info
                    pass
    except (ValueError, KeyError, IndexError):
        raise InputError(f"The header of {path} is damaged; write the file again.") from None
    raise InputError(f"{path} is cut off inside its header; copy or write the file again.")


def _splat_element(path: Path, elements: list[_Element]) -> tuple[_Element, dict[str, str]]:
    """Return the element that holds the splats, and the property that each of BASE and ROTATION is read from."""
    vertex = next((element for element in elements if element.name == "vertex"), None)
    names = [name for name, _ in vertex.properties] if vertex else []
    if vertex is None or not (vertex.is_packed or {"f_dc_0", "scale_0", "rot_0"} & set(names)):
        raise InputError(f"{path} is a plain point cloud or mesh, without the properties of Gaussian splats.")
    sources = {name: name for name in (*BASE, *ROTATION) if name in names}
    if not set(COLOR) & set(names):
        sources |= dict(zip(COLOR, next((rgb for rgb in PLAIN_COLORS if set(rgb) <= set(names)), ()), strict=False))
    wanted: tuple[str, ...] = (*BASE, *ROTATION)
    match [name for name in BASE if name in names and name.startswith("scale_")]:
        case ["scale_0", "scale_1"]:
            sources["scale_2"] = "scale_1"
        case ["scale_0"]:
            sources |= {"scale_1": "scale_0", "scale_2": "scale_0"}
            wanted = BASE
    missing = [name for name in wanted if name not in sources]
    if missing and not vertex.is_packed:
        raise InputError(f"{path} lacks {', '.join(missing)}, which Gaussian splats need: write it again with them.")
    if len(set(names)) != len(names) or any(code == "list" for _, code in vertex.properties):
        raise InputError(f"The header of {path} is damaged: its splats have a property twice, or a list.")
    if not vertex.count:
        raise InputError(f"{path} holds no splats.")
    return vertex, sources


def _read_packed(path: Path, file: BinaryIO, order: str, elements: list[_Element]) -> Splats:
    """Return the splats of a compressed PLY."""
    damaged = InputError(f"{path} is a damaged compressed PLY: its parts do not fit together; write the file again.")
    found: dict[str, np.ndarray] = {}
    here = file.tell()
    size = file.seek(0, 2)
    if not order:
        raise damaged
    try:
        for element in elements:
            row = np.dtype([(name, order + code) for name, code in element.properties])
            if element.count * row.itemsize > size - here:
                raise InputError(f"{path} is cut off; copy or write it again.")
            if element.name in ("chunk", "vertex", "sh") and element.properties:  # gsplat's degree 0 is an empty sh
                file.seek(here)
                found[element.name] = np.frombuffer(file.read(element.count * row.itemsize), row)
            here += element.count * row.itemsize
        return clean_splats(unpack(found["chunk"], found["vertex"], found.get("sh")), path)
    except (ValueError, KeyError, TypeError):
        raise damaged from None


def _row_reader(
    path: Path, file: BinaryIO, order: str, elements: list[_Element], vertex: _Element
) -> Callable[[int], np.ndarray]:
    """Return a function that reads the next n rows of `vertex`; raises InputError for a file too short for all."""
    before = elements[: elements.index(vertex)]
    row = np.dtype([(name, order + code) for name, code in vertex.properties])
    here = file.tell()
    remaining = file.seek(0, 2) - here
    file.seek(here)
    cut_off = InputError(
        f"{path} is cut off: its header announces {vertex.count} splats and it holds fewer; copy or write it again."
    )

    if not order:
        # A value takes at least a digit and a separator.
        if vertex.count * 2 * len(vertex.properties) > remaining + 1:
            raise cut_off
        lines = (line for line in file if line.strip())
        for _ in islice(lines, sum(element.count for element in before)):
            pass

        def read_text(count: int) -> np.ndarray:
            try:
                rows = np.loadtxt(islice(lines, count), row, comments=None, ndmin=1)
            except ValueError:
                raise InputError(f"{path} is damaged: a line of its splats is not the numbers announced.") from None
            if len(rows) != count:
                raise cut_off
            return rows

        return read_text

    if any(code == "list" for element in before for _, code in element.properties):
        raise InputError(f"{path} has lists before its splats, which no splat program writes; write the file again.")
    skipped = sum(element.count * np.dtype([(n, c) for n, c in element.properties]).itemsize for element in before)
    if skipped + vertex.count * row.itemsize > remaining:
        raise cut_off
    file.seek(here + skipped)
    return lambda count: np.frombuffer(file.read(count * row.itemsize), row)


def _storable(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    """Return values in a dtype that PLY has."""
    if values.dtype.kind in "iu" and values.dtype.itemsize == 8:
        narrow = values.astype(np.int32)
        if not np.array_equal(narrow, values):
            raise InputError(f"Cannot write {path}: a PLY cannot hold the large integers of the property {name}.")
        return narrow
    if values.dtype == bool:
        return values.astype(np.uint8)
    return values if values.dtype.str[1:] in TYPE_NAMES else values.astype(np.float32)


FORMAT = ExportFormat(
    name="ply",
    suffix=".ply",
    title="PLY (3DGS)",
    description="The 3D Gaussian Splatting layout that most splat programs read.",
    options=frozenset({"up", "extras"}),
    write=lambda path, splats, up, cameras: write_ply(path, splats),
    size=lambda path, splats, up, cameras: ply_size(path, splats),
    read=lambda path, up: read_ply(path),
)
