"""Positions that are known: of photos from GPS and depths, and of reference points from a table."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from ..base.errors import InputError
from ..base.tables import Row, read_table
from ..base.text import first_names
from ..scene.colmap import Scene, View
from ..scene.colmap_library import pycolmap
from .targets import Target
from .triangulation import Observation, triangulate

GEOGRAPHIC = ("EPSG:4326", "EPSG:4979")
"""Coordinate reference systems of longitude, latitude (degrees) and height."""


@dataclass(frozen=True, eq=False)
class KnownPosition:
    """A place of the scene whose coordinates are known.

    Attributes:
        name: Name of the photo or of the reference point.
        source: Position (3,), scene units.
        target: Coordinates (3,), metres.
    """

    name: str
    source: np.ndarray
    target: np.ndarray


def photos_by_name(views: Iterable[View]) -> dict[str, View]:
    """Index views by their names in lower case, and by the last part of those where only one view has it."""
    views = list(views)
    last = [view.name.rsplit("/", 1)[-1].lower() for view in views]
    short = {name: view for name, view in zip(last, views, strict=True) if last.count(name) == 1}
    return short | {view.name.lower(): view for view in views}


def read_depths(path: Path, scene: Scene) -> dict[str, float]:
    """Read a table of the columns name and depth.

    Args:
        path: The file; depths are metres below the surface, above 0 under water.
        scene: The scene.

    Returns:
        Depth by name of the view, for photos of the scene.

    Raises:
        InputError: If the file cannot be used, or has none of the photos.
    """
    photos = photos_by_name(scene.views)
    rows = read_table(path, ("name", "depth"))
    depths = {photos[row.text("name").lower()].name: row.number("depth") for row in rows if _names(row, photos)}
    if not depths:
        raise InputError(
            f"{path} names none of the {len(scene.views)} photos that have a camera, such as {scene.views[0].name}: "
            "the column name must hold the names of the photo files."
        )
    return depths


def _names(row: Row, photos: Mapping[str, View]) -> bool:
    return row.text("name").lower() in photos


def gps_positions(scene: Scene, depths: Mapping[str, float]) -> tuple[list[KnownPosition], str, list[str]]:
    """Read where the photos were taken from the GPS tags of their EXIF data.

    Args:
        scene: The scene.
        depths: Depth below the surface by name of the view, in place of the tags' altitudes.

    Returns:
        Positions of the photos that have one, in UTM coordinates (metres) with the altitude as z; the coordinate
        reference system; and sentences about positions that are not used.

    Raises:
        InputError: If fewer than three photos have a position, or altitudes are missing.
    """
    found: dict[str, tuple[float, float, float]] = {}
    without_altitude = []
    unusable: dict[str, list[str]] = {}
    for view in scene.views:
        try:
            tag = read_gps(view.path)
        except ValueError as error:
            unusable.setdefault(str(error), []).append(view.name)
            continue
        if tag is None:
            continue
        latitude, longitude, altitude = tag
        height = -depths[view.name] if view.name in depths else None if depths else altitude
        if height is None:
            without_altitude.append(view.name)
        else:
            found[view.name] = (latitude, longitude, height)
    if without_altitude and len(found) >= 3:
        unusable["a depth is missing" if depths else "the altitude is missing"] = without_altitude
    notes = [
        f"GPS positions of {len(names)} of {len(scene.views)} photos are not used, as {reason}: {first_names(names)}."
        for reason, names in unusable.items()
    ]
    if len(found) < 3:
        if without_altitude:
            raise InputError(
                f"{len(without_altitude)} photos have a GPS position without an altitude, such as "
                f"{without_altitude[0]}: give the depths of all photos with --depths FILE (columns name,depth)."
            )
        raise InputError(
            f"{len(found)} of the {len(scene.views)} photos have a GPS position in their EXIF data, and at least three "
            "are needed: write positions into the photos, or measure the scale from targets or depths. "
            + " ".join(notes)
        )
    places, crs = to_utm(np.array(list(found.values())))
    centres = {view.name: view.camera.centre for view in scene.views}
    return [KnownPosition(n, centres[n], place) for n, place in zip(found, places, strict=True)], crs, notes


def to_utm(geographic: np.ndarray) -> tuple[np.ndarray, str]:
    """Convert latitude, longitude (degrees, WGS 84) and height (N, 3) to UTM coordinates of one zone, and name it."""
    places, zone = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84).ellipsoid_to_utm(geographic)
    return places, f"EPSG:{(32600 if geographic[:, 0].mean() >= 0 else 32700) + zone}"


def read_gps(path: Path) -> tuple[float, float, float | None] | None:
    """Read the GPS tags of a photo.

    Returns:
        Latitude and longitude in degrees, north and east positive; altitude in metres, negative below the sea, None
        without; None for a photo without a position.

    Raises:
        ValueError: If the tags are no position, with the reason.
    """
    try:
        with Image.open(path) as image:
            tags = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
    except (OSError, ValueError, SyntaxError):  # PIL raises SyntaxError for damaged data
        return None
    if not {ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLongitude} <= set(tags):
        return None
    latitude = _degrees(tags[ExifTags.GPS.GPSLatitude], tags.get(ExifTags.GPS.GPSLatitudeRef), "NS")
    longitude = _degrees(tags[ExifTags.GPS.GPSLongitude], tags.get(ExifTags.GPS.GPSLongitudeRef), "EW")
    if latitude == longitude == 0:
        raise ValueError("latitude and longitude are 0, which cameras write without reception")
    if not (abs(latitude) <= 84 and abs(longitude) <= 180):
        raise ValueError("they are beyond 84 degrees of latitude (the end of UTM) or 180 of longitude")
    try:
        altitude = float(np.ravel(tags[ExifTags.GPS.GPSAltitude])[0])
        below = tags.get(ExifTags.GPS.GPSAltitudeRef, 0) in (b"\1", 1, b"\3", 3)  # of the sea, of the ellipsoid
    except (KeyError, IndexError, TypeError, ValueError, ZeroDivisionError):
        return latitude, longitude, None
    if not math.isfinite(altitude):
        return latitude, longitude, None
    return latitude, longitude, -abs(altitude) if below else altitude


def _degrees(parts: Any, reference: Any, letters: str) -> float:
    """Return an angle from its degrees, minutes and seconds (minutes and seconds may be absent).

    Args:
        parts: One to three numbers; a part without a value counts as 0 after one with a fraction.
        reference: The tag with one of the two letters, upper or lower case; a negative number needs none.
        letters: That of positive angles and that of negative ones.

    Raises:
        ValueError: If the reference is missing or the numbers are no angle.
    """
    try:
        values = [float(part) for part in np.ravel(parts)]
    except (TypeError, ValueError, ZeroDivisionError):
        values = []
    for index in range(1, len(values)):
        if math.isnan(values[index]) and sum(values[:index]) % 1:
            values[index] = 0.0
    if not (1 <= len(values) <= 3 and math.isfinite(sum(values)) and all(0 <= value <= 60 for value in values[1:])):
        raise ValueError("they are not degrees, minutes and seconds")
    angle = sum(abs(value) / 60**index for index, value in enumerate(values))
    text = reference.decode("latin-1") if isinstance(reference, bytes) else str(reference or "")
    letter = text.strip().upper()[:1]
    if values[0] < 0 or (letter and letter == letters[1]):
        return -angle
    if not letter or letter not in letters:
        raise ValueError(f"the reference {letters[0]} or {letters[1]} is missing")
    return angle


def point_positions(
    path: Path, scene: Scene, targets: Mapping[int, Target], crs: str | None
) -> tuple[list[KnownPosition], str | None, list[str]]:
    """Read a table of reference points, and find them in the scene.

    A row has the columns name, x, y, z, and where the point is seen: photo, u, v (pixels from the top left corner of
    the image, a row for each photo). A point without photos is the target whose number is its name, or the photo of
    that name.

    Args:
        path: The file.
        scene: The scene.
        targets: The targets that were found, by number.
        crs: Coordinate reference system of the table; geographic ones (x longitude, y latitude) are converted to UTM.

    Returns:
        The points that were found, their coordinate reference system, and sentences about the others.

    Raises:
        InputError: If the file cannot be used, or fewer than two of its points are in the scene.
    """
    photos = photos_by_name(scene.views)
    places: dict[str, np.ndarray] = {}
    seen: dict[str, list[Observation]] = {}
    notes: list[str] = []
    for row in read_table(path, ("name", "x", "y", "z")):
        name = row.text("name")
        if not name:
            raise InputError(f"{row.path}, line {row.line}: the point has no name.")
        if any(row.text(axis) for axis in "xyz"):
            place = np.array([row.number(axis) for axis in "xyz"])
            if name in places and not np.array_equal(places[name], place):
                raise InputError(f"{row.path}, line {row.line}: the point {name} has other coordinates further up.")
            places[name] = place
        if not (photo := row.text("photo").replace("\\", "/")):
            continue
        if view := photos.get(photo.lower()):
            pixel = np.array([row.number("u"), row.number("v")])
            seen.setdefault(name, []).append(Observation(view, pixel))
        else:
            notes.append(f"{photo}, where the point {name} is seen, has no camera in the scene.")
    if not places:
        raise InputError(f"{path} has no coordinates: fill the columns x, y and z.")
    if crs and crs.upper() in GEOGRAPHIC:
        geographic = np.stack(list(places.values()))[:, [1, 0, 2]]
        if (np.abs(geographic[:, :2]) > (84, 180)).any():
            raise InputError(f"{path} has coordinates that are no longitude (x) and latitude (y) in degrees: {crs}.")
        converted, crs = to_utm(geographic)
        places = dict(zip(places, converted, strict=True))
    found = []
    for name, place in places.items():
        source, problem = _find_point(name, seen.get(name, ()), targets, photos)
        if source is None:
            notes.append(problem)
        else:
            found.append(KnownPosition(name, source, place))
    if len(found) < 2:
        raise InputError(
            f"{len(found)} of the {len(places)} points of {path} are in the scene, and at least two are needed. "
            + " ".join(notes[:3])
        )
    return found, crs, notes


def _find_point(
    name: str, observations: Sequence[Observation], targets: Mapping[int, Target], photos: Mapping[str, View]
) -> tuple[np.ndarray | None, str]:
    """Return where a reference point is in the scene, None and why where that is not known."""
    if observations:
        point = triangulate(observations)
        if point is None:
            reason = "one photo alone" if len(observations) == 1 else "photos that do not agree where it is"
            return None, f"The point {name} is seen in {reason}: give its pixels in two photos from different places."
        return point.position, ""
    if name.isdecimal() and int(name) in targets:
        return targets[int(name)].centre, ""
    if view := photos.get(name.lower()):
        return view.camera.centre, ""
    return None, f"The point {name} has no pixels, and is neither a target that was found nor a photo with a camera."
