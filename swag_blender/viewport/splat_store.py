"""Textures of a scene's splats on the graphics card: uploaded when they change, and only what changed."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import bpy
import gpu
import numpy as np

from ...swag_engine.splats.haze import HAZE
from ...swag_engine.splats.splats import Splats
from ..nodes.splat_colors import HIDDEN, TINT
from ..splats import changes_of, has_other_modifiers, pointcloud_of, shown_pointcloud, splats_of
from .depth_order import Part
from .packing import (
    GEOMETRY_TEXELS,
    HARMONICS_TEXELS,
    contributions,
    fitting_degree,
    geometry_texels,
    harmonics_texels,
    most_splats,
    state_texels,
    texture_rows,
)

LARGEST_SIDE = 16384
"""Largest side of a texture that is used, texels; a device may allow less."""


@dataclass
class _Held:
    """What is known of an object's splats that are on the card.

    Attributes:
        data: Session number of its point cloud, and of how many changes of it by the extension are known.
        checksums: Of geometry, colors and state.
        part: Its splats for the order; None where nothing of it is on the card.
    """

    data: tuple[int, int]
    checksums: tuple[int, int, int]
    part: Part | None = None


class SplatStore:
    """The splats of several objects in one set of textures, so that they can be blended in one order.

    Attributes:
        geometry: Positions, opacities, covariances.
        harmonics: Colors.
        states: Tints, and which splats are not drawn.
        degree: Degree of spherical harmonics that the textures hold.
        notice: A sentence for the user where the device cannot hold everything; "" otherwise.
        version: Changes with any of the textures.
        splats_version: Changes when the splats get other numbers in the textures, so that orders are out of date.
        uploaded: Bytes sent to the card so far.
    """

    def __init__(self) -> None:
        self.width = min(LARGEST_SIDE, gpu.capabilities.max_texture_size_get())
        self.geometry: gpu.types.GPUTexture | None = None
        self.harmonics: gpu.types.GPUTexture | None = None
        self.states: gpu.types.GPUTexture | None = None
        self.degree, self.notice, self.version, self.uploaded = 0, "", 0, 0
        self.splats_version = 0
        self._held: dict[int, _Held] = {}
        self._stale: set[int] = set()
        self._all_stale = False

    def mark_stale(self, number: int | None) -> None:
        """Have the object or point cloud with this session number looked at again; None for all of them."""
        if number is None:
            self._all_stale = True
        else:
            self._stale.add(number)

    def part(self, obj: bpy.types.Object) -> Part | None:
        """The splats of an object for the order; None where it has none on the card."""
        held = self._held.get(obj.session_uid)
        return held.part if held else None

    def update(self, objects: Sequence[bpy.types.Object], depsgraph: bpy.types.Depsgraph) -> None:
        """Bring the textures up to date with the splats of these objects."""
        same_objects = [obj.session_uid for obj in objects] == list(self._held)
        changed = [obj for obj in objects if not same_objects or self._is_stale(obj)]
        self._stale.clear()
        self._all_stale = False
        if same_objects and not changed:
            return
        for obj in changed if same_objects else ():
            self._held[obj.session_uid].data = _identity(pointcloud_of(obj))
        read = {obj.session_uid: _read(obj, depsgraph) for obj in changed}
        if same_objects and all(
            self._held[number].checksums[:2] == found.checksums[:2] for number, found in read.items()
        ):
            if any(self._held[number].checksums != found.checksums for number, found in read.items()):
                for number, found in read.items():
                    self._held[number].checksums = found.checksums
                self._upload_states([read.get(obj.session_uid) or _read(obj, depsgraph) for obj in objects])
            return
        self._upload_all({obj.session_uid: read.get(obj.session_uid) or _read(obj, depsgraph) for obj in objects})

    def _is_stale(self, obj: bpy.types.Object) -> bool:
        data: Any = obj.data
        held = self._held[obj.session_uid]
        return (
            self._all_stale
            # Blender does not tell of every change that a script makes between two frames.
            or held.data != _identity(data)
            or data.session_uid in self._stale
            or (obj.session_uid in self._stale and has_other_modifiers(obj))
        )

    def _upload_all(self, read: "dict[int, _Read]") -> None:
        total = sum(len(found.splats) for found in read.values())
        most = most_splats(self.width, self.width)
        for found in read.values():
            if total > most:
                found.keep_largest(int(len(found.splats) * most / total))
        count = sum(len(found.splats) for found in read.values())
        wanted = max((found.splats.degree for found in read.values()), default=0)
        self.degree = fitting_degree(count, wanted, self.width, self.width)
        self.notice = ""
        if count < total:
            self.notice = f"This graphics card shows {count} of {total} splats, those of the largest contribution."
        elif self.degree < wanted:
            self.notice = f"This graphics card shows these splats with SH degree {self.degree} of {wanted}."
        geometry, harmonics = [], []
        first, held = 0, {}
        for number, found in read.items():
            geometry.append(geometry_texels(found.splats))
            harmonics.append(harmonics_texels(found.splats.sh, self.degree))
            part = Part(found.splats.positions, contributions(found.splats), first)
            held[number] = _Held(found.data, found.checksums, part)
            first += len(found.splats)
        self._held = held
        self.geometry = self._texture(geometry, GEOMETRY_TEXELS, "RGBA32F")
        self.harmonics = self._texture(harmonics, HARMONICS_TEXELS[self.degree], "RGBA16F")
        self._upload_states(list(read.values()))
        self.splats_version += 1

    def _upload_states(self, read: "Sequence[_Read]") -> None:
        self.states = self._texture([found.states for found in read], 1, "RGBA8")
        self.version += 1

    def _texture(self, parts: Sequence[np.ndarray], texels: int, kind: str) -> gpu.types.GPUTexture:
        count = sum(len(part) for part in parts)
        rows = texture_rows(count, texels, self.width)
        values = np.zeros((rows * self.width, 4), np.float32)
        at = 0
        for part in parts:
            flat = part.reshape(-1, 4)
            values[at : at + len(flat)] = flat
            at += len(flat)
        self.uploaded += values.nbytes
        return new_texture(values, (self.width, rows), kind)

    def order_texture(self, order: np.ndarray) -> gpu.types.GPUTexture:
        """An order (M, 2) of splats as a texture."""
        rows = texture_rows(len(order), 1, self.width)
        values = np.zeros((rows * self.width, 2), np.float32)
        values[: len(order)] = order
        self.uploaded += values.nbytes
        return new_texture(values, (self.width, rows), "RG32F")


def new_texture(values: np.ndarray, size: tuple[int, int], kind: str) -> gpu.types.GPUTexture:
    """A texture with these float32 values; its format `kind` may hold them in fewer bits."""
    return gpu.types.GPUTexture(size, format=cast(Any, kind), data=float_buffer(values))


def float_buffer(values: np.ndarray) -> gpu.types.Buffer:
    """The values as float32 in Blender's own type of array."""
    flat: Any = np.ascontiguousarray(values, np.float32).ravel()  # the stubs know no numpy arrays
    return gpu.types.Buffer("FLOAT", flat.size, flat)


@dataclass
class _Read:
    """The splats of an object as they are now."""

    data: tuple[int, int]
    splats: Splats
    states: np.ndarray
    checksums: tuple[int, int, int]

    def keep_largest(self, count: int) -> None:
        kept = np.sort(np.argsort(-contributions(self.splats))[:count])
        mask = np.zeros(len(self.splats), bool)
        mask[kept] = True
        self.splats, self.states = self.splats.subset(mask), self.states[mask]


def _read(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> _Read:
    pointcloud = shown_pointcloud(obj, depsgraph)
    found = splats_of(pointcloud)
    hidden = _attribute(pointcloud, HIDDEN, 1)
    states = state_texels(
        None if hidden is None else hidden[:, 0].astype(bool), _attribute(pointcloud, TINT, 4), len(found)
    )
    geometry = 0
    arrays = [found.positions, found.rotations, found.scales, found.opacities]
    for array in arrays + ([found.extras[HAZE]] if HAZE in found.extras else []):
        geometry = zlib.crc32(array.tobytes(), geometry)
    checksums = (geometry, zlib.crc32(found.sh.tobytes()), zlib.crc32(states.tobytes()))
    return _Read(_identity(pointcloud_of(obj)), found, states, checksums)


def _identity(pointcloud: bpy.types.PointCloud) -> tuple[int, int]:
    """Session number of a point cloud, and the number of changes of it by the extension."""
    return cast(Any, pointcloud).session_uid, changes_of(pointcloud)


def _attribute(pointcloud: bpy.types.PointCloud, name: str, width: int) -> np.ndarray | None:
    found: Any = pointcloud.attributes.get(name)
    if found is None:
        return None
    values = np.empty(len(found.data) * width, bool if found.data_type == "BOOLEAN" else np.float32)
    found.data.foreach_get("color" if width == 4 else "value", values)
    return values.reshape(-1, width)
