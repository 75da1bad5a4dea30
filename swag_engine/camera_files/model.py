"""A COLMAP model of placed photos and points."""

from collections.abc import Sequence

import numpy as np

from ..scene.colmap_library import pycolmap
from ..scene.lenses import Lens
from ..scene.ply_points import points_inside
from .camera_file import CameraFile, FilePoints
from .place_photos import PlacedPhoto

_MOST_OBSERVATIONS = 4000
"""Points of a cloud that count as seen by one photo, as many as the features that structure from motion detects."""
_POINTS_OF_CELL = 3
"""Mean number of points in a cell of the photo, in which the nearest one hides those far behind it."""
_CELLS = 1 / 128, 1 / 16
"""Smallest and largest cell, in widths of the photo."""
_BEHIND = 1.1
"""Depth over that of the nearest point of the cell above which a point is taken to be hidden."""


def build_model(file: CameraFile, photos: Sequence[PlacedPhoto]) -> pycolmap.Reconstruction:
    """Make a model of the cameras, without points; image ids are those of `photos` plus one.

    Args:
        file: The file of the cameras.
        photos: The photos in the scene.
    """
    model = pycolmap.Reconstruction()
    ids: dict[Lens, int] = {}
    for number, photo in enumerate(photos, 1):
        if photo.lens not in ids:
            ids[photo.lens] = len(ids) + 1
            lens = photo.lens
            camera = pycolmap.Camera(
                camera_id=ids[lens], model=lens.model, width=lens.width, height=lens.height, params=list(lens.params)
            )
            camera.has_prior_focal_length = True
            model.add_camera_with_trivial_rig(camera)
        pose = file.cameras[photo.camera].world_to_camera
        image = pycolmap.Image(name=photo.name, camera_id=ids[photo.lens], image_id=number)
        rotation = pycolmap.Rotation3d(np.ascontiguousarray(pose[:3, :3]))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, np.ascontiguousarray(pose[:3, 3])))
    return model


def add_observed_points(model: pycolmap.Reconstruction, points: FilePoints, photos: Sequence[PlacedPhoto]) -> None:
    """Add the points of a file with its observations; points that fewer than two photos see are left out.

    Args:
        model: The model of `build_model`.
        points: Points with observations.
        photos: The photos in the scene.
    """
    number_of = {photo.camera: number for number, photo in enumerate(photos)}
    seen: list[list[tuple[float, float]]] = [[] for _ in photos]
    tracks: list[tuple[int, list[tuple[int, int]]]] = []
    for point, observations in enumerate(points.observations):
        track: dict[int, int] = {}
        for camera, x, y in observations:
            number = number_of.get(camera)
            if number is None or number in track:
                continue
            photo = photos[number]
            track[number] = len(seen[number])
            seen[number].append((x * photo.scale + photo.lens.width / 2, y * photo.scale + photo.lens.height / 2))
        if len(track) >= 2:
            tracks.append((point, list(track.items())))
    _add(model, points, seen, tracks)
    model.update_point_3d_errors()


def add_cloud(model: pycolmap.Reconstruction, points: FilePoints, photos: Sequence[PlacedPhoto]) -> None:
    """Add points without observations; a photo sees those that project into it and are not behind others.

    Args:
        model: The model of `build_model`.
        points: The points.
        photos: The photos in the scene.

    """
    random = np.random.default_rng(0)
    seen: list[list[tuple[float, float]]] = []
    tracks: dict[int, list[tuple[int, int]]] = {}
    for number, photo in enumerate(photos):
        pose = model.images[number + 1].cam_from_world().matrix()
        indices, pixels = _visible_points(points.positions, pose, photo.lens)
        if len(indices) > _MOST_OBSERVATIONS:
            chosen = np.sort(random.choice(len(indices), _MOST_OBSERVATIONS, replace=False))
            indices, pixels = indices[chosen], pixels[chosen]
        for slot, point in enumerate(indices):
            tracks.setdefault(int(point), []).append((number, slot))
        seen.append([(float(x), float(y)) for x, y in pixels])
    common = [(point, track) for point, track in sorted(tracks.items()) if len(track) >= 2]
    _add(model, points, seen, common)


def _visible_points(positions: np.ndarray, pose: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Find the points that a photo shows: those of `points_inside` that are not behind others."""
    indices, pixels = points_inside(positions, pose, lens)
    depths = (positions[indices] @ pose[:3, :3].T + pose[:3, 3])[:, 2]
    cell = np.sqrt(_POINTS_OF_CELL * lens.width * lens.height / max(1, len(indices)))
    cell = np.clip(cell, _CELLS[0] * lens.width, _CELLS[1] * lens.width)
    cells = (pixels // cell).astype(np.int64) @ [1 << 20, 1]
    _, group = np.unique(cells, return_inverse=True)
    nearest = np.full(group.max() + 1 if len(group) else 0, np.inf)
    np.minimum.at(nearest, group, depths)
    free = depths <= _BEHIND * nearest[group]
    return indices[free], pixels[free]


def _add(
    model: pycolmap.Reconstruction,
    points: FilePoints,
    seen: Sequence[Sequence[tuple[float, float]]],
    tracks: Sequence[tuple[int, list[tuple[int, int]]]],
) -> None:
    for number, pixels in enumerate(seen):
        model.images[number + 1].points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array(xy)) for xy in pixels])
    for point, track in tracks:
        elements = [pycolmap.TrackElement(number + 1, slot) for number, slot in track]
        color = points.colors[point] if len(points.colors) else np.full(3, 128, np.uint8)
        model.add_point3D(points.positions[point], pycolmap.Track(elements), color)
