"""Gains of labels: factors on their coverage with which a map of labels has the areas of the regions of the images."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from ..gaussians.cloud import GaussianCloud
from ..rasterize.api import rasterize
from ..scene.cameras import Camera
from .regions import SceneRegions

MAX_GAIN = 4.0
"""Largest gain of a label, and the inverse of the smallest: regions that disagree between images must not move borders
without limit. Gains of the surveys of benchmarks/products.py are 0.5 to 1.9."""
ROUNDS = 10
"""Rounds over the labels, whose gains are found one after another."""
MOST_PIXELS = 2_000_000
"""Largest number of pixels of all images that gains are found from, about."""
LABELS_PER_PASS = 16
"""Labels that one pass over an image renders."""


@torch.no_grad()
def label_gains(
    cloud: GaussianCloud,
    labels: Tensor,
    regions: SceneRegions,
    cameras: Mapping[str, Camera],
    behind: int = 0,
    backend: str = "auto",
) -> np.ndarray:
    """Find the gains with which rendered labels have as many pixels as the regions of the images.

    A pixel of a map has the label with the largest coverage. Where the Gaussians of one label are more transparent
    than those of another, or reach farther over the border, the border is displaced. Coverages are therefore multiplied
    by gains, as outputs of a classifier are multiplied by ratios of class frequencies when these are known (Saerens et
    al. 2002, Neural Computation 14).

    Args:
        cloud: N Gaussians.
        labels: (N,) int64 labels of the Gaussians, 0 for none.
        regions: Regions of the images.
        cameras: Camera of each image, by the image's name.
        behind: Label of what no Gaussian covers, 0 for none.
        backend: What computes.

    Returns:
        (L + 1,) float64 gains from 1 / MAX_GAIN to MAX_GAIN, as `matching_gains` finds them.
    """
    count = len(regions.labels)
    step = max(1, sum(image_labels.size for image_labels in regions.maps.values()) // MOST_PIXELS)
    wanted, undecided = np.zeros(count + 1, np.int64), [np.zeros((0, count + 1), np.float32)]
    for name, image_labels in regions.maps.items():
        own = image_labels.reshape(-1)
        chosen = np.flatnonzero(own)[::step]
        coverage = label_coverage(
            cloud, labels, count, cameras[name].resized(image_labels.shape[1]), chosen, behind, backend
        )
        first, second = np.partition(coverage, [-2, -1], axis=1)[:, [-1, -2]].T
        seen, unsure = first > 0, second * MAX_GAIN**2 > first
        wanted += np.bincount(own[chosen[seen]], minlength=count + 1)
        # No gains change the label of these pixels: memory is that of the borders alone.
        wanted -= np.bincount(coverage[seen & ~unsure].argmax(1), minlength=count + 1)
        undecided.append(coverage[seen & unsure])
    return matching_gains(np.concatenate(undecided), wanted)


def matching_gains(coverage: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Find gains with which each label has the largest coverage in a given number of pixels.

    They are found one after another: with those of the others fixed, a label has n pixels if its gain is the n-th
    smallest ratio of the largest other coverage to its own.

    Args:
        coverage: (K, L + 1) of each pixel by each label, label 0 first.
        wanted: (L + 1,) number of pixels of each label.

    Returns:
        (L + 1,) from 1 / MAX_GAIN to MAX_GAIN; 1 for label 0, the label with the most coverage, and labels without any.
    """
    gains = np.ones(coverage.shape[1])
    sums = coverage.sum(axis=0)
    order = np.argsort(-sums[1:], kind="stable")[1:] + 1
    scaled = coverage.copy()
    for _ in range(ROUNDS):
        for label in order[sums[order] > 0]:
            scaled[:, label] = 0
            own = coverage[:, label]
            ratios = np.divide(scaled.max(axis=1), own, out=np.full(len(own), np.inf, np.float32), where=own > 0)
            n = min(max(int(wanted[label]), 0), len(ratios) - 1)
            gains[label] = np.clip(np.partition(ratios, n)[n], 1 / MAX_GAIN, MAX_GAIN)
            scaled[:, label] = gains[label] * own
    return gains


@torch.no_grad()
def label_coverage(
    cloud: GaussianCloud,
    labels: Tensor,
    count: int,
    camera: Camera,
    chosen: np.ndarray,
    behind: int = 0,
    backend: str = "auto",
) -> np.ndarray:
    """Render how much each label covers of pixels of a view.

    Args:
        cloud: N Gaussians.
        labels: (N,) int64 labels of the Gaussians, 0 for none.
        count: Number of labels.
        camera: The view.
        chosen: (K,) indices of pixels, row by row.
        behind: Label of what no Gaussian covers, 0 for none.
        backend: What computes.

    Returns:
        (K, count + 1) float32, from 0 to 1, label 0 first.
    """
    viewmat, intrinsics = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
    found = np.zeros((len(chosen), count + 1), np.float32)
    for start in range(0, count + 1, LABELS_PER_PASS):
        some = torch.arange(start, min(start + LABELS_PER_PASS, count + 1), device=labels.device)
        values = (labels[:, None] == some).to(cloud.means)
        drawn = rasterize(
            cloud.means, cloud.quats, cloud.scales, cloud.opacities, values, viewmat, intrinsics, camera.width,
            camera.height, cloud.means.new_zeros(len(some)), backend,
        )  # fmt: skip
        found[:, start : start + len(some)] = drawn.channels.reshape(-1, len(some)).cpu().numpy()[chosen]
        if start <= behind < start + len(some) and behind:
            found[:, behind] += 1 - drawn.alpha.reshape(-1).cpu().numpy()[chosen]
    return found
