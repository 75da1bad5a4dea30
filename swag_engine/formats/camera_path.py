"""Camera paths of films, as transforms.json of nerfstudio. numpy only, Blender imports it.

Each frame has the intrinsics w, h, fl_x, fl_y, cx, cy in pixels (those of the whole file where it has none of its own),
`transform_matrix` from the camera to the world (y up, looking along -z), `file_path`, whose name is that of the frame,
and optionally `water` and `haze`, the amounts of water and of haze in open water from 0 to 1. Lens distortion is left
out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import DAMAGE, InputError
from ..scene.cameras import Camera
from ..scene.georeference import Origin
from .cameras import transform_camera
from .gltf import CAMERA_AXES
from .run_folder import read_json, write_json

INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
AMOUNTS = ("water", "haze")
"""Amounts from 0 to 1 that a frame may have."""
LARGEST_SIDE = 16384
"""Pixels of the longer side of an image: more is taken for a mistake."""
RIGID_TOLERANCE = 1e-3
"""How far the rotation of a pose may be from an orthogonal matrix, for files with few decimals."""


@dataclass(frozen=True, eq=False)
class PathFrame:
    """One frame of a camera path.

    Attributes:
        camera: The camera; its name is that of the frame.
        water: Amount of water, 0..1; None for that of the film.
        haze: Fraction of the haze in open water that is shown, 0..1; None for that of the film.
    """

    camera: Camera
    water: float | None = None
    haze: float | None = None


def write_camera_path(path: Path, frames: Sequence[PathFrame]) -> None:
    """Write a camera path.

    Raises:
        InputError: If the file cannot be written.
    """
    entries = []
    for frame in frames:
        camera = frame.camera
        entry: dict[str, Any] = {"file_path": camera.name}
        entry |= zip(INTRINSICS, (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy), strict=True)
        entry["transform_matrix"] = (np.linalg.inv(camera.world_to_camera) @ CAMERA_AXES).tolist()
        entry |= {name: value for name in AMOUNTS if (value := getattr(frame, name)) is not None}
        entries.append(entry)
    write_json(path, {"camera_model": "PINHOLE", "frames": entries})


def read_camera_path(path: Path) -> list[PathFrame]:
    """Read a camera path.

    Returns:
        The frames, at least one, with different names.

    Raises:
        InputError: If the file cannot be read or is no camera path; the message names the frame.
    """
    document = read_json(path, f"There is no camera path {path}.")
    entries = document.get("frames")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} is no camera path: it has no list of frames; docs/formats.md describes it.")
    frames: list[PathFrame] = []
    names: set[str] = set()
    for number, entry in enumerate(entries, 1):
        try:
            frame = _read_frame(document | entry, number)
        except DAMAGE as error:
            what = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
            raise InputError(f"Frame {number} of {path} cannot be read: {what}.") from error
        # Names are compared as Windows and macOS do: the files must not replace one another.
        if frame.camera.name.lower() in names:
            raise InputError(f"{path} has two frames called {frame.camera.name}; change the file_path of one.")
        names.add(frame.camera.name.lower())
        frames.append(frame)
    return frames


def frames_near(frames: Sequence[PathFrame], origin: Origin) -> list[PathFrame]:
    """Return frames for coordinates from which an origin (3,) was subtracted.

    Paths that Blender writes are so already and stay as they are; other programs write coordinates of the COLMAP model.
    """
    middle = np.median([frame.camera.centre for frame in frames], axis=0)
    if np.linalg.norm(middle) <= np.linalg.norm(middle - origin):
        return list(frames)
    moved = np.eye(4)
    moved[:3, 3] = -np.asarray(origin)
    return [replace(frame, camera=transform_camera(frame.camera, moved)) for frame in frames]


def _read_frame(entry: dict[str, Any], number: int) -> PathFrame:
    """Read one frame. Raises KeyError for what is missing, TypeError or ValueError for what is wrong."""
    width, height = int(entry["w"]), int(entry["h"])
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
        raise ValueError(f"an image of {width} x {height} pixels is not possible, at most {LARGEST_SIDE} a side")
    fx, fy = float(entry["fl_x"]), float(entry.get("fl_y", entry["fl_x"]))
    cx, cy = float(entry.get("cx", width / 2)), float(entry.get("cy", height / 2))
    if not all(map(math.isfinite, (fx, fy, cx, cy))) or fx <= 0 or fy <= 0:
        raise ValueError("its focal length must be more than 0 pixels")
    pose = np.array(entry["transform_matrix"], np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("its transform_matrix is not 4 x 4 numbers")
    rotation = pose[:3, :3]
    is_rigid = np.abs(rotation.T @ rotation - np.eye(3)).max() < RIGID_TOLERANCE and np.linalg.det(rotation) > 0
    if not is_rigid or np.abs(pose[3] - (0, 0, 0, 1)).max() > RIGID_TOLERANCE:
        raise ValueError("its transform_matrix is not a rotation and a translation")
    amounts = {name: float(entry[name]) for name in AMOUNTS if entry.get(name) is not None}
    for amount_name, amount in amounts.items():
        if not 0 <= amount <= 1:
            raise ValueError(f"its {amount_name} must be from 0 to 1, not {amount}")
    name = Path(str(entry.get("file_path") or f"{number:04d}")).stem
    if not name.strip("."):
        raise ValueError(f"its file_path {entry['file_path']!r} has no name")
    camera = Camera(name, width, height, fx, fy, cx, cy, np.linalg.inv(pose @ CAMERA_AXES))
    return PathFrame(camera, **amounts)
