"""Errors of areas: from what held-out images say of the labels, and from the scale."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

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

WIDTH = 1000
"""Largest width of the held-out images, pixels."""
SAMPLE = 250_000
"""Largest number of pixels of a map that are compared, about."""
UPPER = 0.975
"""Quantile of the upper end of a 95 % interval."""


@dataclass(frozen=True, eq=False)
class AreaErrors:
    """Areas corrected for confused labels, and intervals of 95 %, in pixels of the map.

    Attributes:
        corrected: (L + 1,) areas as the held-out images say; those of the map for labels that none of them shows.
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

    An error h of the height displaces the mask of a ray at the angle a to the vertical by h tan(a), and things that
    stand up seem larger. With an error of the place as large as that of the height, the variance of the displacement
    grows with 1 + tan(a)^2; pixels have the inverse of it as weight, cos(a)^2.

    Args:
        scene: What the map shows.
        masks: Folder of masks as the command label takes them; the folder `labels` of the scene without it.
        labels: The label map.
        heights: The heights of its pixels.
        grid: Its pixels.

    Returns:
        (V, L + 1, L + 1) weights of pixels by view, label in the map and label in the mask, 0 for none. Without masks
        of test images V is 0.

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
        centre = camera_centre(image.camera, scene)
        free = visible(centre, coarse, surface) & (mapped != NO_LABEL)
        places = coarse.places(surface)[free]
        pixels = project(image.camera, scene, places)
        inside = np.isfinite(pixels[:, 0])
        u, v = pixels[inside].astype(np.int64).T
        rays = places[inside] - centre
        weights = rays[:, 2] ** 2 / (rays * rays).sum(axis=1)
        pairs = mapped[free][inside].astype(np.int64) * (count + 1) + truth[v, u]
        tables.append(np.bincount(pairs, weights, (count + 1) ** 2).reshape(count + 1, count + 1))
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


def area_errors(pixels: np.ndarray, confusion: np.ndarray, scale_error: float | None) -> AreaErrors:
    """Correct areas by held-out images, and find their intervals from the disagreement of images and from the scale.

    A label has m_v pixels in the part of the map that image v sees, and t_v in the mask of the image. The ratio
    estimator (Cochran 1977, Sampling Techniques) of its relative error is d = sum(t_v - m_v) / sum(m_v). Images, not
    pixels, are independent: the variance of d, were the map right, is s^2 = sum((t_v - m_v)^2) / sum(m_v)^2. The
    correction is d shrunk to max(0, 1 - s^2 / d^2) d (James and Stein 1961), so that it is 0 unless images agree about
    it. The interval is that of Student's t for the effective number of images, sum(m_v)^2 / sum(m_v^2) (Kish 1965). An
    area grows with the square of the scale.

    Args:
        pixels: (L + 1,) pixels of each label in the map.
        confusion: (V, L + 1, L + 1) as `held_out_confusion` returns it.
        scale_error: Relative standard error of the scale, None where it is not known.
    """
    mapped, difference = confusion.sum(axis=2), confusion.sum(axis=1) - confusion.sum(axis=2)
    total = mapped.sum(axis=0)
    seen = total > 0
    total = np.where(seen, total, 1.0)
    error = np.where(seen, difference.sum(axis=0) / total, 0.0)
    variance = np.where(seen, (difference**2).sum(axis=0) / total**2, 0.0)
    views = np.where(seen, total**2 / np.where(seen, (mapped**2).sum(axis=0), 1.0), 1.0)
    shrunk = error * np.clip(1 - variance / np.where(error == 0, 1.0, error**2), 0, 1)
    by_labels = stdtrit(views, UPPER) * np.sqrt(variance)
    by_scale = stdtrit(np.inf, UPPER) * 2 * (scale_error or 0.0)
    half = np.hypot(by_labels, by_scale)
    cover = pixels / max(float(pixels.sum()), 1.0)
    return AreaErrors(
        pixels * (1 + shrunk),
        pixels * np.maximum(1 + shrunk - half, 0),
        pixels * (1 + shrunk + half),
        cover * np.maximum(1 + shrunk - by_labels, 0),
        np.minimum(cover * (1 + shrunk + by_labels), 1),
    )
