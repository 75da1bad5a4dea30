"""Drift of a COLMAP model: how far the first and the last visit of a place disagree.

Images are taken in the order of their names, which is that of time for cameras and for the frames of a video.
"""

from dataclasses import dataclass

import numpy as np

from .colmap_library import pycolmap
from .model_observations import Observations

_FEWEST_POINTS = 10
"""Points that a place needs in both visits."""
_LEAST_SPREAD = np.sin(np.radians(2.0)) ** 2 / 4
"""Least eigenvalue of the mean of I - ray ray^T from which on a point is triangulated: rays 2 degrees apart."""
_MOST_PAIRS = 3000
"""Pairs of images that are compared, at most, so that the time is bounded."""


@dataclass(frozen=True)
class Drift:
    """Disagreement of two visits of a place.

    Attributes:
        fraction: Distance between the place as triangulated from the first visit and from the last, over the length of
            the path; 0..1.
        error: Standard error of `fraction`.
        first: Name of an image of the first visit.
        last: Name of an image of the last visit.
        points: Points that both visits observe.
    """

    fraction: float
    error: float
    first: str
    last: str
    points: int


def path_length(observations: Observations) -> float:
    """Return the length of the path in scene units, in the order of names."""
    return float(np.linalg.norm(np.diff(observations.centres, axis=0), axis=1).sum())


def find_drift(model: pycolmap.Reconstruction, observations: Observations) -> Drift | None:
    """Measure the drift between the first and the last visit of a place, the pair that lies furthest apart in time.

    Points that two visits observe are triangulated from the early observations alone and from the late ones alone.
    The drift is the median of the offsets between the two, so that the noise of single points averages out.

    Returns:
        The drift, None where no place is visited twice.
    """
    count, length = len(observations.image_ids), path_length(observations)
    if count < 8 or not length > 0:
        return None
    gaps = np.diff(observations.image)
    gaps[np.diff(observations.point) > 0] = 0
    at = np.flatnonzero(gaps >= _least_gap(count))  # the observation before a gap
    if not len(at):
        return None
    widest = at[np.lexsort((-gaps[at], observations.point[at]))]
    widest = widest[np.unique(observations.point[widest], return_index=True)[1]]
    last_early = np.full(len(observations.positions), -1)
    last_early[observations.point[widest]] = widest
    revisited = last_early[observations.point] >= 0
    late = np.arange(len(observations.image)) > last_early[observations.point]
    places, known = [], []
    for half in (~late, late):
        place, sure = _triangulate(model, observations, revisited & half)
        places.append(place)
        known.append(sure)
    points = np.flatnonzero(known[0] & known[1])
    if len(points) < _FEWEST_POINTS:
        return None
    offsets = places[1][points] - places[0][points]
    early_image = observations.image[last_early[points]]
    late_image = observations.image[last_early[points] + 1]
    width = max(5, count // 10)
    groups = (early_image // width) * count + late_image // width
    usable = [group for group in np.unique(groups) if (groups == group).sum() >= _FEWEST_POINTS]
    if not usable:
        return None
    group = max(usable, key=lambda key: (key % count) - key // count)
    own = groups == group
    offset = np.median(offsets[own], axis=0)
    # Standard error of a median of normal values; the median absolute deviation is 0.67 standard deviations.
    spread = np.median(np.abs(offsets[own] - offset), axis=0) / 0.6745
    error = 1.25 * float(np.linalg.norm(spread)) / np.sqrt(own.sum())
    name = {key: model.image(int(image_id)).name for key, image_id in enumerate(observations.image_ids)}
    return Drift(
        fraction=float(np.linalg.norm(offset)) / length,
        error=error / length,
        first=name[int(np.median(early_image[own]))],
        last=name[int(np.median(late_image[own]))],
        points=int(own.sum()),
    )


def find_open_loops(model: pycolmap.Reconstruction, observations: Observations) -> list[tuple[str, str]]:
    """Find images far apart in time that should show the same place, yet share no point.

    Returns:
        Names (first, later), those of the most certain pair first.
    """
    count = len(observations.image_ids)
    if count < 8 or not len(observations.image):
        return []
    seen = observations.in_camera()
    starts = np.searchsorted(np.sort(observations.image), np.arange(count + 1))
    order = np.argsort(observations.image, kind="stable")
    own = [order[starts[index] : starts[index + 1]] for index in range(count)]
    ranges = np.array([np.median(seen[rows, 2]) if len(rows) >= _FEWEST_POINTS else np.nan for rows in own])
    centres, forward = observations.centres, observations.world_to_camera[:, 2, :3]
    early, late = np.triu_indices(count, _least_gap(count))
    apart = np.linalg.norm(centres[early] - centres[late], axis=1)
    with np.errstate(invalid="ignore"):
        near = (apart < 0.5 * ranges[early]) & (np.abs(np.log(ranges[early] / ranges[late])) < np.log(1.4))
    near &= (forward[early] * forward[late]).sum(1) > np.cos(np.radians(30))
    early, late = early[near], late[near]
    step = max(1, len(early) // _MOST_PAIRS)
    found = []
    for first, second in zip(early[::step], late[::step], strict=True):
        rows = own[first]
        shared = np.isin(observations.point[rows], observations.point[own[second]]).sum()
        if shared:
            continue
        camera = model.camera(int(observations.camera_ids[second]))
        pose = observations.world_to_camera[second]
        local = observations.positions[observations.point[rows]] @ pose[:, :3].T + pose[:, 3]
        local = local[local[:, 2] > 0]
        pixels = camera.img_from_cam(local) if len(local) else np.zeros((0, 2))
        inside = (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        if inside.sum() >= max(_FEWEST_POINTS, 0.5 * len(rows)):
            found.append((-float(inside.sum()) / len(rows), int(first), int(second)))
    names = [model.image(int(image_id)).name for image_id in observations.image_ids]
    return [(names[first], names[second]) for _, first, second in sorted(found)]


def _least_gap(count: int) -> int:
    """Return how many images later the camera has come back, not merely moved on."""
    return max(5, count // 4)


def _triangulate(
    model: pycolmap.Reconstruction, observations: Observations, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the points from some of their observations (M,) bool.

    Returns:
        The places nearest to all rays (P, 3), and where the rays are enough for one, (P,) bool.
    """
    rows = np.flatnonzero(chosen)
    rays = np.full((len(rows), 3), np.nan)
    cameras = observations.camera_ids[observations.image[rows]]
    for camera_id in np.unique(cameras):
        own = cameras == camera_id
        rays[own] = model.camera(camera_id).cam_ray_from_img(observations.pixels[rows[own]])
    image, point = observations.image[rows], observations.point[rows]
    rays = np.einsum("mji,mj->mi", observations.world_to_camera[image, :, :3], rays)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    good = np.isfinite(rays).all(1)
    sums, sides = np.zeros((len(observations.positions), 3, 3)), np.zeros((len(observations.positions), 3))
    np.add.at(sums, point[good], across[good])
    np.add.at(sides, point[good], np.einsum("mij,mj->mi", across[good], observations.centres[image[good]]))
    counts = np.bincount(point[good], minlength=len(sums))
    sure = np.linalg.eigvalsh(sums)[:, 0] >= _LEAST_SPREAD * np.maximum(counts, 1)
    places = np.full((len(sums), 3), np.nan)
    places[sure] = np.linalg.solve(sums[sure], sides[sure][..., None])[..., 0]
    return places, sure
