"""Coded targets (ArUco, AprilTag) in photos: their corners in the scene, and the scale from their known size."""

import os
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from ..base.errors import InputError
from ..base.transfer import LUMINANCE, linear_of_bytes
from ..scene.colmap import Scene, View
from ..scene.images import read_image
from .families import FAMILIES
from .lengths import Length
from .triangulation import Observation, PlacedPoint, triangulate

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Target:
    """A target whose corners were triangulated.

    Attributes:
        number: Its number in the family.
        corners: Its four corners, clockwise from the top left as printed.
    """

    number: int
    corners: tuple[PlacedPoint, ...]

    @property
    def positions(self) -> np.ndarray:
        """Positions of the corners (4, 3), scene units."""
        return np.stack([corner.position for corner in self.corners])

    @property
    def centre(self) -> np.ndarray:
        """Position of the middle (3,), scene units."""
        return self.positions.mean(0)

    @property
    def views(self) -> int:
        """Number of photos that place every corner."""
        return min(corner.views for corner in self.corners)

    def length(self, size: float) -> Length:
        """Compare the edges and diagonals with the size of the target.

        Args:
            size: True length of an edge, metres.
        """
        places = self.positions
        true = [size * (2**0.5 if (j - i) == 2 else 1.0) for i, j in combinations(range(4), 2)]
        measured = [float(np.linalg.norm(places[i] - places[j])) for i, j in combinations(range(4), 2)]
        ratios = np.array(measured) / np.array(true)
        variance = float(np.mean([np.trace(corner.covariance) / 3 for corner in self.corners]))
        edge = float(ratios.mean()) * size
        # The four corners decide one length: its error is about that of an edge over the square root of two.
        spread = float(ratios.std() / ratios.mean()) / 2
        return Length(f"target {self.number}", edge, size, max(variance**0.5 / edge, spread))


def find_targets(scene: Scene, family: str, progress: Progress | None = None) -> tuple[dict[int, Target], list[str]]:
    """Find coded targets in all photos and triangulate their corners.

    Args:
        scene: The scene.
        family: A name of FAMILIES.
        progress: Called with the stage and its fraction.

    Returns:
        The targets by number, and sentences about those that could not be used.

    Raises:
        InputError: If a photo cannot be read, or no target can be placed.
    """
    seen: dict[int, list[tuple[View, np.ndarray]]] = defaultdict(list)
    notes: list[str] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs = [pool.submit(_targets_of_view, view, family) for view in scene.views]
        try:
            for done, (view, job) in enumerate(zip(scene.views, jobs, strict=True), start=1):
                found, twice = job.result()
                for number, corners in found.items():
                    seen[number].append((view, corners))
                notes += [f"Target {number} appears twice in {view.name} and is not used there." for number in twice]
                if progress:
                    progress("Looking for targets", done / len(scene.views))
        finally:
            for job in jobs:
                job.cancel()
    if not seen:
        raise InputError(
            f"No target of the family {family} was found in the {len(scene.views)} photos: check the family, and that "
            "targets are at least 30 pixels wide with a white margin."
        )
    targets: dict[int, Target] = {}
    for number, views in sorted(seen.items()):
        points = [triangulate([Observation(view, pixels[i]) for view, pixels in views]) for i in range(4)]
        placed = tuple(point for point in points if point)
        if len(placed) == 4:
            targets[number] = Target(number, placed)
        elif len(views) == 1:
            notes.append(f"Target {number} was found in {views[0][0].name} alone, and two photos are needed.")
        else:
            notes.append(
                f"Target {number} was found in {len(views)} photos that do not agree where it is: it was moved, is "
                "there more than once, or they were taken from almost the same place."
            )
    if not targets:
        raise InputError(f"No target of the family {family} can be placed. {notes[0]}")
    return targets, notes


def detect(pixels: np.ndarray, family: str) -> list[tuple[int, np.ndarray]]:
    """Find coded targets in one photo.

    The photo is searched as it is, and with equalised contrast (CLAHE) for dim and hazy water.

    Args:
        pixels: The photo (H, W, 3) uint8 RGB.
        family: A name of FAMILIES.

    Returns:
        Number and corners (4, 2) float64 of each, clockwise from the top left as printed, in pixels with the centre of
        the top left one at (0.5, 0.5).
    """
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    light = (linear_of_bytes()[pixels] @ LUMINANCE).astype(np.float32)
    dictionary = _dictionary(family)
    detector = cv2.aruco.ArucoDetector(dictionary)
    equalised = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(grey)
    found: list[tuple[int, np.ndarray]] = []
    for picture in (grey, equalised):
        corners, numbers, _ = detector.detectMarkers(picture)
        for number, places in zip([] if numbers is None else numbers.ravel(), corners, strict=True):
            places = refine_corners(light, places.reshape(4, 2).astype(np.float64) + 0.5, dictionary.markerSize + 2)
            edge = np.linalg.norm(places[1] - places[0])
            if not any(n == number and np.linalg.norm(places.mean(0) - p.mean(0)) < edge for n, p in found):
                found.append((int(number), places))
    return found


def refine_corners(light: np.ndarray, corners: np.ndarray, cells: int) -> np.ndarray:
    """Find the corners of a black square on white as the intersections of lines that are fitted to its edges.

    On generated photos this is five times as exact as cv2.cornerSubPix, which a blurred corner pulls inwards. A lens
    blurs light, not display values: in these, the white margin grows into the black square, and a target of 35 pixels
    seems 1 % smaller.

    Args:
        light: The photo (H, W) in linear light, float32.
        corners: Corners (4, 2), clockwise, to about a pixel.
        cells: Cells along an edge.

    Returns:
        Corners (4, 2); those given where an edge is not found.
    """
    left, top = np.maximum(corners.min(0).astype(int) - 16, 0)
    right, bottom = corners.max(0).astype(int) + 17
    picture = light[top:bottom, left:right]
    origin = np.array([left, top])
    along = np.linspace(0.12, 0.88, 25)
    for _ in range(2):
        lines = []
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            length = float(np.linalg.norm(end - start))
            outward = np.array([end[1] - start[1], start[0] - end[0]]) / max(length, 1e-9)
            reach = min(max(0.4 * length / cells, 2.0), 12.0)  # neither the next cell nor what lies beyond the margin
            steps = np.linspace(-reach, reach, 4 * int(reach) + 5)
            places = (start + along[:, None] * (end - start))[:, None] + steps[:, None] * outward - 0.5 - origin
            x, y = np.moveaxis(places.astype(np.float32), -1, 0)
            profile = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
            rise = np.diff(profile, axis=1).clip(0)
            rise = (rise - 0.3 * rise.max(1, keepdims=True)).clip(0)  # noise and shading are left out
            weight = rise.sum(1)
            if np.count_nonzero(weight) < 10:
                return corners
            edge = (rise * (steps[1:] + steps[:-1]) / 2).sum(1) / np.maximum(weight, 1e-9)
            used = weight > 0
            used &= np.abs(edge - np.median(edge[used])) < 1.0
            if np.count_nonzero(used) < 5:
                return corners
            slope, shift = np.polyfit(along[used], edge[used], 1)
            lines.append(np.stack([start + shift * outward, end + (shift + slope) * outward]))
        corners = np.stack([_intersection(lines[i - 1], lines[i], corners[i]) for i in range(4)])
    return corners


def _intersection(first: np.ndarray, second: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Return where two lines, each through two points (2, 2), meet; `otherwise` where they are almost parallel."""
    a, b = first[1] - first[0], second[1] - second[0]
    cross = a[0] * b[1] - a[1] * b[0]
    if abs(cross) < 0.05 * np.linalg.norm(a) * np.linalg.norm(b):
        return otherwise
    between = second[0] - first[0]
    return first[0] + a * (between[0] * b[1] - between[1] * b[0]) / cross


def _targets_of_view(view: View, family: str) -> tuple[dict[int, np.ndarray], list[int]]:
    """Return the corners of each target in a photo, in pixels of its lens, and numbers that are there twice."""
    pixels, _ = read_image(view.path, (view.lens.width, view.lens.height))
    height, width = pixels.shape[:2]
    found = detect(pixels, family)
    numbers = [number for number, _ in found]
    twice = sorted({number for number in numbers if numbers.count(number) > 1})
    to_lens = np.array([view.lens.width / width, view.lens.height / height])
    return {number: corners * to_lens for number, corners in found if number not in twice}, twice


def target_lengths(
    targets: Mapping[int, Target], size: float | None, distances: Mapping[tuple[int, int], float]
) -> list[Length]:
    """Compare targets and distances between them with their true lengths.

    Args:
        targets: The targets.
        size: Length of an edge, metres; None where it is not known.
        distances: Distances between the middles of two targets, metres.

    Returns:
        One length for each target where the size is known, and one for each distance.

    Raises:
        InputError: If a target of a distance was not found.
    """
    lengths = [target.length(size) for target in targets.values()] if size else []
    for (first, second), true in distances.items():
        missing = [number for number in (first, second) if number not in targets]
        if missing:
            raise InputError(
                f"Target {missing[0]} of the distance {first},{second} cannot be used: the photos place the targets "
                f"{', '.join(map(str, targets))}."
            )
        a, b = targets[first], targets[second]
        measured = float(np.linalg.norm(a.centre - b.centre))
        variance = sum(np.trace(corner.covariance) / 3 for target in (a, b) for corner in target.corners) / 16
        lengths.append(Length(f"distance {first},{second}", measured, true, float(variance) ** 0.5 / measured))
    return lengths


def target_cells(family: str, number: int) -> np.ndarray:
    """Return the cells of a target (n, n) bool, True where black, with the black border of one cell.

    Args:
        family: A name of FAMILIES.
        number: Number in the family.

    Raises:
        InputError: If the family has no such target.
    """
    dictionary = _dictionary(family)
    count, cells = len(dictionary.bytesList), dictionary.markerSize + 2
    if not 0 <= number < count:
        raise InputError(f"The family {family} has the targets 0 to {count - 1}: there is no target {number}.")
    return cv2.aruco.generateImageMarker(dictionary, number, cells, borderBits=1) == 0


def parse_distances(texts: Sequence[str]) -> dict[tuple[int, int], float]:
    """Read distances between targets, such as "3,7=0.5".

    Raises:
        InputError: If one is not two numbers of targets and a length in metres.
    """
    distances = {}
    for text in texts:
        pair, _, length = text.partition("=")
        try:
            first, second = (int(part) for part in pair.split(","))
            metres = float(length)
        except ValueError:
            first = second = 0
            metres = 0.0
        if first == second or not 0 < metres < 1e6:
            raise InputError(f"The distance {text!r} is not of the form 3,7=0.5: two targets, and metres between them.")
        distances[first, second] = metres
    return distances


def _dictionary(family: str) -> cv2.aruco.Dictionary:
    if family not in FAMILIES:
        raise InputError(f"There is no family of targets {family!r}: use one of {', '.join(FAMILIES)}.")
    kind = family.upper().removeprefix("ARUCO_")
    name = f"ARUCO_{kind}" if kind in ("ORIGINAL", "MIP_36H12") else kind
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
