"""Errors of areas: from what held-out images say of the labels, and from the scale."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..formats.run_folder import RunFolder
from ..scene.colmap import load_scene
from ..scene.images import load_images
from ..scene.split import split_views
from ..semantics.masks import MaskFolder
from .dem import read_heights
from .geotiff import NO_LABEL, read_map
from .grid import MapGrid
from .map_frame import MapScene
from .tiles import TILE, tiles_of
from .views import camera_centre, project, visible

ROUNDS = 1000
"""Resamples of the bootstrap."""
WIDTH = 1000
"""Largest width of the held-out images, pixels."""
SAMPLE = 250_000
"""Largest number of pixels of a map that are compared, about."""
INTERVAL = (2.5, 97.5)
"""Percentiles of the interval: 95 %."""


@dataclass(frozen=True, eq=False)
class AreaErrors:
    """Areas corrected for confused labels, and intervals of 95 %, in pixels of the map.

    Attributes:
        corrected: (L + 1,) areas as the confusion says; those of the map where no images were held out.
        low: (L + 1,) lower ends, with the error of the scale.
        high: (L + 1,) upper ends.
        cover_low: (L + 1,) lower ends of the fraction of all that was seen; the scale does not matter.
        cover_high: (L + 1,) upper ends.
    """

    corrected: np.ndarray
    low: np.ndarray
    high: np.ndarray
    cover_low: np.ndarray
    cover_high: np.ndarray


def held_out_confusion(scene: MapScene, masks: Path | None, labels: Path, heights: Path, grid: MapGrid) -> np.ndarray:
    """Compare a label map with the masks of test images, which the labels of the splats were not made from.

    Pixels of the map are counted and not those of the images, so that each stands for the same area, and an image that
    is rendered badly from its own place does not count as wrong labels. Pixels that the surface may hide from an image
    are left out.

    Args:
        scene: What the map shows.
        masks: Folder of masks as the command label takes them; the folder `labels` of the scene without it.
        labels: The label map.
        heights: The heights of its pixels.
        grid: Its pixels.

    Returns:
        (V, L + 1, L + 1) pixels by view, label in the map and label in the mask, 0 for none. Without masks of test
        images V is 0.

    Raises:
        InputError: If the masks or the scene cannot be read.
    """
    mapped, surface, coarse = _reduced(scene, labels, heights, grid)
    count = max([*scene.labels, int(mapped[mapped != NO_LABEL].max(initial=0))])
    none = np.zeros((0, count + 1, count + 1))
    if scene.run is None:
        return none
    scene_folder, _, _ = RunFolder(scene.run).read_config()
    if masks is None:
        masks = scene_folder / "labels"
        if not masks.is_dir():
            return none
    photos = load_scene(scene_folder)
    provider = MaskFolder(masks, photos)
    test = set(split_views([view.camera.name for view in photos.views]).test)
    numbers = {name: number for number, name in scene.labels.items()}
    tables = []
    for image in load_images(photos, [view for view in photos.views if view.camera.name in test], WIDTH):
        regions = provider.regions(image, ())
        if not regions:
            continue
        truth = np.zeros((image.camera.height, image.camera.width), np.int64)
        for region in reversed(regions):
            truth[region.mask] = numbers.get(region.label, 0)
        free = visible(camera_centre(image.camera, scene), coarse, surface) & (mapped != NO_LABEL)
        pixels = project(image.camera, scene, coarse.places(surface)[free])
        inside = np.isfinite(pixels[:, 0])
        u, v = pixels[inside].astype(np.int64).T
        pairs = mapped[free][inside].astype(np.int64) * (count + 1) + truth[v, u]
        table = np.bincount(pairs, minlength=(count + 1) ** 2).reshape(count + 1, count + 1)
        tables.append(table.astype(np.float64))
    return np.stack(tables) if tables else none


def _reduced(scene: MapScene, labels: Path, heights: Path, grid: MapGrid) -> tuple[np.ndarray, np.ndarray, MapGrid]:
    """Read a label map and its heights, the placement taken off, with about SAMPLE pixels or fewer, and their grid."""
    step = max(1, int(np.ceil(np.sqrt(grid.width * grid.height / SAMPLE))))
    shape = -(-grid.height // step), -(-grid.width // step)
    mapped, surface = np.full(shape, NO_LABEL, np.uint8), np.full(shape, np.nan)
    offset = scene.placement.offset[2] if scene.placement else 0.0
    for tile in tiles_of(grid, max(1, TILE // step) * step):
        part = read_map(labels, tile).values[::step, ::step]
        row, column = tile.row // step, tile.column // step
        place = slice(row, row + part.shape[0]), slice(column, column + part.shape[1])
        mapped[place], surface[place] = part, read_heights(heights, tile=tile)[::step, ::step] - offset
    # The kept pixels are the first of each step: half a step is taken off so that their middles stay.
    shift = grid.pixel * (step - 1) / 2
    return mapped, surface, MapGrid(grid.left - shift, grid.top + shift, step * grid.pixel, shape[1], shape[0])


def area_errors(pixels: np.ndarray, confusion: np.ndarray, scale_error: float | None, seed: int = 0) -> AreaErrors:
    """Correct areas by a confusion matrix, and find their intervals by a bootstrap over views and over the scale.

    The area with label j is sum_i pixels_i P(true j | mapped i) (Olofsson et al. 2014, Remote Sensing of Environment
    148), with P from resampled views; an area grows with the square of the scale.

    Args:
        pixels: (L + 1,) pixels of each label in the map.
        confusion: (V, L + 1, L + 1) as `held_out_confusion` returns it.
        scale_error: Relative standard error of the scale, None where it is not known.
        seed: Of the random numbers.
    """
    random = np.random.default_rng(seed)
    views = len(confusion)
    samples = np.repeat(pixels[None].astype(np.float64), ROUNDS, axis=0)
    corrected = pixels.astype(np.float64)
    if views:
        corrected = _corrected(pixels, confusion.sum(axis=0))
        for i in range(ROUNDS):
            samples[i] = _corrected(pixels, confusion[random.integers(0, views, views)].sum(axis=0))
    total = max(float(pixels.sum()), 1.0)
    cover_low, cover_high = np.percentile(samples / total, INTERVAL, axis=0)
    samples *= (1 + (scale_error or 0.0) * random.standard_normal(ROUNDS)[:, None]) ** 2
    low, high = np.percentile(samples, INTERVAL, axis=0)
    return AreaErrors(corrected, low, high, cover_low, cover_high)


def _corrected(pixels: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Areas by true label; a label that no view shows stays as it is."""
    counts = table.sum(axis=1, keepdims=True)
    probabilities = np.where(counts > 0, table / np.maximum(counts, 1), np.eye(len(table)))
    return pixels @ probabilities
