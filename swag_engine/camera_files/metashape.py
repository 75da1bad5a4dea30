"""Metashape (and PhotoScan): the XML of Export Cameras, and the doc.xml of a project.

Source: Agisoft Metashape Pro user manual, appendix "Camera models"; the coordinate of the centre of the top left pixel
is (0.5, 0.5) there, too. Poses are from the camera to the coordinates of the chunk, which the transform of the chunk
(or of its component) takes to metres: local ones, or geocentric ones where the chunk has a geographic reference.
"""

import xml.etree.ElementTree as ElementTree
from collections import Counter
from dataclasses import dataclass

import numpy as np

from ..scene.georeference import Georeference
from ..scene.lenses import Lens
from .camera_file import (
    Calibration,
    CameraFile,
    FileCamera,
    brown_lens,
    photos_are,
    reading,
    rigid,
    sized_calibration,
)
from .geocentric import georeference_from_geocentric
from .polynomial_lens import PolynomialLens
from .source import Source

PROGRAM = "Metashape"
_INSIDE_EARTH = 6e6
"""Metres from the centre of the Earth below which coordinates are not geocentric: the chunk was placed by hand."""


@dataclass(frozen=True, eq=False)
class _Group:
    """Cameras in one coordinate system: those of a chunk, or of one component of it."""

    name: str
    transform: ElementTree.Element | None
    reference: str
    cameras: tuple[FileCamera, ...]


def recognise(source: Source) -> bool:
    """Return whether the file has chunks with cameras."""
    return source.xml is not None and any(chunk.find("cameras") is not None for chunk in source.xml.iter("chunk"))


def read(source: Source) -> CameraFile:
    """Read the largest group of aligned cameras.

    Raises:
        ValueError: When the file has no aligned camera.
    """
    root = source.xml
    assert root is not None
    warnings: list[str] = []
    groups: list[_Group] = []
    for number, chunk in enumerate(root.iter("chunk"), 1):
        groups += _groups(chunk, chunk.get("label") or f"chunk {number}", warnings)
    groups.sort(key=lambda group: -len(group.cameras))
    if not groups:
        raise ValueError("no camera in it is aligned: align the photos and export the cameras again")
    best = groups[0]
    if len(groups) > 1:
        others = ", ".join(f"{group.name} ({len(group.cameras)})" for group in groups[1:])
        warnings.append(
            f"{source.path.name} has {len(groups)} groups of aligned cameras, and the largest is used, {best.name} "
            f"with {len(best.cameras)} photos; left out: {others}."
        )
    return CameraFile(PROGRAM, best.cameras, georeference=_georeference(best), warnings=warnings)


def _groups(chunk: ElementTree.Element, name: str, warnings: list[str]) -> list[_Group]:
    calibrations = _calibrations(chunk, warnings)
    components = {component.get("id"): component for component in chunk.iterfind("components/component")}
    found: dict[str | None, list[FileCamera]] = {}
    left_out: Counter[str] = Counter()
    for folder, camera in _cameras(chunk):
        label = camera.get("label") or f"camera {camera.get('id')}"
        transform = camera.find("transform")
        if camera.get("enabled", "true").lower() in ("false", "0"):
            left_out["disabled in Metashape"] += 1
        elif camera.get("master_id") is not None:
            left_out["from the further sensors of a multi-camera system"] += 1
        elif transform is None or not (transform.text or "").strip():
            left_out["not aligned by Metashape"] += 1
        elif camera.get("sensor_id") not in calibrations:
            left_out["from a sensor without a calibration"] += 1
        else:
            with reading(f"camera {label}"):
                pose = _numbers(transform, 16).reshape(4, 4)
                to_chunk = rigid(pose[:3, :3], pose[:3, 3])
            path = f"{folder}/{label}" if folder else label
            found.setdefault(camera.get("component_id") if components else None, []).append(
                FileCamera(path.replace("\\", "/"), calibrations[camera.get("sensor_id")], np.linalg.inv(to_chunk))
            )
    for reason, count in left_out.items():
        warnings.append(f"{photos_are(count)} left out of {name}: {reason}.")
    reference = (chunk.findtext("reference") or "").strip()
    groups = []
    for component_id, cameras in found.items():
        component = components.get(component_id)
        transform = component.find("transform") if component is not None else None
        if transform is None:
            transform = chunk.find("transform")
        title = name
        if component is not None and len(found) > 1:
            title += f", {component.get('label') or f'component {component_id}'}"
        groups.append(_Group(title, transform, reference, tuple(cameras)))
    return groups


def _cameras(chunk: ElementTree.Element) -> list[tuple[str, ElementTree.Element]]:
    """Return the cameras of a chunk, each with the label of its camera group, "" without one."""
    found: list[tuple[str, ElementTree.Element]] = []
    for cameras in chunk.iterfind("cameras"):
        found += [("", camera) for camera in cameras.iterfind("camera")]
        for group in cameras.iterfind("group"):
            found += [(group.get("label") or "", camera) for camera in group.iterfind("camera")]
    return found


def _calibrations(chunk: ElementTree.Element, warnings: list[str]) -> dict[str | None, Calibration]:
    found: dict[str | None, Calibration] = {}
    for sensor in chunk.iterfind("sensors/sensor"):
        by_class = {entry.get("class", "adjusted"): entry for entry in sensor.iterfind("calibration")}
        if not by_class:
            continue
        name = sensor.get("label") or sensor.get("id")
        if "adjusted" not in by_class:
            warnings.append(f"The lens {name} was not calibrated by Metashape: its initial values are used.")
        calibration = by_class.get("adjusted", next(iter(by_class.values())))
        resolution = calibration.find("resolution")
        if resolution is None:
            resolution = sensor.find("resolution")
        if resolution is None:
            raise ValueError(f"the sensor {name} has no resolution")
        size = int(resolution.attrib["width"]), int(resolution.attrib["height"])
        kind = calibration.get("type") or sensor.get("type") or "frame"
        found[sensor.get("id")] = sized_calibration(_lens(kind, size, calibration, str(name)))
    return found


def _lens(kind: str, size: tuple[int, int], calibration: ElementTree.Element, name: str) -> Lens:
    def value(key: str) -> float:
        return float(calibration.findtext(key) or 0.0)

    if calibration.find("fx") is not None:  # PhotoScan before 1.2: two focal lengths, and the point from the corner
        fx, fy, skew = value("fx"), value("fy"), value("skew")
        cx, cy = value("cx"), value("cy")
    else:
        if calibration.find("f") is None:
            raise ValueError(f"the calibration of {name} has no focal length")
        fx, fy, skew = value("f") + value("b1"), value("f"), value("b2")
        cx, cy = size[0] / 2 + value("cx"), size[1] / 2 + value("cy")
    k1, k2, k3, k4 = (value(key) for key in ("k1", "k2", "k3", "k4"))
    p1, p2 = value("p2"), value("p1")  # OpenCV's order
    p3, p4 = value("p3"), value("p4")
    if kind == "frame":
        return brown_lens(size, (fx, fy), (cx, cy), (k1, k2, k3, k4), (p1, p2), skew, (p3, p4))
    if kind == "fisheye" and not skew and not ((p3 or p4) and (p1 or p2)):
        if p1 or p2:
            return Lens("THIN_PRISM_FISHEYE", *size, (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, 0.0, 0.0))
        return Lens("OPENCV_FISHEYE", *size, (fx, fy, cx, cy, k1, k2, k3, k4))
    if kind in ("fisheye", "equidistant_fisheye", "equisolid_fisheye"):
        model = "equisolid" if kind == "equisolid_fisheye" else "equidistant"
        return PolynomialLens(model, *size, (fx, fy, cx, cy, skew, k1, k2, k3, k4, p1, p2, p3, p4))
    raise ValueError(f"its sensor {name} is of the type {kind}; only frame and fisheye lenses can be used")


def _georeference(group: _Group) -> Georeference | None:
    if group.transform is None:
        return None
    if group.transform.find("rotation") is not None or group.transform.find("translation") is not None:
        scale = float(group.transform.findtext("scale") or 1.0)
        rotation_element, place = group.transform.find("rotation"), group.transform.find("translation")
        rotation = np.eye(3) if rotation_element is None else _numbers(rotation_element, 9).reshape(3, 3)
        translation = np.zeros(3) if place is None else _numbers(place, 3)
    elif (group.transform.text or "").strip():
        matrix = _numbers(group.transform, 16).reshape(4, 4)
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        rotation, translation = matrix[:3, :3] / scale, matrix[:3, 3]
    else:
        return None
    if not scale > 0:
        raise ValueError("the transform of the chunk has no scale")
    rotation = rigid(rotation, translation)[:3, :3]
    centre = np.mean([camera.centre for camera in group.cameras], 0)
    is_local = not group.reference or group.reference.startswith("LOCAL_")
    if is_local or np.linalg.norm(scale * rotation @ centre + translation) < _INSIDE_EARTH:
        return Georeference(scale, None, PROGRAM, "full", rotation, translation)
    return georeference_from_geocentric(scale, rotation, translation, centre, PROGRAM)


def _numbers(element: ElementTree.Element, count: int) -> np.ndarray:
    values = np.array([float(word) for word in (element.text or "").split()])
    if len(values) != count:
        raise ValueError(f"<{element.tag}> has {len(values)} numbers instead of {count}")
    return values
