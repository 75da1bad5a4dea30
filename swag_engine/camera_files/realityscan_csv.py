"""RealityScan (RealityCapture): the CSV "Internal/External camera parameters".

Columns: #name, x, y, alt, heading, pitch, roll (degrees), f (millimetres on a film 36 mm wide), px, py (principal point
from the middle, in lengths of the longer side), k1 to k4 (radial), t1, t2 (tangential). Sources: RealityScan's help and
"RealityCapture XMP Camera Math"; the rotation is that of nerfstudio's importer.
"""

import re

import numpy as np

from ..base.tables import parse_table
from ..scene.georeference import Georeference, Placement
from ..scene.lenses import Lens
from .camera_file import OPENGL_AXES, Calibration, CameraFile, FileCamera, brown_lens, reading, rigid
from .source import Source

PROGRAM = "RealityScan"
FILM_WIDTH = 36.0
"""Width in millimetres of the film that focal lengths refer to."""
_PROJECTED = 1e5
"""Coordinate above which a file has a projected coordinate system such as UTM: no dive is that long."""
_POSE = ("x", "y", "alt", "heading", "pitch", "roll")
_LENS = ("f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")


def recognise(source: Source) -> bool:
    """Return whether one of the first lines names the columns."""
    for line in source.text[:1000].splitlines()[:5]:
        names = {name.strip(' "').lower() for name in re.split("[,;\t]", line.strip().lstrip("#"))}
        if {"name", "f", *_POSE} <= names:
            return True
    return False


def read(source: Source) -> CameraFile:
    """Read the rows.

    Raises:
        InputError: For a table that cannot be read, or a cell that is not a number.
        ValueError: For a row that is no camera.
    """
    shared: dict[tuple[float, ...], Calibration] = {}
    cameras = []
    for row in parse_table(source.path, source.text, ("name", *_POSE, "f")):
        name = row.text("name").replace("\\", "/")
        x, y, z, heading, pitch, roll = (row.number(column) for column in _POSE)
        values = tuple(row.number(column) if row.text(column) else 0.0 for column in _LENS)
        with reading(f"line {row.line} ({name})"):
            to_world = rigid(rotation_from_angles(heading, pitch, roll) @ OPENGL_AXES, [x, y, z])
        calibration = shared.setdefault(values, film_calibration(values[0], values[1:3], values[3:7], values[7:9]))
        cameras.append(FileCamera(name, calibration, np.linalg.inv(to_world)))
    return CameraFile(PROGRAM, tuple(cameras), georeference=_georeference(cameras))


def _georeference(cameras: list[FileCamera]) -> Georeference | None:
    """Return metres of a projected coordinate system, whose coordinates are large; others have no certain unit."""
    if len(cameras) < 2 or np.abs(np.median([camera.centre for camera in cameras], axis=0)).max() < _PROJECTED:
        return None
    note = "The coordinates of RealityScan are taken for metres of a projected coordinate system."
    zero = np.zeros(3)
    placement = Placement(None, (0.0, 0.0, 0.0))
    return Georeference(1.0, None, PROGRAM, "full", np.eye(3), zero, placement, notes=(note,))


def rotation_from_angles(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Return the rotation (3, 3) from a camera (y up, looking along -z) to the world (z up), of angles in degrees.

    With all angles 0 the camera looks straight down and its top is at +y; the heading is clockwise seen from above.
    """
    heading, pitch, roll = np.radians([-heading, pitch, roll])
    about_z = [[np.cos(heading), -np.sin(heading), 0], [np.sin(heading), np.cos(heading), 0], [0, 0, 1]]
    about_x = [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    about_y = [[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]]
    return np.array(about_z) @ np.array(about_x) @ np.array(about_y)


def film_calibration(
    focal: float,
    principal_point: tuple[float, ...],
    radial: tuple[float, ...],
    tangential: tuple[float, ...],
    aspect: float = 1.0,
    skew: float = 0.0,
) -> Calibration:
    """Make a calibration of RealityScan's parameters.

    Args:
        focal: Focal length in x, millimetres.
        principal_point: Principal point from the middle, in lengths of the longer side.
        radial: k1 to k4.
        tangential: t1 and t2.
        aspect: Focal length in y over that in x.
        skew: As the focal length, millimetres.
    """

    def lens(width: int, height: int) -> Lens:
        side = max(width, height)
        fx = focal * side / FILM_WIDTH
        point = width / 2 + principal_point[0] * side, height / 2 + principal_point[1] * side
        return brown_lens((width, height), (fx, fx * aspect), point, radial, tangential, skew * side / FILM_WIDTH)

    return Calibration(lens)
