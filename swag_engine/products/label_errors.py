"""Errors of areas: from what held-out images say of the labels, and from the scale."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..formats.ply import read_ply
from ..formats.run_folder import RunFolder
from ..formats.select import LABEL
from ..gaussians.cloud import GaussianCloud
from ..scene.colmap import load_scene
from ..scene.images import load_images
from ..scene.split import split_views
from ..semantics.assign import render_labels
from ..semantics.masks import MaskFolder

ROUNDS = 1000
"""Resamples of the bootstrap."""
WIDTH = 400
"""Width of the held-out images, pixels."""
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


def held_out_confusion(folder: Path, masks: Path | None, names: dict[int, str]) -> np.ndarray:
    """Compare rendered labels with the masks of test images, which the labels of the splats were not made from.

    Args:
        folder: Folder of the run.
        masks: Folder of masks as the command label takes them; the folder `labels` of the scene without it.
        names: Names of the labels by number.

    Returns:
        (V, L + 1, L + 1) pixels by view, label in the rendering and label in the mask, 0 for none. Without masks of
        test images V is 0.

    Raises:
        InputError: If the masks or the scene cannot be read.
    """
    run = RunFolder(folder)
    scene_folder, _, _ = run.read_config()
    count = max(names, default=0)
    none = np.zeros((0, count + 1, count + 1))
    if masks is None:
        masks = scene_folder / "labels"
        if not masks.is_dir():
            return none
    scene = load_scene(scene_folder)
    provider = MaskFolder(masks, scene)
    test = set(split_views([view.camera.name for view in scene.views]).test)
    images = load_images(scene, [view for view in scene.views if view.camera.name in test], WIDTH)
    splats = read_ply(run.ply)
    cloud, labels = GaussianCloud.from_splats(splats, (0.5, 0.5, 0.5)), torch.from_numpy(splats.extras[LABEL]).long()
    numbers = {name: number for number, name in names.items()}
    tables = []
    for image in images:
        truth = np.zeros((image.camera.height, image.camera.width), np.int64)
        regions = provider.regions(image, ())
        for region in reversed(regions):
            truth[region.mask] = numbers.get(region.label, 0)
        if regions:
            seen = render_labels(cloud, labels, count, image.camera).astype(np.int64)
            table = np.bincount((seen * (count + 1) + truth).ravel(), minlength=(count + 1) ** 2)
            tables.append(table.reshape(count + 1, count + 1).astype(np.float64))
    return np.stack(tables) if tables else none


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
