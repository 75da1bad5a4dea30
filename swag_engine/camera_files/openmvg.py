"""OpenMVG: sfm_data.json.

Source: OpenMVG's documentation of SfM_Data and its camera models. Poses are a rotation from the world to the camera and
the projection centre; parameters and observations are in pixels.
"""

from typing import Any

import numpy as np

from ..scene.lenses import Lens
from .camera_file import (
    Calibration,
    CameraFile,
    FileCamera,
    FilePoints,
    brown_lens,
    photos_are,
    pose_from_centre,
    reading,
    sized_calibration,
)
from .source import Source

PROGRAM = "OpenMVG"
_FIRST = 1 << 31
"""Bit of `polymorphic_id` that marks the first entry of a type, the one that names it."""


def recognise(source: Source) -> bool:
    """Return whether the file has OpenMVG's lists."""
    return isinstance(source.json, dict) and {"views", "intrinsics", "extrinsics"} <= set(source.json)


def read(source: Source) -> CameraFile:
    """Read the views with a pose, and the points.

    Raises:
        ValueError: For a lens that cannot be used.
    """
    document = source.json
    lenses = _lenses(document["intrinsics"])
    poses = {entry["key"]: entry["value"] for entry in document["extrinsics"]}
    cameras: list[FileCamera] = []
    index: dict[int, int] = {}
    for entry in document["views"]:
        data = entry["value"]["ptr_wrapper"]["data"]
        pose, lens = poses.get(data["id_pose"]), lenses.get(data["id_intrinsic"])
        if pose is None or lens is None:
            continue
        name = "/".join(part for part in (data.get("local_path", ""), data["filename"]) if part).replace("\\", "/")
        index[entry["key"]] = len(cameras)
        with reading(name):
            cameras.append(FileCamera(name, lens, pose_from_centre(pose["rotation"], pose["center"])))
    warnings = []
    if len(cameras) < len(document["views"]):
        count = len(document["views"]) - len(cameras)
        warnings.append(f"{photos_are(count)} left out, without a pose in {source.path.name}.")
    points = _points(document.get("structure") or [], index, cameras)
    return CameraFile(PROGRAM, tuple(cameras), points, warnings=warnings)


def _lenses(intrinsics: list[dict[str, Any]]) -> dict[int, Calibration]:
    names: dict[int, str] = {}
    found = {}
    for entry in intrinsics:
        value = entry["value"]
        type_id = int(value.get("polymorphic_id", 0)) & ~_FIRST
        names.setdefault(type_id, value.get("polymorphic_name", ""))
        found[entry["key"]] = sized_calibration(_lens(names[type_id], value["ptr_wrapper"]["data"]))
    return found


def _lens(model: str, data: dict[str, Any]) -> Lens:
    size = int(data["width"]), int(data["height"])
    if model == "spherical":
        raise ValueError("its photos are spherical panoramas, which cannot be used")
    focal, point = float(data["focal_length"]), [float(value) for value in data["principal_point"]]
    if model == "fisheye":
        return Lens("OPENCV_FISHEYE", *size, (focal, focal, *point, *map(float, data["fisheye"])))
    distortion: list[float] | None = {
        "pinhole": [],
        "pinhole_radial_k1": data.get("disto_k1"),
        "pinhole_radial_k3": data.get("disto_k3"),
        "pinhole_brown_t2": data.get("disto_t2"),
    }.get(model)
    if distortion is None:
        raise ValueError(f"the camera model {model or 'without a name'} cannot be used")
    return brown_lens(size, (focal, focal), point, distortion[:3], distortion[3:])


def _points(structure: list[dict[str, Any]], index: dict[int, int], cameras: list[FileCamera]) -> FilePoints | None:
    if not structure:
        return None
    positions, observations = [], []
    for entry in structure:
        positions.append(entry["value"]["X"])
        seen = []
        for observation in entry["value"]["observations"]:
            if (camera := index.get(observation["key"])) is not None:
                width, height = cameras[camera].calibration.size or (0, 0)
                x, y = observation["value"]["x"]
                seen.append((camera, x - width / 2, y - height / 2))
        observations.append(seen)
    return FilePoints(np.array(positions, np.float64), np.zeros((0, 3), np.uint8), observations)
