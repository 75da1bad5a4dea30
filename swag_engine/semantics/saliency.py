"""Regions without words and without a network: open water, the salient object, and the rest."""

from collections.abc import Sequence

import cv2
import numpy as np

from ..base.errors import InputError
from ..scene.images import TrainingImage
from .regions import Region

OPEN_WATER = "open water"
"""Label of water without anything in front."""
SIDE = 320
"""Pixels of the longer side at which images are analysed; the regions are much larger than a pixel."""
CELL = 10
"""Side of a superpixel at that size, pixels."""
MAX_STEP = 1.6
"""Mean difference of L*a*b* between neighbouring pixels below which a superpixel is smooth, at that size."""
MAX_DIFFERENCE = 7.0
"""Difference of mean L*a*b* below which neighbouring smooth superpixels are connected water."""
BORDER_DIVISOR = 4
"""Contrast is the mean difference from a quarter (1 / BORDER_DIVISOR) of the border's superpixels, the most similar
ones: not from fewer, so that an object that touches the border keeps its contrast."""


class Saliency:
    """Provider of open water, the salient object, and the rest, by OpenCV alone.

    The image is divided into superpixels (SLIC, Achanta et al. 2012). Open water: smooth superpixels connected to the
    upper border. Salient: superpixels that differ in color from the image border (as in Zhu et al. 2014) where the
    spectral residual (Hou and Zhang 2007) is large too. Masks are aligned to the edges of the image by a guided filter
    (He et al. 2010).
    """

    name = "saliency"
    key = "saliency:1"

    def regions(self, image: TrainingImage, words: Sequence[str]) -> list[Region]:
        """Find regions as in RegionProvider; only `open water` has a label. Raises InputError for words."""
        if words:
            raise InputError("saliency cannot look for words: give masks, download grounded-sam, or give no words.")
        small = resize_for_saliency(image.pixels)
        water = open_water(small)
        salient = saliency(small) * ~water
        threshold = cv2.threshold((salient * 255).astype(np.uint8)[~water][None], 0, 255, cv2.THRESH_OTSU)[0] / 255
        parts = [(water, OPEN_WATER), ((salient > threshold) & ~water, ""), ((salient <= threshold) & ~water, "")]
        guide = image.pixels.astype(np.float32) / 255
        refined = [_refined(mask, guide) for mask, _ in parts]
        best = np.argmax(refined, axis=0)
        return [Region(best == number, name) for number, (_, name) in enumerate(parts)]


def resize_for_saliency(pixels: np.ndarray) -> np.ndarray:
    """Resize an image (H, W, 3) uint8 to a longer side of SIDE, as `open_water` and `saliency` take it."""
    height, width = pixels.shape[:2]
    size = [max(4 * CELL, round(SIDE * length / max(height, width))) for length in (width, height)]
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def open_water(pixels: np.ndarray) -> np.ndarray:
    """Find open water.

    Args:
        pixels: (H, W, 3) uint8 sRGB with a longer side of SIDE.

    Returns:
        (H, W) bool, where the image shows water and nothing else.
    """
    lab = cv2.cvtColor(cv2.GaussianBlur(pixels, (0, 0), 1.0).astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
    step = np.hypot(*(np.linalg.norm(np.diff(np.pad(lab, pad, mode="edge"), axis=axis), axis=2)
                      for axis, pad in ((0, ((1, 0), (0, 0), (0, 0))), (1, ((0, 0), (1, 0), (0, 0))))))  # fmt: skip
    cells = _superpixels(pixels)
    count = cells.max() + 1
    sizes = np.maximum(np.bincount(cells.ravel(), minlength=count), 1)  # SLIC leaves some empty
    color = np.stack([np.bincount(cells.ravel(), lab[..., i].ravel(), count) / sizes for i in range(3)], 1)
    mean_step = np.bincount(cells.ravel(), step.ravel(), count) / sizes
    neighbours = np.unique(
        np.concatenate([
            np.stack([cells[:, :-1].ravel(), cells[:, 1:].ravel()], 1),
            np.stack([cells[:-1].ravel(), cells[1:].ravel()], 1),
        ]),
        axis=0,
    )  # fmt: skip
    smooth = mean_step < MAX_STEP
    a, b = neighbours.T
    joined = smooth[a] & smooth[b] & (np.linalg.norm(color[a] - color[b], axis=1) < MAX_DIFFERENCE)
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
    """Measure how much each pixel stands out.

    Args:
        pixels: (H, W, 3) uint8 sRGB with a longer side of SIDE.

    Returns:
        Saliency (H, W) float32, 0..1.
    """
    lab = cv2.cvtColor(pixels.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
    cells = _superpixels(pixels)
    count = cells.max() + 1
    sizes = np.maximum(np.bincount(cells.ravel(), minlength=count), 1)  # SLIC leaves some empty
    color = np.stack([np.bincount(cells.ravel(), lab[..., i].ravel(), count) / sizes for i in range(3)], 1)
    border = np.unique(np.concatenate([cells[0], cells[:, 0], cells[:, -1]]))
    contrast = border_contrast(color, color[border])[cells]
    residual = cv2.saliency.StaticSaliencySpectralResidual.create().computeSaliency(pixels)[1]
    residual = cv2.GaussianBlur(residual, (0, 0), CELL)
    found = _stretched(contrast) * (0.5 + 0.5 * _stretched(residual))
    return _stretched(cv2.GaussianBlur(found.astype(np.float32), (0, 0), CELL / 3))


def border_contrast(colors: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Measure how much superpixels differ from the image border.

    Args:
        colors: (S, 3) mean L*a*b* of the superpixels.
        border: (B, 3) mean L*a*b* of those at the left, upper and right border.

    Returns:
        (S,), mean difference of color from the most similar quarter of the border (at least one superpixel).
    """
    distances = np.linalg.norm(colors[:, None] - border[None], axis=2)
    return np.asarray(np.sort(distances, axis=1)[:, : max(1, len(border) // BORDER_DIVISOR)].mean(1))


def _superpixels(pixels: np.ndarray) -> np.ndarray:
    """Return the number (H, W) of each pixel's superpixel."""
    slic = cv2.ximgproc.createSuperpixelSLIC(
        cv2.cvtColor(pixels, cv2.COLOR_RGB2Lab), cv2.ximgproc.SLICO, region_size=CELL
    )
    slic.iterate(5)
    return np.asarray(slic.getLabels())


def _stretched(values: np.ndarray) -> np.ndarray:
    """Return values with their 1st percentile at 0 and their 99th at 1, clipped."""
    low, high = np.percentile(values, [1, 99])
    return np.asarray(((values - low) / max(high - low, 1e-9)).clip(0, 1), np.float32)


def _refined(mask: np.ndarray, guide: np.ndarray) -> np.ndarray:
    """Return a mask at the size of an image, guide (H, W, 3) float32, aligned to its edges: (H, W) float32."""
    height, width = guide.shape[:2]
    large = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.ximgproc.guidedFilter(guide, large, max(4, width // 80), 1e-4))
