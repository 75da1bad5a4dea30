"""Cutting of a survey: the ground, boxes on it that tile the plane, and the images that join each of them.

Everything here works on arrays, reads no file and is deterministic.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..formats.survey_folder import Box, Ground, inside

MARGIN = 0.2
"""Margin of a block's extended box around its core, at least, as a fraction of the core's side."""
MARGIN_REACHES = 2.0
"""The same as a factor of the median distance, on the ground, from a camera to the points that it sees: images of the
core see little beyond it. The range would be too much where cameras look down: with twice the range, a survey of 1800
images with an overlap of two thirds had 6.7 images more for each of its own in blocks of 300, and has 1.3 now."""
JOIN_POINTS = 50
"""Points of an image in the extended box from which on it joins the block (Hierarchical 3DGS, Kerbl et al. 2024)."""
JOIN_FRACTION = 0.1
"""Fraction of an image's points in the extended box from which on it joins the block, for images of few points."""
MOSTLY = 0.5
"""Fraction of an image's points in the extended box below which the image sees mostly elsewhere."""
SMALLEST_CORE = 0.1
"""Cameras in a core, at least, as a fraction of the block's images: with fewer, nearly all work would be for the
margin."""
WORTHWHILE = 0.8
"""Images of the largest part after a cut as a fraction of those before it, above which the cut is not made."""
SEAM_WIDTH = 0.25
"""Distance to which a seam reaches on each side of a border, as a factor of the least margin. On a generated reef with
half a meter between splats, the PSNR of two blocks beside each other fell within this distance from their border."""
OUTERMOST = 0.01
"""Fraction of the points at each end of each axis that bounds may leave out: the outermost are often wrong."""
SAMPLED_POINTS = 100
"""Points of each image that the median distance is taken from."""
EVERYWHERE: Box = (-np.inf, -np.inf, np.inf, np.inf)
"""The whole plane."""


@dataclass(frozen=True, eq=False)
class Places:
    """Where the cameras and the points of a survey are on the ground, and which image sees which point.

    Attributes:
        cameras: Positions of the cameras (V, 2), scene units.
        points: Positions of the sparse points (P, 2).
        seen: Rows (M,) of `points` that each of the V images sees, each once.
    """

    cameras: np.ndarray
    points: np.ndarray
    seen: Sequence[np.ndarray]


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a survey.

    Attributes:
        core: Box on the ground; the cores of all parts tile the plane.
        extended: Core with a margin; infinite edges stay infinite.
        images: Images (N,) that join it, rows of `Places.cameras`, ascending.
        whole_images: Sum of the fractions of their points that are in the extended box.
        points: Number of points in the extended box.
        core_points: Number of points in the core.
    """

    core: Box
    extended: Box
    images: np.ndarray
    whole_images: float
    points: int
    core_points: int


@dataclass(frozen=True, eq=False)
class Seam(Part):
    """The strip along the border between two parts; the cores of all seams are disjoint.

    Attributes:
        sides: Numbers of the two parts.
    """

    sides: tuple[int, int]


def survey_ground(up: np.ndarray, centres: np.ndarray, positions: np.ndarray) -> Ground:
    """Find the plane on which a survey is cut.

    The origin is the median of the points; x runs along the longer side of the smallest rectangle around the cameras.

    Args:
        up: Up direction (3,).
        centres: Positions of the cameras (V, 3), scene units.
        positions: Sparse points (P, 3).

    Returns:
        The ground.
    """
    up = up / np.linalg.norm(up)
    origin = np.median(positions, axis=0)
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    level = np.stack([first, np.cross(up, first)])  # any two axes of the plane
    on_plane = (centres - origin) @ level.T
    corners = cv2.boxPoints(cv2.minAreaRect((on_plane - on_plane.mean(0)).astype(np.float32)))
    sides = np.diff(corners[:3].astype(np.float64), axis=0)
    longer = sides[np.argmax(np.linalg.norm(sides, axis=1))]
    length = np.linalg.norm(longer)
    x = (longer / length if length > 0 else np.array([1.0, 0.0])) @ level
    x *= np.sign(x[np.argmax(np.abs(x))])  # the rectangle has no direction
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(up, x), up])
    return Ground(tuple(origin.tolist()), tuple(tuple(row) for row in axes.tolist()))


def median_distance(cameras: np.ndarray, points: np.ndarray, seen: Sequence[np.ndarray]) -> float:
    """Return the median distance from a camera to a point that it sees, over some points of each image.

    Args:
        cameras: Positions of the cameras, (V, 3) or (V, 2) on the ground.
        points: Positions of the sparse points, likewise.
        seen: Rows of `points` that each image sees.
    """
    distances = []
    for camera, rows in zip(cameras, seen, strict=True):
        some = rows[:: max(1, len(rows) // SAMPLED_POINTS)]
        distances.append(np.linalg.norm(points[some] - camera, axis=1))
    together = np.concatenate(distances)
    return float(np.median(together)) if len(together) else 0.0


def survey_bounds(places: Places, distance: float) -> Box:
    """Find the box that holds all cameras, and all but the outermost points within a distance of the cameras' box."""
    lowest, highest = places.cameras.min(0), places.cameras.max(0)
    low, high = np.quantile(places.points, [OUTERMOST, 1 - OUTERMOST], axis=0)
    left, bottom = np.minimum(lowest, np.maximum(low, lowest - distance)).tolist()
    right, top = np.maximum(highest, np.minimum(high, highest + distance)).tolist()
    return left, bottom, right, top


def sides(box: Box, bounds: Box) -> tuple[float, float]:
    """Return the sides of a box in x and y; those of infinite boxes end at the bounds of the survey."""
    left, bottom, right, top = box
    x = min(right, bounds[2]) - max(left, bounds[0])
    y = min(top, bounds[3]) - max(bottom, bounds[1])
    return max(0.0, x), max(0.0, y)


def extended_box(core: Box, bounds: Box, distance: float) -> Box:
    """Return a core with its margin.

    Args:
        core: The core.
        bounds: Box of the survey, in which the sides of infinite cores are measured.
        distance: The least margin, scene units.
    """
    x, y = (max(MARGIN * side, distance) for side in sides(core, bounds))
    return core[0] - x, core[1] - y, core[2] + x, core[3] + y


@dataclass(frozen=True, eq=False)
class Cutter:
    """Recursive bisection of a survey.

    Attributes:
        places: Cameras and points.
        bounds: Box of the survey.
        distance: The least margin of extended boxes, scene units.
        block_images: Images that a part has at most, where the survey can be cut so.
        fits: Returns whether a part is small enough otherwise, for example for the memory.
        enough: Returns whether a part has enough images to be trained.
        seed: Seed of the choice of images.
    """

    places: Places
    bounds: Box
    distance: float
    block_images: int
    fits: Callable[[Part], bool]
    enough: Callable[[Part], bool]
    seed: int

    def cut(self) -> list[Part]:
        """Cut at the median of the cameras along the longer side until every part is small enough.

        A cut is not made where it would leave a part with too few images, or where its parts would have nearly as many
        images as before: their images all see the same place. So a part can stay larger than was asked.

        Returns:
            The parts, whose cores tile the plane; neighbors are near each other in the list.
        """
        return self._parts(self._joined(EVERYWHERE, np.arange(len(self.places.seen)), 1))

    def _parts(self, found: "_Joined") -> list[Part]:
        core = found.part.core
        if found.expected <= self.block_images and self.fits(found.part):
            return [found.part]
        cameras = self.places.cameras[inside(core, self.places.cameras)]
        for axis in np.argsort([-side for side in sides(core, self.bounds)], kind="stable"):
            along = np.sort(cameras[:, axis])
            border = _border(along)
            if border is None:
                continue
            least = min(np.searchsorted(along, border), np.searchsorted(-along[::-1], -border, "right"))
            if least < SMALLEST_CORE * min(self.block_images, len(found.images)):
                continue
            low, high = list(core), list(core)
            low[2 + axis] = high[axis] = border
            halves = [
                self._joined((half[0], half[1], half[2], half[3]), found.images, 2 * found.path + k)
                for k, half in enumerate((low, high))
            ]
            if not all(self.enough(half.part) for half in halves):
                continue
            parts = [part for half in halves for part in self._parts(half)]
            if max(len(part.images) for part in parts) <= WORTHWHILE * len(found.part.images):
                return parts
        return [found.part]

    def _joined(self, core: Box, candidates: np.ndarray, path: int) -> "_Joined":
        """Find which of the candidates (N,) join a box; its path is 1 for the whole plane, 2n and 2n+1 for halves of n.

        The extended box of a half lies in that of the whole, so that all its images are among those of the whole.
        """
        extended = extended_box(core, self.bounds, self.distance)
        within = inside(extended, self.places.points)
        fractions, joins = _joining(within, self.places, candidates)
        images, fractions = candidates[joins], fractions[joins]
        kept = (fractions >= MOSTLY) | inside(core, self.places.cameras[images])
        expected = np.count_nonzero(kept) + fractions[~kept].sum()
        chosen = np.ones(len(images), bool)
        most = max(self.block_images, int(np.ceil(expected)))
        if most < len(images):
            # Each image that sees mostly elsewhere is wanted as much as its fraction is large.
            rest = np.flatnonzero(~kept)
            count = most - np.count_nonzero(kept)
            random = np.random.default_rng((self.seed, path))
            chosen = kept.copy()
            chosen[random.choice(rest, count, replace=False, p=fractions[rest] / fractions[rest].sum())] = True
        core_points = np.count_nonzero(inside(core, self.places.points))
        part = Part(
            core, extended, images[chosen], float(fractions.sum()), int(np.count_nonzero(within)), int(core_points)
        )
        return _Joined(part, images, float(expected), path)


def seams_of(parts: Sequence[Part], places: Places, bounds: Box, distance: float) -> list[Seam]:
    """Find the seams between parts whose cores share a border.

    Args:
        parts: The parts.
        places: Cameras and points.
        bounds: Box of the survey.
        distance: The least margin of extended boxes, scene units.

    Returns:
        The seams, each with the images of its parts that show it: no more than these parts have themselves, and then
        those that show most of it.
    """
    # Thinner than the cores, so that the strips of opposite borders do not meet.
    sides_of = [side for part in parts for side in sides(part.core, bounds) if side > 0]
    width = min(SEAM_WIDTH * distance, 0.25 * min(sides_of, default=0.0))
    seams = []
    for first, second in itertools.combinations(range(len(parts)), 2):
        found = _strip(parts[first], parts[second], width, distance)
        if found is None:
            continue
        core, extended = found
        images = np.union1d(parts[first].images, parts[second].images)
        within = inside(core, places.points)
        fractions, joins = _joining(within, places, images)
        most = max(len(parts[first].images), len(parts[second].images))
        joined = np.sort(np.argsort(-np.where(joins, fractions, 0), kind="stable")[: min(most, joins.sum())])
        near = inside(extended, places.points)
        whole_images = _joining(near, places, images[joined])[0].sum()
        counts = int(np.count_nonzero(near)), int(np.count_nonzero(within))
        seams.append(Seam(core, extended, images[joined], float(whole_images), *counts, (first, second)))
    return seams


def _strip(first: Part, second: Part, width: float, distance: float) -> tuple[Box, Box] | None:
    """Return what lies within a distance from the common border of two cores, and the box that surrounds it.

    Strips along x end before those along y, so that each place is in one of them at most. What surrounds a strip is, at
    its ends, within the least margin, and across it all of the two parts: with coarse Gaussians beyond the least margin
    in place of those of the parts, PSNR at the seams of a generated reef was 1.9 dB worse.

    Returns:
        Both boxes, or None where the cores have no common border.
    """
    for axis, along in ((0, 1), (1, 0)):
        start, end = (limit(first.core[k], second.core[k]) for limit, k in ((max, along), (min, 2 + along)))
        for low, high in ((first, second), (second, first)):
            at, inset = high.core[axis], width * axis
            if low.core[2 + axis] == at and start + inset < end - inset:
                core = _box(axis, at - width, at + width, start + inset, end - inset)
                across = low.extended[axis], high.extended[2 + axis]
                return core, _box(axis, *across, start - distance, end + distance)
    return None


def _box(axis: int, low: float, high: float, start: float, end: float) -> Box:
    """Return the box from `low` to `high` on an axis and from `start` to `end` on the other."""
    return (start, low, end, high) if axis else (low, start, high, end)


def _joining(within: np.ndarray, places: Places, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find which images join a box.

    Args:
        within: (P,) bool, which points are in the box.
        places: Cameras and points.
        candidates: (N,) images.

    Returns:
        The fraction (N,) of each image's points that are in the box, and whether it joins (N,).
    """
    counts = np.array([np.count_nonzero(within[places.seen[image]]) for image in candidates])
    fractions = counts / np.maximum(1, [len(places.seen[image]) for image in candidates])
    return fractions, (counts >= JOIN_POINTS) | ((fractions >= JOIN_FRACTION) & (counts > 0))


@dataclass(frozen=True, eq=False)
class _Joined:
    """A part; all images that join it, before some are chosen; how many would be left; and where the part is."""

    part: Part
    images: np.ndarray
    expected: float
    path: int


def _border(along: np.ndarray) -> float | None:
    """Return a border between the sorted coordinates (N,) of cameras, as near the median as it can be.

    None where all cameras have the same coordinate.
    """
    steps = np.flatnonzero(along[1:] > along[:-1]) + 1
    if not len(steps):
        return None
    after = steps[np.argmin(np.abs(steps - len(along) / 2))]
    middle = (along[after - 1] + along[after]) / 2
    return float(middle if middle > along[after - 1] else along[after])
