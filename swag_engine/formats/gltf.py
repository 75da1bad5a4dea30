"""GLB with KHR_gaussian_splatting, which web viewers and Cesium read. numpy only, Blender imports it.

Scales are linear, opacities 0..1, quaternions xyzw, spherical harmonics as in 3DGS; the splats keep their own axes and
a node rotates them to glTF's axes, in which y is up. The extension is described at
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting.
"""

import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from math import atan
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path, read_bytes
from ..base.strict_json import from_json
from ..base.transfer import srgb_to_linear
from ..scene.cameras import Camera
from ..splats.development import SplatDevelopment
from ..splats.splats import Splats, clean_splats, concatenate
from ..splats.transform import C0, quaternions, rotation_matrices, rotation_to_y_up, transformed
from .export_format import Direction, ExportFormat
from .place import place_from_json, place_to_json

log = logging.getLogger(__name__)

EXTENSION = "KHR_gaussian_splatting"
READABLE = {EXTENSION, "KHR_mesh_quantization"}
"""Extensions that a file may require and still be read."""
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""glTF's componentType -> numpy's type code."""
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
"""glTF's accessor type -> numbers per element."""
SHORT, UNSIGNED_SHORT, FLOAT = 5122, 5123, 5126
"""Keys of COMPONENTS that are written."""
ARRAY_BUFFER = 34962
"""glTF's target of a bufferView with vertex attributes."""
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
"""Types of a GLB's chunks."""
BLOCK = 8192
"""Splats read at a time: few enough to stay in the processor's cache."""
MAX_COPIES = 4
"""How many times a scene may show the same splats, so that a small file cannot fill the memory."""
COLMAP_UP = (0.0, -1.0, 0.0)
"""Up direction in COLMAP's axes."""
Z_UP = (0.0, 0.0, 1.0)
"""Up direction of splats with a placement."""
CAMERA_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the axes of glTF's cameras (looking along -z, y up) to those of COLMAP's (looking along z, y down)."""
MAX_JSON = 16 << 20
"""Bytes of the JSON chunk. Splats need a few kilobytes; Python takes up to 30 times the size of hostile JSON."""


def write_glb(path: Path, splats: Splats, up: Direction = COLMAP_UP, cameras: Sequence[Camera] = ()) -> None:
    """Write splats as a GLB of their own degree. The file is whole or absent.

    The extras of the asset say where splats with a placement lie (`crs`, `offset`, in the axes of the splats: metres
    with z up), `origin` is that of the splats in their axes, and `development` there holds what
    `SplatDevelopment.to_json` returned.

    COLOR_0 holds the constant color as linear light, for programs that cannot show splats. Extras become attributes
    `_NAME` in upper case: integers within 16 bits as such, other numbers as finite float32 (a NaN as 0).

    Args:
        path: File to write.
        splats: Splats to write.
        up: Direction (3,) in the splats' world that is up: the node that holds the splats rotates it to glTF's y. The
            default suits COLMAP (the node turns by 180 degrees around x), (0, 0, 1) suits Blender.
        cameras: Cameras of the splats' world, written under the same node. glTF has no principal point: the image
            centre is used, and the exact intrinsics are in the node's extras.

    Raises:
        InputError: If there are no splats, they take more than the 4 GiB that a GLB can hold, a position is not finite,
            names of extras differ only in case, extras hold integers beyond 24 bits, or the file cannot be written.
    """
    head, arrays = _assemble(path, splats, up, cameras)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(head)
        for array in arrays:
            file.write(np.ascontiguousarray(array).data)


def glb_size(path: Path, splats: Splats, up: Direction = COLMAP_UP, cameras: Sequence[Camera] = ()) -> int:
    """Return the size in bytes of the file that `write_glb` makes of the same arguments.

    Raises:
        InputError: As `write_glb` before it writes.
    """
    head, arrays = _assemble(path, splats, up, cameras)
    return len(head) + sum(array.nbytes for array in arrays)


def _assemble(path: Path, splats: Splats, up: Direction, cameras: Sequence[Camera]) -> tuple[bytes, list[np.ndarray]]:
    """Return the bytes before the attributes, and the attributes."""
    if not len(splats):
        raise InputError(f"There are no splats to write to {path}; choose at least one.")
    if not np.isfinite(splats.positions).all():
        raise InputError(f"Cannot write {path}: a splat's position is not finite; remove that splat.")
    attributes = dict(_attributes(path, splats))
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for array, component, kind in attributes.values():
        view = {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": ARRAY_BUFFER}
        accessor = {"bufferView": len(views), "componentType": component, "count": len(splats), "type": kind}
        if component != FLOAT and kind == "SCALAR":
            view["byteStride"] = 4  # the low half of an int32
        if kind == "VEC4" and component == UNSIGNED_SHORT:
            accessor["normalized"] = True
        views.append(view)
        accessors.append(accessor)
        offset += array.nbytes
    accessors[0]["min"] = splats.positions.min(axis=0).tolist()
    accessors[0]["max"] = splats.positions.max(axis=0).tolist()
    primitive = {
        "mode": 0,
        "attributes": {name: index for index, name in enumerate(attributes)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    asset: dict[str, Any] = {"version": "2.0", "generator": "SWAG Splatting"}
    extras = place_to_json(splats)
    if splats.development:
        extras["development"] = splats.development.to_json()
    if extras:
        asset["extras"] = extras
    node: dict[str, Any] = {"name": path.stem, "mesh": 0, "rotation": _xyzw(rotation_to_y_up(up_of(splats, up)))}
    document: dict[str, Any] = {
        "asset": asset,
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    if cameras:
        # A depth buffer needs a near limit: a hundredth of the size of the scene's middle half.
        near = 0.01 * float(np.linalg.norm(np.ptp(np.percentile(splats.positions, (25, 75), axis=0), axis=0))) or 0.01
        node["children"] = list(range(1, 1 + len(cameras)))
        document["nodes"] += [_camera_node(camera, index) for index, camera in enumerate(cameras)]
        document["cameras"] = [_camera(camera, near) for camera in cameras]
    text = json.dumps(document, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + offset
    if total >= 2**32:
        raise InputError(f"{path} would be larger than the 4 GiB a GLB can hold; lower the SH degree or write a PLY.")
    head = b"glTF" + np.array([2, total, len(text), JSON_CHUNK], "<u4").tobytes() + text
    return head + np.array([offset, BINARY_CHUNK], "<u4").tobytes(), [array for array, _, _ in attributes.values()]


def up_of(splats: Splats, up: Direction) -> Direction:
    """Return the direction that is up in the world of splats: z with a placement, else `up`."""
    return Z_UP if splats.placement else up


def _camera(camera: Camera, near: float) -> dict[str, Any]:
    """Return a glTF camera of the same focal lengths; `near` in the splats' units."""
    perspective = {
        "yfov": 2 * atan(camera.height / (2 * camera.fy)),
        "aspectRatio": (camera.width / camera.fx) / (camera.height / camera.fy),
        "znear": near,
    }
    return {"name": camera.name, "type": "perspective", "perspective": perspective}


def _camera_node(camera: Camera, index: int) -> dict[str, Any]:
    """Return the node that places the camera of that index among the splats."""
    pose = np.linalg.inv(camera.world_to_camera) @ CAMERA_AXES
    intrinsics = {name: value for name, value in asdict(camera).items() if name not in ("name", "world_to_camera")}
    return {
        "name": camera.name,
        "camera": index,
        "rotation": _xyzw(pose[:3, :3]),
        "translation": pose[:3, 3].tolist(),
        "extras": intrinsics,
    }


def _xyzw(rotation: np.ndarray) -> list[float]:
    """Return a rotation matrix (3, 3) as glTF's quaternion."""
    w, x, y, z = quaternions(rotation).tolist()
    return [x, y, z, w]


@np.errstate(over="ignore", invalid="ignore")  # numbers beyond float32 become infinities, and their splats are dropped
def read_glb(path: Path, up: Direction = COLMAP_UP) -> Splats:
    """Read every Gaussian splat of a GLB's scene.

    Transforms of nodes are applied, to colors too; several sets of splats become one. Quantised attributes are read;
    scales with negative numbers are read as logarithms, as drafts of the extension had them. Attributes `_NAME` of one
    number become extras in lower case; everything else in the scene is ignored. Splats with a NaN or an infinity are
    dropped with a warning.

    Args:
        path: The file.
        up: Direction (3,) that shall be up in the splats' world; with the one given to `write_glb` the splats are those
            that were written. Splats with a placement have z up whatever is given.

    Returns:
        The splats.

    Raises:
        InputError: If the file is missing, not a GLB, without Gaussian splats, compressed, damaged or cut off.
    """
    to_y_up = rotation_to_y_up(up)
    from_y_up = np.eye(4)
    try:
        document, binary = _chunks(path)
        placement, origin = place_from_json(document.get("asset", {}).get("extras"))
        from_y_up[:3, :3] = (rotation_to_y_up(Z_UP) if placement else to_y_up).T
        parts = []
        size = 0
        for world, primitive in _splat_primitives(document):
            size += _attribute_bytes(document, primitive)
            if size > MAX_COPIES * len(binary):
                raise ValueError("more splats than the file can hold")
            part = replace(_splats(path, document, binary, primitive), origin=origin)
            matrix = from_y_up @ world
            parts.append(part if np.allclose(matrix, np.eye(4), rtol=0, atol=1e-9) else transformed(part, matrix))
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(f"{path} is damaged, its glTF structure does not hold together; write it again.") from error
    if not parts:
        raise InputError(f"{path} holds no Gaussian splats ({EXTENSION}).")
    splats = concatenate(parts)
    return replace(splats, placement=placement, development=_development(document))


def _development(document: dict[str, Any]) -> SplatDevelopment | None:
    """Return the development that the asset's extras name, None for those of other programs."""
    try:
        return SplatDevelopment.from_json(document["asset"]["extras"]["development"])
    except (KeyError, TypeError, AttributeError, InputError):
        return None


def _attributes(path: Path, splats: Splats) -> Iterator[tuple[str, tuple[np.ndarray, int, str]]]:
    """Yield name, and array, componentType and type, of every attribute; each array is a multiple of 4 bytes."""
    yield "POSITION", (splats.positions, FLOAT, "VEC3")
    color = (C0 * splats.sh[:, 0] + 0.5).clip(0, 1)
    linear = srgb_to_linear(color)
    fallback = np.nan_to_num(np.concatenate([linear, splats.opacities.clip(0, 1)[:, None]], axis=1))
    yield "COLOR_0", ((fallback * 65535 + 0.5).astype("<u2"), UNSIGNED_SHORT, "VEC4")
    yield f"{EXTENSION}:ROTATION", (np.roll(splats.rotations, -1, axis=1), FLOAT, "VEC4")
    yield f"{EXTENSION}:SCALE", (splats.scales, FLOAT, "VEC3")
    yield f"{EXTENSION}:OPACITY", (splats.opacities, FLOAT, "SCALAR")
    for index, name in enumerate(_harmonics(splats.degree)):
        yield name, (splats.sh[:, index], FLOAT, "VEC3")
    if len({name.upper() for name in splats.extras}) != len(splats.extras):
        raise InputError(f"Cannot write {path}: two properties differ only in case: {', '.join(splats.extras)}.")
    for name, values in splats.extras.items():
        with np.errstate(over="ignore"):
            array, component = np.nan_to_num(values.astype("<f4")), FLOAT  # glTF forbids other numbers
        if values.dtype.kind != "f":
            lowest, highest = int(values.min()), int(values.max())
            if lowest >= -(2**15) and highest < (2**16 if lowest >= 0 else 2**15):
                array, component = values.astype("<i4"), UNSIGNED_SHORT if lowest >= 0 else SHORT
            elif max(-lowest, highest) > 2**24:
                raise InputError(f"Cannot write {path}: a GLB cannot hold the large integers of the property {name}.")
        yield f"_{name.upper()}", (array, component, "SCALAR")


def _harmonics(degree: int) -> list[str]:
    """Return the attribute names of the coefficients, constant term first."""
    return [f"{EXTENSION}:SH_DEGREE_{band}_COEF_{i}" for band in range(degree + 1) for i in range(2 * band + 1)]


def _chunks(path: Path) -> tuple[dict[str, Any], memoryview]:
    """Return the JSON document and the binary chunk of a GLB."""
    data = read_bytes(path)
    if not data:
        raise InputError(f"{path} is empty.")
    if data[:4] != b"glTF":
        raise InputError(f"{path} is not a GLB file (glTF in one file); save it as .glb.")
    head = np.frombuffer(data[:20].ljust(20, b"\0"), "<u4").tolist()
    version, total, json_length, json_kind = head[1:]
    if version != 2:
        raise InputError(f"{path} is glTF version {version}; only version 2 can be read.")
    if total > len(data) or 20 + json_length > len(data):
        raise InputError(f"{path} is cut off; copy or write it again.")
    if json_kind != JSON_CHUNK or json_length > MAX_JSON:
        raise ValueError("the first chunk is not a JSON document of splats")
    document = from_json(data[20 : 20 + json_length])
    start = 20 + json_length
    length, kind = np.frombuffer(data[start : start + 8].ljust(8, b"\0"), "<u4").tolist()
    if kind != BINARY_CHUNK:
        length = 0
    if start + 8 + length > max(len(data), start + 8):
        raise InputError(f"{path} is cut off; copy or write it again.")
    if unknown := set(document.get("extensionsRequired", [])) - READABLE:
        raise InputError(
            f"{path} needs the glTF extension {min(unknown)}; save it uncompressed, with {EXTENSION} alone."
        )
    if any("uri" in buffer for buffer in document.get("buffers", [])):
        raise InputError(f"{path} keeps its data in other files; save it as one GLB.")
    return document, memoryview(data)[start + 8 : start + 8 + length]


def _splat_primitives(document: dict[str, Any]) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    """Yield the world matrix (4, 4) and the primitive of every set of splats in the scene."""
    nodes = document.get("nodes", [])
    if scenes := document.get("scenes"):
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in children]
    pending = [(index, np.eye(4)) for index in reversed(roots)]
    seen: set[int] = set()
    while pending:
        index, parent = pending.pop()
        if index in seen:
            raise ValueError("the nodes are not a tree")
        seen.add(index)
        node = nodes[index]
        world = parent @ _matrix(node)
        pending += [(child, world) for child in reversed(node.get("children", []))]
        primitives = document["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []
        for primitive in primitives:
            if EXTENSION in primitive.get("extensions", {}):
                yield world, primitive


def _attribute_bytes(document: dict[str, Any], primitive: dict[str, Any]) -> int:
    """Return the bytes that the attributes of a primitive take in a file where no two share their bytes."""
    accessors = [document["accessors"][index] for index in primitive["attributes"].values()]
    widths = [
        WIDTHS.get(accessor["type"], 1) * np.dtype(COMPONENTS[accessor["componentType"]]).itemsize
        for accessor in accessors
    ]
    return sum(max(0, int(accessor["count"])) * width for accessor, width in zip(accessors, widths, strict=True))


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Return the node's own transform (4, 4)."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrices(np.array([w, x, y, z])) * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _splats(path: Path, document: dict[str, Any], binary: memoryview, primitive: dict[str, Any]) -> Splats:
    """Return the splats of one primitive, in its node's axes."""
    settings = primitive["extensions"][EXTENSION]
    if inner := settings.get("extensions"):
        raise InputError(
            f"{path} holds compressed splats ({min(inner)}); save them uncompressed, with {EXTENSION} alone."
        )
    if settings.get("colorSpace") == "lin_rec709_display":
        log.warning("%s: its colors are linear light and are read as sRGB: they will look dark", path)
    attributes = primitive["attributes"]

    def values(name: str, width: int) -> np.ndarray:
        array = _accessor(document, binary, attributes[name])
        if array.shape[1] != width:
            raise ValueError(f"{name} has another width")
        return array

    degree = max(band for band in range(4) if f"{EXTENSION}:SH_DEGREE_{band}_COEF_0" in attributes)
    positions = values("POSITION", 3).astype(np.float32)
    sh = np.empty((len(positions), (degree + 1) ** 2, 3), np.float32)
    harmonics = [values(name, 3) for name in _harmonics(degree)]
    for start in range(0, len(sh), BLOCK):
        part = slice(start, start + BLOCK)
        np.stack([array[part] for array in harmonics], axis=1, out=sh[part])
    scales = values(f"{EXTENSION}:SCALE", 3).astype(np.float32)
    if (scales < 0).any():
        scales = np.exp(scales)
    extras = {
        name[1:].lower(): _accessor(document, binary, attribute)[:, 0].copy()
        for name, attribute in attributes.items()
        if name[0] == "_" and document["accessors"][attribute]["type"] == "SCALAR"
    }
    return clean_splats(
        Splats(
            positions,
            np.roll(values(f"{EXTENSION}:ROTATION", 4), 1, axis=1).astype(np.float32),
            scales,
            values(f"{EXTENSION}:OPACITY", 1)[:, 0].astype(np.float32).clip(0, 1),
            sh,
            extras,
        ),
        path,
    )


def _accessor(document: dict[str, Any], binary: memoryview, index: int) -> np.ndarray:
    """Return an accessor's values (count, width); floats are a view of `binary`, integers become int32 or float32."""
    accessor = document["accessors"][index]
    if "sparse" in accessor:
        raise ValueError("sparse accessors hold no splats")
    view = document["bufferViews"][accessor["bufferView"]]
    kind = np.dtype(COMPONENTS[accessor["componentType"]])
    width = WIDTHS[accessor["type"]]
    stride = view.get("byteStride", 0) or width * kind.itemsize
    if stride < width * kind.itemsize:
        raise ValueError("elements that overlap")
    # numpy raises ValueError for counts and offsets outside the bytes.
    array: np.ndarray = np.ndarray(
        (accessor["count"], width),
        kind,
        binary,
        view.get("byteOffset", 0) + accessor.get("byteOffset", 0),
        (stride, kind.itemsize),
    )
    if kind.kind == "f":
        return array
    if accessor.get("normalized"):
        return np.maximum(array / np.float32(np.iinfo(kind).max), -1)
    return array.astype(np.int32)


FORMAT = ExportFormat(
    name="glb",
    suffix=".glb",
    title="glTF (GLB)",
    description="glTF with KHR_gaussian_splatting, for web viewers and Cesium.",
    options=frozenset({"cameras", "extras"}),
    write=write_glb,
    size=glb_size,
    read=read_glb,
)
