"""Cameras for other programs: a COLMAP text model and nerfstudio's transforms.json. numpy only, Blender imports it.

COLMAP: https://colmap.github.io/format.html (poses from world to camera, wxyz, y down). transforms.json:
https://docs.nerf.studio/quickstart/data_conventions.html (poses from camera to world, y up, looking against z).
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

# COLMAP's models and their parameters in nerfstudio's words; its missing ones are zero.
PERSPECTIVE = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
}
FISHEYE = {
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
}


@dataclass(frozen=True, eq=False)
class Photograph:
    """A picture that others can load and the lens that took it: COLMAP's model name, size in pixels, parameters."""

    camera: Camera
    """The pinhole that its undistorted copy has; the pose counts here."""
    model: str
    width: int
    height: int
    params: tuple[float, ...]
    path: str

    @classmethod
    def through_pinhole(cls, camera: Camera) -> "Photograph":
        """A picture without distortion, named as the camera is."""
        params = (camera.fx, camera.fy, camera.cx, camera.cy)
        return cls(camera, "PINHOLE", camera.width, camera.height, params, f"images/{camera.name}")


def moved(camera: Camera, matrix: np.ndarray) -> Camera:
    """The camera in a world that the similarity `matrix` (4, 4) has turned, scaled and shifted."""
    pose: np.ndarray = matrix @ np.linalg.inv(camera.world_to_camera)
    pose[:3, :3] /= float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return replace(camera, world_to_camera=np.linalg.inv(pose))


def write_cameras(
    folder: Path, photographs: Sequence[Photograph], points: np.ndarray, colors: np.ndarray
) -> tuple[list[Path], list[str]]:
    """Write sparse/0/{cameras,images,points3D}.txt and transforms.json to `folder`; the files, and sentences to show.

    points (P, 3) in the cameras' world, colors (P, 3) uint8; both may be empty. What a format cannot hold is said:
    transforms.json has no words for some lenses and is left out then, COLMAP's text cuts names at spaces.
    Raises InputError when a name cannot be written in a line.
    """
    for photograph in photographs:
        if not photograph.camera.name or any(ord(letter) < 32 for letter in photograph.camera.name):
            raise InputError(f"The camera name {photograph.camera.name!r} cannot be written to a file; rename it.")
    model = folder / "sparse" / "0"
    files = {
        model / "cameras.txt": _cameras_text(photographs),
        model / "images.txt": _images_text(photographs),
        model / "points3D.txt": _points_text(points, colors),
    }
    odd = sorted({p.model for p in photographs} - set(PERSPECTIVE) - set(FISHEYE))
    if not odd:
        frames = {"frames": [_frame(photograph) for photograph in photographs]}
        files[folder / "transforms.json"] = to_json(frames, indent=2) + "\n"
    for path, text in files.items():
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
    notes = [f"transforms.json was left out: it cannot describe the lens {odd[0]}."] if odd else []
    spaced = [photograph.camera.name for photograph in photographs if " " in photograph.camera.name]
    if spaced:
        notes.append(f"COLMAP reads the name {spaced[0]} only as far as its first space; rename the photograph.")
    return list(files), notes


def _lens(photograph: Photograph) -> tuple:
    return photograph.model, photograph.width, photograph.height, photograph.params


def _cameras_text(photographs: Sequence[Photograph]) -> str:
    """One camera for each different lens."""
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, (model, width, height, params) in enumerate(dict.fromkeys(map(_lens, photographs)), 1):
        lines.append(f"{number} {model} {width} {height} {_numbers(params)}")
    return "\n".join(lines) + "\n"


def _images_text(photographs: Sequence[Photograph]) -> str:
    numbers = {lens: number for number, lens in enumerate(dict.fromkeys(map(_lens, photographs)), 1)}
    lines = ["# Image list with two lines of data per image:"]
    lines.append("#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME")
    lines.append("#   POINTS2D[] as (X, Y, POINT3D_ID)")
    for number, photograph in enumerate(photographs, 1):
        pose = photograph.camera.world_to_camera
        values = _numbers([*quaternions(pose[:3, :3]), *pose[:3, 3]])
        lines += [f"{number} {values} {numbers[_lens(photograph)]} {photograph.camera.name}", ""]
    return "\n".join(lines) + "\n"


def _points_text(points: np.ndarray, colors: np.ndarray) -> str:
    """Points without tracks, error 0."""
    lines = ["# 3D point list with one line of data per point:"]
    lines.append("#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)")
    for number, (point, color) in enumerate(zip(points.tolist(), colors.tolist(), strict=True), 1):
        lines.append(f"{number} {_numbers(point)} {color[0]} {color[1]} {color[2]} 0")
    return "\n".join(lines) + "\n"


def _frame(photograph: Photograph) -> dict[str, Any]:
    """One frame of transforms.json, with its own lens."""
    fisheye = photograph.model in FISHEYE
    names = (FISHEYE if fisheye else PERSPECTIVE)[photograph.model]
    lens = dict(zip(names, photograph.params, strict=True))
    if "f" in lens:
        lens["fl_x"] = lens["fl_y"] = lens.pop("f")
    for name in ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2"):
        lens.setdefault(name, 0.0)
    pose = np.linalg.inv(photograph.camera.world_to_camera) @ CAMERA_AXES
    return {
        "file_path": photograph.path,
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "w": photograph.width,
        "h": photograph.height,
        **lens,
        "transform_matrix": pose.tolist(),
    }


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
