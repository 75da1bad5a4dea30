"""nerfstudio and instant-ngp: transforms.json.

Source: nerfstudio's page "Data conventions" and instant-ngp's docs/nerf_dataset_tips.md. `transform_matrix` is from the
camera (x right, y up, looking along -z) to the world; parameters are in pixels and stand in the frame or beside frames.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..base.text import first_names
from ..scene.lenses import Lens
from .camera_file import OPENGL_AXES, Calibration, CameraFile, FileCamera, brown_lens, reading, rigid, sized_calibration
from .source import Source

PROGRAM = "nerfstudio or instant-ngp"
_PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")


def recognise(source: Source) -> bool:
    """Return whether the file has a list of frames with matrices."""
    document = source.json
    frames = document.get("frames") if isinstance(document, dict) else None
    return isinstance(frames, list) and any(isinstance(frame, dict) and "transform_matrix" in frame for frame in frames)


def read(source: Source) -> CameraFile:
    """Read the frames.

    Raises:
        ValueError: For what is no camera.
    """
    document = source.json
    shared: dict[tuple[Any, ...], Calibration] = {}
    cameras = []
    absent: list[str] = []
    for number, frame in enumerate(document["frames"], 1):
        name = str(frame.get("file_path") or "").replace("\\", "/")
        if not name:
            raise ValueError(f"frame {number} has no file_path")
        with reading(f"frame {number} ({name})"):
            calibration = _calibration(document | frame, shared)
            matrix = np.array(frame["transform_matrix"], np.float64)
            if matrix.shape not in ((3, 4), (4, 4)):
                raise ValueError("transform_matrix is not 4 x 4")
            axes = matrix[:3, :3]
            axes = axes / np.cbrt(abs(np.linalg.det(axes)) or 1.0)  # Blender's cameras may be scaled objects
            to_world = rigid(axes @ OPENGL_AXES, matrix[:3, 3])
        files = [_beside(source, frame.get(key), absent) for key in ("mask_path", "depth_file_path")]
        cameras.append(FileCamera(name, calibration, np.linalg.inv(to_world), *files))
    points_file = _beside(source, document.get("ply_file_path"), [])
    warnings = [f"{len(absent)} masks and depth images do not exist: {first_names(absent)}."] if absent else []
    return CameraFile(PROGRAM, tuple(cameras), points_file=points_file, warnings=warnings)


def _beside(source: Source, name: object, absent: list[str]) -> Path | None:
    """Return a file that the file names; add its name to `absent` where it does not exist."""
    if not isinstance(name, str) or not name:
        return None
    path = source.path.parent / name.replace("\\", "/")
    if path.is_file():
        return path
    absent.append(name)
    return None


def _calibration(values: dict[str, Any], shared: dict[tuple[Any, ...], Calibration]) -> Calibration:
    """Make the calibration of a frame, or return that of an earlier frame with the same values."""
    model = str(values.get("camera_model") or "").upper()
    fisheye = model in _FISHEYE or bool(values.get("is_fisheye"))
    if model and model not in (*_PERSPECTIVE, *_FISHEYE):
        raise ValueError(f"the camera model {model} cannot be used, only {', '.join((*_PERSPECTIVE, *_FISHEYE))}")
    names = (
        "w",
        "h",
        "fl_x",
        "fl_y",
        "cx",
        "cy",
        "camera_angle_x",
        "camera_angle_y",
        "k1",
        "k2",
        "k3",
        "k4",
        "p1",
        "p2",
    )
    given = {name: float(values[name]) for name in names if values.get(name) is not None}
    if not all(map(math.isfinite, given.values())):
        raise ValueError("a number is not finite")
    key = (fisheye, *sorted(given.items()))
    if key in shared:
        return shared[key]

    def lens(width: int, height: int) -> Lens:
        fx = given.get("fl_x")
        if fx is None and "camera_angle_x" in given:
            fx = width / 2 / math.tan(given["camera_angle_x"] / 2)
        fy = given.get("fl_y")
        if fy is None and "camera_angle_y" in given:
            fy = height / 2 / math.tan(given["camera_angle_y"] / 2)
        fx, fy = fy if fx is None else fx, fx if fy is None else fy
        if fx is None or fy is None:
            raise ValueError("there is neither fl_x nor camera_angle_x")
        point = given.get("cx", width / 2), given.get("cy", height / 2)
        radial = [given.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")]
        if fisheye:
            return Lens("OPENCV_FISHEYE", width, height, (fx, fy, *point, *radial))
        return brown_lens((width, height), (fx, fy), point, radial, (given.get("p1", 0.0), given.get("p2", 0.0)))

    if "w" in given and "h" in given:
        shared[key] = sized_calibration(lens(int(given["w"]), int(given["h"])))
    else:
        lens(1000, 1000)  # so that a missing focal length is reported here
        shared[key] = Calibration(lens)
    return shared[key]
