"""Scenes placed in geocentric coordinates (WGS 84), as Metashape and OpenSfM place theirs."""

import numpy as np

from ..scene.colmap_library import pycolmap
from ..scene.georeference import Georeference, Placement


def georeference_from_geocentric(
    scale: float, rotation: np.ndarray, translation: np.ndarray, centre: np.ndarray, method: str
) -> Georeference:
    """Make a georeference, with axes along the grid of the UTM zone, of a similarity to geocentric coordinates.

    The grid of UTM is up to 0.04 % smaller than the ground; metres are those of the ground.

    Args:
        scale: Metres of a unit of the scene.
        rotation: Rotation (3, 3) from the scene to geocentric axes.
        translation: Translation (3,), metres.
        centre: Middle of the scene (3,), in its coordinates.
        method: Name of the program, for `Georeference.method`.
    """
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    middle = scale * rotation @ centre + translation
    geographic = np.asarray(transform.ecef_to_ellipsoid(middle[None]))
    latitude, longitude = np.radians(geographic[0, :2])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    to_east_north_up = np.stack([east, np.cross(up, east), up])
    # North of the grid is not that of the compass: the angle between them is measured over a metre.
    nearby = np.asarray(transform.ecef_to_ellipsoid(np.stack([middle, middle + to_east_north_up[1]])))
    places, zone = transform.ellipsoid_to_utm(nearby)
    x, y = places[1, :2] - places[0, :2]
    angle = np.arctan2(-x, y)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    local = turn @ to_east_north_up @ rotation
    offset = tuple(float(value) for value in places[0])
    return Georeference(
        metres_per_unit=scale,
        error=None,
        method=method,
        axes="full",
        rotation=local,
        translation=-scale * local @ centre,
        placement=Placement(f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}", (offset[0], offset[1], offset[2])),
    )


def geocentric(latitude: float, longitude: float, height: float) -> np.ndarray:
    """Convert degrees and metres on WGS 84 to geocentric metres (3,)."""
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(transform.ellipsoid_to_ecef(np.array([[latitude, longitude, height]])))[0]
