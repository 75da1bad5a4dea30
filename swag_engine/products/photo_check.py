"""Check heights with the photos of a run: a place looks alike in all of them only at its true height."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import cv2
import numpy as np

from ..base.errors import InputError
from ..formats.run_folder import RunFolder
from ..scene.cameras import Camera
from ..scene.colmap import load_scene
from ..scene.images import load_images
from ..scene.split import split_views
from .grid import MapGrid
from .map_frame import MapScene
from .tiles import Tile
from .views import camera_centre, project

MOST_PHOTOS = 12
"""Photos that a place is looked at in, the nearest ones."""
FEWEST_PIXELS = 20
"""Pixels below which photos are not compared."""
STEEPEST = 0.6
"""Least vertical part of the direction to a photo: photos from the side show other faces of what is on a map."""
WITHIN = 0.8
"""Fraction of a place that a photo must show."""
DETAIL = 3.0
"""Standard deviation of the blur that is taken away, pixels: larger patterns look alike at many heights."""
KEPT_PHOTOS = 24
"""Photos of a run that are kept in memory, 2 bytes a pixel."""


class SurveyPhotos:
    """Training photos of a run in the frame of a map.

    Args:
        scene: The run; its photos are read from its scene's folder when they are needed.

    Raises:
        InputError: If the scene of the run cannot be read.
    """

    def __init__(self, scene: MapScene) -> None:
        assert scene.run is not None
        folder, self._settings, _ = RunFolder(scene.run).read_config()
        self._scene, self._loaded = scene, load_scene(folder)
        names = set(split_views([view.camera.name for view in self._loaded.views]).train)
        self._views = [view for view in self._loaded.views if view.camera.name in names]
        self._centres = np.array([camera_centre(view.camera, scene) for view in self._views]).reshape(-1, 3)
        self._photo = lru_cache(KEPT_PHOTOS)(self._read)

    @classmethod
    def of(cls, scene: MapScene) -> "SurveyPhotos | None":
        """Return the photos of a run; None for a splat file, or where the photos' model is gone."""
        if scene.run is None:
            return None
        try:
            return cls(scene)
        except InputError:
            return None

    @property
    def cameras(self) -> list[Camera]:
        """The cameras that the run was trained with, in the scene's coordinates."""
        return [view.camera for view in self._views]

    def _read(self, number: int) -> "_Photo":
        (image,) = load_images(self._loaded, [self._views[number]], self._settings.width)
        return _Photo(image.camera, cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY), image.valid.astype(np.uint8))

    def alike(
        self, grid: MapGrid, part: Tile, mask: np.ndarray, own: np.ndarray, other: np.ndarray
    ) -> tuple[float, float] | None:
        """Compute how much alike the photos are at the heights that the run has, and at other ones.

        Args:
            grid: Pixels of the map.
            part: A part of it.
            mask: (H, W) bool, the place in that part.
            own: (H, W) heights that the run has, NaN where nothing was seen.
            other: (H, W) other heights, likewise.

        Returns:
            Mean correlations between the photos, -1..1; None where too few of them show the place.
        """
        mask = mask & np.isfinite(own) & np.isfinite(other)
        if not mask.any():
            return None
        left, top = grid.left + grid.pixel * part.column, grid.top - grid.pixel * part.row
        pixels = MapGrid(left, top, grid.pixel, part.width, part.height)
        places, moved = pixels.places(own), pixels.places(other)
        chosen = self._nearest(places[mask])
        if len(chosen) < 2:
            return None
        try:
            photos = [self._photo(number) for number in chosen]
        except InputError:
            return None
        distances = np.linalg.norm(self._centres[chosen] - places[mask].mean(axis=0), axis=1)
        sizes = [distance / photo.camera.fx for photo, distance in zip(photos, distances, strict=True)]
        # Pixels of the map that are finer than those of the photos are skipped, photos finer than the map are reduced.
        step = max(1, round(float(np.median(sizes)) / grid.pixel))
        every = slice(None, None, step), slice(None, None, step)
        mask, places, moved = mask[every], places[every], moved[every]
        if mask.sum() < FEWEST_PIXELS:
            return None
        at_own, at_other = (
            _mean_correlation(
                [
                    photo.reduced(int(grid.pixel * step / size)).details(self._scene, mask, at)
                    for photo, size in zip(photos, sizes, strict=True)
                ]
            )
            for at in (places, moved)
        )
        return at_own, at_other

    def _nearest(self, places: np.ndarray) -> list[int]:
        """Return the numbers of the nearest photos that show places (N, 3) from above."""
        some = places[:: max(1, len(places) // 200)]
        towards = self._centres - some.mean(axis=0)
        distances = np.linalg.norm(towards, axis=1)
        found: list[int] = []
        for number in np.argsort(distances).tolist():
            if len(found) == MOST_PHOTOS:
                break
            if towards[number, 2] < STEEPEST * distances[number]:
                continue
            seen = np.isfinite(project(self._views[number].camera, self._scene, some)[:, 0])
            if seen.mean() >= WITHIN:
                found.append(number)
        return found


@dataclass(frozen=True, eq=False)
class _Photo:
    """A photo: grey values (H, W) and validity (H, W), 0 or 1, both uint8."""

    camera: Camera
    grey: np.ndarray
    valid: np.ndarray

    def reduced(self, factor: int) -> "_Photo":
        """Return the photo at 1/factor of its size; the same up to 1."""
        if factor <= 1:
            return self
        camera = self.camera.resized(max(1, self.camera.width // factor))
        size = camera.width, camera.height
        return _Photo(camera, *(cv2.resize(of, size, interpolation=cv2.INTER_AREA) for of in (self.grey, self.valid)))

    def details(self, scene: MapScene, mask: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return the fine pattern (H, W) that it shows at places (H, W, 3); NaN outside the mask and the photo."""
        pixels = project(self.camera, scene, places.reshape(-1, 3)).reshape(*mask.shape, 2)
        inside = np.isfinite(pixels[..., 0])
        x, y = (np.where(inside, pixels[..., axis] - 0.5, -1).astype(np.float32) for axis in (0, 1))
        shown = cv2.remap(self.grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
        valid = cv2.remap(self.valid, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        weight = (valid * inside).astype(np.float32)
        blurred, weights = (cv2.GaussianBlur(of, (0, 0), DETAIL) for of in (shown * weight, weight))
        return np.where(mask & (weight > 0.5), shown - blurred / np.maximum(weights, 1e-3), np.nan)


def _mean_correlation(patterns: Sequence[np.ndarray]) -> float:
    """Return the mean correlation of all pairs of patterns (H, W), where both are known; -1 without such a pair."""
    found = []
    for first, second in combinations(patterns, 2):
        both = np.isfinite(first) & np.isfinite(second)
        if both.sum() >= FEWEST_PIXELS:
            a, b = (of[both] - of[both].mean() for of in (first, second))
            found.append(float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-9)))
    return float(np.mean(found)) if found else -1.0
