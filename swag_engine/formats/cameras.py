"""Cameras for other programs: a COLMAP text model and nerfstudio's transforms.json. numpy only, Blender imports it.

COLMAP: https://colmap.github.io/format.html (poses from world to camera, quaternions wxyz, y down). transforms.json:
https://docs.nerf.studio/quickstart/data_conventions.html (poses from camera to world, y up, looking along -z).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path
from ..base.strict_json import to_json
from ..scene.cameras import Camera
from ..splats.transform import quaternions
from .gltf import CAMERA_AXES

PERSPECTIVE = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
}
"""COLMAP's perspective lens models, and nerfstudio's names of their parameters; those that a model lacks are zero."""
FISHEYE = {
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
}
"""The same for COLMAP's fisheye models."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image file with its pose and the lens that took it.

    Attributes:
        camera: Pinhole camera of the undistorted image; only its name and pose are written.
        model: COLMAP's name of the lens model.
        width: Width of the image file, pixels.
        height: Its height, pixels.
        params: Parameters of the lens, in COLMAP's order.
        path: Path of the image file as transforms.json names it.
    """

    camera: Camera
    model: str
    width: int
    height: int
    params: tuple[float, ...]
    path: str

    @classmethod
    def from_camera(cls, camera: Camera) -> "PosedImage":
        """Describe an image without distortion, images/NAME, that a pinhole camera took."""
        params = (camera.fx, camera.fy, camera.cx, camera.cy)
        return cls(camera, "PINHOLE", camera.width, camera.height, params, f"images/{camera.name}")


def transform_camera(camera: Camera, matrix: np.ndarray) -> Camera:
    """Transform a camera together with its world.

    Args:
        camera: The camera.
        matrix: (4, 4) similarity (rotation, one scale, translation), from the old to the new world.

    Returns:
        The camera in the new world; its pixels show the same.
    """
    pose: np.ndarray = matrix @ np.linalg.inv(camera.world_to_camera)
    pose[:3, :3] /= float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return replace(camera, world_to_camera=np.linalg.inv(pose))


def write_cameras(
    folder: Path, images: Sequence[PosedImage], points: np.ndarray, colors: np.ndarray
) -> tuple[list[Path], list[str]]:
    """Write sparse/0/cameras.txt, images.txt and points3D.txt, and transforms.json, to a folder.

    transforms.json is not written where it cannot describe a lens.

    Args:
        folder: Folder of the files; made where it does not exist.
        images: Images with poses and lenses.
        points: (P, 3) sparse points in the cameras' world; may be empty.
        colors: (P, 3) uint8 sRGB of the points.

    Returns:
        The files written, and sentences for the user about what the formats cannot hold.

    Raises:
        InputError: If the name of an image is empty or has control characters, or a file cannot be written.
    """
    for image in images:
        if not image.camera.name or any(ord(letter) < 32 for letter in image.camera.name):
            raise InputError(f"The camera name {image.camera.name!r} cannot be written to a file; rename it.")
    model = folder / "sparse" / "0"
    files = {
        model / "cameras.txt": _cameras_text(images),
        model / "images.txt": _images_text(images),
        model / "points3D.txt": _points_text(points, colors),
    }
    unsupported = sorted({image.model for image in images} - set(PERSPECTIVE) - set(FISHEYE))
    if not unsupported:
        frames = {"frames": [_frame(image) for image in images]}
        files[folder / "transforms.json"] = to_json(frames, indent=2) + "\n"
    for path, text in files.items():
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
    notes = []
    if unsupported:
        notes.append(f"transforms.json was not written: it cannot describe the lens model {unsupported[0]}.")
    spaced = [image.camera.name for image in images if " " in image.camera.name]
    if spaced:
        notes.append(f"COLMAP reads the name {spaced[0]} only up to its first space; rename the image.")
    return list(files), notes


def _lens(image: PosedImage) -> tuple:
    return image.model, image.width, image.height, image.params


def _cameras_text(images: Sequence[PosedImage]) -> str:
    """Return cameras.txt, with one camera for each different lens."""
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, (model, width, height, params) in enumerate(dict.fromkeys(map(_lens, images)), 1):
        lines.append(f"{number} {model} {width} {height} {_numbers(params)}")
    return "\n".join(lines) + "\n"


def _images_text(images: Sequence[PosedImage]) -> str:
    numbers = {lens: number for number, lens in enumerate(dict.fromkeys(map(_lens, images)), 1)}
    lines = ["# Image list with two lines of data per image:"]
    lines.append("#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME")
    lines.append("#   POINTS2D[] as (X, Y, POINT3D_ID)")
    for number, image in enumerate(images, 1):
        pose = image.camera.world_to_camera
        values = _numbers([*quaternions(pose[:3, :3]), *pose[:3, 3]])
        lines += [f"{number} {values} {numbers[_lens(image)]} {image.camera.name}", ""]
    return "\n".join(lines) + "\n"


def _points_text(points: np.ndarray, colors: np.ndarray) -> str:
    """Return points3D.txt, the points without tracks and with error 0."""
    lines = ["# 3D point list with one line of data per point:"]
    lines.append("#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)")
    for number, (point, color) in enumerate(zip(points.tolist(), colors.tolist(), strict=True), 1):
        lines.append(f"{number} {_numbers(point)} {color[0]} {color[1]} {color[2]} 0")
    return "\n".join(lines) + "\n"


def _frame(image: PosedImage) -> dict[str, Any]:
    """Return one frame of transforms.json, with its own lens."""
    fisheye = image.model in FISHEYE
    names = (FISHEYE if fisheye else PERSPECTIVE)[image.model]
    lens = dict(zip(names, image.params, strict=True))
    if "f" in lens:
        lens["fl_x"] = lens["fl_y"] = lens.pop("f")
    for name in ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2"):
        lens.setdefault(name, 0.0)
    pose = np.linalg.inv(image.camera.world_to_camera) @ CAMERA_AXES
    return {
        "file_path": image.path,
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "w": image.width,
        "h": image.height,
        **lens,
        "transform_matrix": pose.tolist(),
    }


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
