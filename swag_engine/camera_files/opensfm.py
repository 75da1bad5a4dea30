"""OpenSfM and OpenDroneMap: reconstruction.json.

Source: OpenSfM's documentation, "Coordinate systems" and "Camera models". Lengths in the image are in lengths of its
longer side, from its middle; a shot is an angle-axis rotation and a translation from the world to the camera.
The world is metric, x east, y north, z up, where the photos have GPS: OpenSfM then writes the latitude and longitude.
"""

from typing import Any

import cv2
import numpy as np

from ..scene.georeference import Georeference
from ..scene.lenses import Lens
from .camera_file import (
    Calibration,
    CameraFile,
    FileCamera,
    FilePoints,
    brown_lens,
    reading,
    rigid,
    sized_calibration,
)
from .geocentric import geocentric, georeference_from_geocentric
from .source import Source

PROGRAM = "OpenSfM or OpenDroneMap"


def recognise(source: Source) -> bool:
    """Return whether the file is a list of reconstructions with shots."""
    document = source.json
    return (
        isinstance(document, list)
        and bool(document)
        and all(isinstance(part, dict) and {"cameras", "shots"} <= set(part) for part in document)
    )


def read(source: Source) -> CameraFile:
    """Read the largest reconstruction.

    Raises:
        ValueError: For a lens that cannot be used.
    """
    parts = sorted(source.json, key=lambda part: -len(part["shots"]))
    best = parts[0]
    warnings = []
    if len(parts) > 1:
        counts = ", ".join(str(len(part["shots"])) for part in parts[1:])
        warnings.append(
            f"{source.path.name} has {len(parts)} reconstructions, and the largest is used, with {len(best['shots'])} "
            f"photos; the others have {counts}."
        )
    lenses: dict[str, Calibration] = {}
    cameras = []
    for name, shot in best["shots"].items():
        key = shot["camera"]
        if key not in lenses:
            lenses[key] = sized_calibration(_lens(key, best["cameras"][key]))
        with reading(name):
            rotation = cv2.Rodrigues(np.array(shot["rotation"], np.float64))[0]
            cameras.append(FileCamera(name.replace("\\", "/"), lenses[key], rigid(rotation, shot["translation"])))
    points = list(best.get("points", {}).values())
    return CameraFile(
        PROGRAM,
        tuple(cameras),
        FilePoints(
            np.array([point["coordinates"] for point in points], np.float64),
            np.clip([point.get("color", (128, 128, 128)) for point in points], 0, 255).astype(np.uint8),
        )
        if points
        else None,
        georeference=_georeference(best),
        warnings=warnings,
    )


def _lens(name: str, camera: dict[str, Any]) -> Lens:
    model = camera.get("projection_type", "perspective")
    width, height = int(camera["width"]), int(camera["height"])
    side = max(width, height)

    def value(key: str, otherwise: float = 0.0) -> float:
        return float(camera.get(key, otherwise))

    fx = value("focal_x", value("focal")) * side
    fy = value("focal_y", value("focal")) * side
    point = width / 2 + value("c_x") * side, height / 2 + value("c_y") * side
    radial = [value(key) for key in ("k1", "k2", "k3", "k4")]
    if model in ("perspective", "simple_radial", "radial", "brown"):
        return brown_lens((width, height), (fx, fy), point, radial, (value("p1"), value("p2")))
    if model in ("fisheye", "fisheye_opencv"):
        return Lens("OPENCV_FISHEYE", width, height, (fx, fy, *point, *radial))
    raise ValueError(f"the camera {name} has the model {model}, which cannot be used")


def _georeference(part: dict[str, Any]) -> Georeference | None:
    """Return the metres and coordinates of the world, None where the photos had no GPS."""
    reference = part.get("reference_lla")
    if not reference or not (reference.get("latitude") or reference.get("longitude")):
        return None
    height = float(reference.get("altitude", 0.0))
    origin = geocentric(float(reference["latitude"]), float(reference["longitude"]), height)
    latitude, longitude = np.radians([reference["latitude"], reference["longitude"]])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    rotation = np.stack([east, np.cross(up, east), up], -1)
    return georeference_from_geocentric(1.0, rotation, origin, np.zeros(3), "OpenSfM")
