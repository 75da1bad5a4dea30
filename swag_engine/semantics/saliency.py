"""Regions without words and without a network: open water, what stands out, and the rest."""

from collections.abc import Sequence

import cv2
import numpy as np

from ..base.errors import InputError
from ..scene.images import TrainingImage
from .regions import Region

OPEN_WATER = "open water"
SIDE = 320
"""Photographs are looked at with this longer side: what counts here is larger than a few pixels."""
CELL = 10
"""Side of a superpixel in these pixels."""
SMOOTH = 1.6
"""Median step of L*a*b* from pixel to pixel that water stays below, at this size."""
ALIKE = 7.0
"""Difference of colour of neighbouring superpixels that are one stretch of water."""


class Saliency:
    """Open water, the salient object, and the rest of a photograph, by OpenCV alone.

    Superpixels (SLIC, Achanta et al. 2012). Open water: the smooth ones that reach the upper border over others like
    them. Salient: what differs in colour from the picture's border (as in Zhu et al. 2014) and is found so by the
    spectral residual (Hou and Zhang 2007); its outline follows the photograph by a guided filter (He et al. 2010).
    """

    name = "saliency"
    key = "saliency:1"

    def regions(self, image: TrainingImage, words: Sequence[str]) -> list[Region]:
        """As in RegionProvider; regions have no names but `open water`. Raises InputError for words: it knows none."""
        if words:
            raise InputError(
                "saliency finds what stands out, not words: give masks, fetch grounded-sam, or leave the words out."
            )
        small = small_copy(image.pixels)
        water = open_water(small)
        salient = saliency(small) * ~water
        threshold = cv2.threshold((salient * 255).astype(np.uint8)[~water][None], 0, 255, cv2.THRESH_OTSU)[0] / 255
        parts = [(water, OPEN_WATER), ((salient > threshold) & ~water, ""), ((salient <= threshold) & ~water, "")]
        guide = image.pixels.astype(np.float32) / 255
        shares = [_outlined(mask, guide) for mask, _ in parts]
        best = np.argmax(shares, axis=0)
        return [Region(best == number, name) for number, (_, name) in enumerate(parts)]


def small_copy(pixels: np.ndarray) -> np.ndarray:
    """An image (H, W, 3) uint8 at SIDE, as the functions below take it."""
    height, width = pixels.shape[:2]
    size = [max(4 * CELL, round(SIDE * length / max(height, width))) for length in (width, height)]
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def open_water(pixels: np.ndarray) -> np.ndarray:
    """(H, W) bool: where an image (H, W, 3) uint8 sRGB of SIDE shows water and nothing else."""
    lab = cv2.cvtColor(cv2.GaussianBlur(pixels, (0, 0), 1.0).astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
    step = np.hypot(*(np.linalg.norm(np.diff(np.pad(lab, pad, mode="edge"), axis=axis), axis=2)
                      for axis, pad in ((0, ((1, 0), (0, 0), (0, 0))), (1, ((0, 0), (1, 0), (0, 0))))))  # fmt: skip
    cells = _superpixels(pixels)
    count = cells.max() + 1
    sizes = np.maximum(np.bincount(cells.ravel(), minlength=count), 1)  # SLIC leaves some empty
    colour = np.stack([np.bincount(cells.ravel(), lab[..., i].ravel(), count) / sizes for i in range(3)], 1)
    rough = np.bincount(cells.ravel(), step.ravel(), count) / sizes
    neighbours = np.unique(
        np.concatenate([
            np.stack([cells[:, :-1].ravel(), cells[:, 1:].ravel()], 1),
            np.stack([cells[:-1].ravel(), cells[1:].ravel()], 1),
        ]),
        axis=0,
    )  # fmt: skip
    smooth = rough < SMOOTH
    a, b = neighbours.T
    joined = smooth[a] & smooth[b] & (np.linalg.norm(colour[a] - colour[b], axis=1) < ALIKE)
    reached = np.zeros(count, bool)
    reached[np.unique(cells[0])] = True
    reached &= smooth
    while True:
        more = reached.copy()
        more[b[joined & reached[a]]] = True
        more[a[joined & reached[b]]] = True
        if (more == reached).all():
            return reached[cells]
        reached = more


def saliency(pixels: np.ndarray) -> np.ndarray:
    """(H, W) float32 in 0..1: how much each place of an image (H, W, 3) uint8 sRGB stands out."""
    lab = cv2.cvtColor(pixels.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
    cells = _superpixels(pixels)
    count = cells.max() + 1
    sizes = np.maximum(np.bincount(cells.ravel(), minlength=count), 1)  # SLIC leaves some empty
    colour = np.stack([np.bincount(cells.ravel(), lab[..., i].ravel(), count) / sizes for i in range(3)], 1)
    border = np.unique(np.concatenate([cells[0], cells[:, 0], cells[:, -1]]))
    # The nearest tenth of the border: one object that touches it must not hide itself.
    distances = np.linalg.norm(colour[:, None] - colour[None, border], axis=2)
    contrast = np.sort(distances, axis=1)[:, : max(1, len(border) // 4)].mean(1)[cells]
    residual = cv2.saliency.StaticSaliencySpectralResidual.create().computeSaliency(pixels)[1]
    residual = cv2.GaussianBlur(residual, (0, 0), CELL)
    found = _spread(contrast) * (0.5 + 0.5 * _spread(residual))
    return _spread(cv2.GaussianBlur(found.astype(np.float32), (0, 0), CELL / 3))


def _superpixels(pixels: np.ndarray) -> np.ndarray:
    slic = cv2.ximgproc.createSuperpixelSLIC(
        cv2.cvtColor(pixels, cv2.COLOR_RGB2Lab), cv2.ximgproc.SLICO, region_size=CELL
    )
    slic.iterate(5)
    return np.asarray(slic.getLabels())


def _spread(values: np.ndarray) -> np.ndarray:
    low, high = np.percentile(values, [1, 99])
    return np.asarray(((values - low) / max(high - low, 1e-9)).clip(0, 1), np.float32)


def _outlined(mask: np.ndarray, guide: np.ndarray) -> np.ndarray:
    """A mask at the size of the photograph, guide (H, W, 3) float32, whose edges it follows: (H, W) float32."""
    height, width = guide.shape[:2]
    large = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.ximgproc.guidedFilter(guide, large, max(4, width // 80), 1e-4))
