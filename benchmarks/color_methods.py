"""Methods of restoring underwater colors in single images, that restored colors are compared with.

All take and return display values (H, W, 3) in 0..1. Only `best_gain` and `true_water` know the truth.
"""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares, minimize

from swag_engine.base.color_difference import delta_e_2000, lab
from swag_engine.base.transfer import LUMINANCE, linear_to_srgb, srgb_to_linear

CLIP_LIMIT = 2.0
"""Of CLAHE, in mean counts of a histogram's bin."""
TILES = (8, 8)
"""Of CLAHE, across and down."""
BINS = 10
"""Of range, in each of which the darkest pixels are taken for backscatter (Akkaynak and Treibitz 2019)."""
DARKEST = 0.01
"""Fraction of a bin's pixels that is."""
NEIGHBOURS = 0.1
"""Largest difference of range between pixels that share an illuminant, as a fraction of the largest range."""
SPREAD = 0.02
"""Weight p of a pixel's own color in the local space average color."""
SWEEPS = 200
"""Of that average."""
ILLUMINANT = 2.0
"""Illuminant over local space average color: surfaces reflect half of the light on average."""
BRIGHT_QUANTILE = 0.98
"""Quantile of luminance that the exposure of Sea-thru is measured at; the publication leaves exposure to the camera."""
BRIGHT_LIGHT = 0.8
"""Linear light that it becomes, as in the automatic development of runs."""
MOST_GAIN = 16.0
"""Largest gain of the grey world in Sea-thru."""
GREY_CHROMA = 10.0
"""Chroma of CIE L*a*b* from which a true color has a hue."""
FITTED = 4000
"""Pixels that the best gain is found from, at most."""


def grey_world(image: np.ndarray) -> np.ndarray:
    """Give red, green and blue the same mean, in display values as programs for photos do."""
    means = image.reshape(-1, 3).mean(axis=0)
    return np.clip(image * (means.mean() / np.maximum(means, 1e-6)), 0, 1)


def clahe(image: np.ndarray) -> np.ndarray:
    """Equalize the histogram of lightness locally, with limited contrast (Zuiderveld 1994)."""
    values = cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2LAB)
    lightness = (values[..., 0] / 100 * 65535).round().clip(0, 65535).astype(np.uint16)
    even = cv2.createCLAHE(CLIP_LIMIT, TILES).apply(lightness)
    values[..., 0] = even.astype(np.float32) * (100 / 65535)
    return cv2.cvtColor(values, cv2.COLOR_LAB2RGB).clip(0, 1)


def best_gain(image: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Multiply linear red, green and blue by the three gains that bring the image nearest to the truth.

    Args:
        image: The image.
        truth: The true image.
        valid: (H, W) bool, pixels to compare.

    Returns:
        The image of least mean delta E 2000.
    """
    light = srgb_to_linear(image.astype(np.float64))
    seen = np.flatnonzero(valid)[:: max(1, valid.sum() // FITTED)]
    some, true_light = light.reshape(-1, 3)[seen], srgb_to_linear(truth.astype(np.float64)).reshape(-1, 3)[seen]
    true_lab = lab(truth.reshape(-1, 3)[seen].astype(np.float64))

    def error(log_gains: np.ndarray) -> float:
        shown = np.clip(linear_to_srgb(some * np.exp(log_gains)), 0, 1)
        return float(delta_e_2000(lab(shown), true_lab).mean())

    first = np.log(np.maximum((some * true_light).sum(axis=0) / np.maximum((some**2).sum(axis=0), 1e-9), 1e-3))
    found = minimize(error, first, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-4, "maxiter": 400})
    return np.clip(linear_to_srgb(light * np.exp(found.x)), 0, 1)


def true_water(image: np.ndarray, ranges: np.ndarray, water: Mapping[str, Any]) -> np.ndarray:
    """Invert the image formation model with the true water and ranges: what noise and 8 bits of a photo allow.

    Args:
        image: The image.
        ranges: (H, W) metres.
        water: `beta_D`, `beta_B` and `B_inf`, as truth.json has them.

    Returns:
        The restored image; a lamp's light stays in it.
    """
    beta_D, beta_B, B_inf = (np.array(water[name]) for name in ("beta_D", "beta_B", "B_inf"))
    z = ranges[..., None].astype(np.float64)
    light = srgb_to_linear(image.astype(np.float64)) - B_inf * (1 - np.exp(-beta_B * z))
    return np.clip(linear_to_srgb(np.maximum(light, 0) * np.exp(beta_D * z)), 0, 1)


def sea_thru(image: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """Remove the water from one image by its ranges (Akkaynak and Treibitz 2019, written from its description).

    Backscatter is fitted to the darkest pixels of bins of range. The illuminant that is left is the local space average
    color, from which the attenuation is fitted as a sum of two exponentials of range. A grey world balances the result.

    Args:
        image: The image.
        ranges: (H, W), 0 or NaN where there is no surface.

    Returns:
        The restored image; the image itself where there is no surface.
    """
    known = np.isfinite(ranges) & (ranges > 0)
    if not known.any():
        return image
    light, z = srgb_to_linear(image.astype(np.float64)), np.where(known, ranges, 0).astype(np.float64)
    direct = np.maximum(light - _backscatter(light, z, known), 0)
    illuminant = ILLUMINANT * local_average(direct, z, known)
    far = z[known]
    restored = np.zeros_like(light)
    for channel in range(3):
        depth = -np.log(np.clip(illuminant[..., channel][known], 1e-6, 1))
        restored[known, channel] = direct[known, channel] * np.exp(_attenuation(far, depth) * far)
    means = np.maximum(restored[known].mean(axis=0), 1e-9)
    gains = np.minimum(means @ LUMINANCE / means, MOST_GAIN)
    balanced = restored * gains
    balanced *= BRIGHT_LIGHT / max(float(np.quantile(balanced[known] @ LUMINANCE, BRIGHT_QUANTILE)), 1e-9)
    return np.where(known[..., None], np.clip(linear_to_srgb(balanced), 0, 1), image)


def _backscatter(light: np.ndarray, z: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the backscatter (H, W, 3) at ranges z (H, W), fitted in pixels (H, W) bool."""
    values, far = light[known], z[known]
    edges = np.linspace(far.min(), far.max(), BINS + 1)
    chosen = []
    for k in range(BINS):
        inside = np.flatnonzero((far >= edges[k]) & (far <= edges[k + 1]))
        count = int(np.ceil(DARKEST * len(inside)))
        chosen.append(inside[np.argsort(values[inside].sum(axis=1))[:count]])
    dark = np.concatenate(chosen)

    def model(p: np.ndarray, at: np.ndarray) -> np.ndarray:
        return p[0] * (1 - np.exp(-p[1] * at)) + p[2] * np.exp(-p[3] * at)

    found = np.empty_like(light)
    for channel in range(3):
        target = values[dark, channel]
        start = np.array([np.clip(target.max(), 0.01, 1), 0.2, 0.01, 0.2])
        fit = least_squares(
            lambda p, target=target: model(p, far[dark]) - target, start, bounds=([0, 0, 0, 0], [1, 5, 1, 5]),
            loss="soft_l1", f_scale=0.02,
        )  # fmt: skip
        # The term of p[2] is light of the dark surfaces themselves, which stays in the direct signal.
        found[..., channel] = model(np.array([*fit.x[:2], 0, 0]), z)
    return found


def local_average(direct: np.ndarray, z: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Compute the local space average color among neighbours of like range.

    Args:
        direct: (H, W, 3) linear light.
        z: (H, W) ranges.
        known: (H, W) bool, pixels that have a range.

    Returns:
        (H, W, 3) linear light.
    """
    like = NEIGHBOURS * z.max()
    pairs = []
    for axis in (0, 1):
        near = np.moveaxis(known, axis, 0), np.moveaxis(z, axis, 0)
        pairs.append(np.moveaxis(near[0][1:] & near[0][:-1] & (np.abs(near[1][1:] - near[1][:-1]) < like), 0, axis))
    down, right = pairs[0][..., None], pairs[1][..., None]
    count = np.zeros((*z.shape, 1))
    count[1:] += down
    count[:-1] += down
    count[:, 1:] += right
    count[:, :-1] += right
    average = direct.copy()
    for _ in range(SWEEPS):
        total = np.zeros_like(average)
        total[1:] += down * average[:-1]
        total[:-1] += down * average[1:]
        total[:, 1:] += right * average[:, :-1]
        total[:, :-1] += right * average[:, 1:]
        mean = np.where(count > 0, total / np.maximum(count, 1), average)
        average = SPREAD * direct + (1 - SPREAD) * mean
    return average


def _attenuation(far: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return beta(z) = a exp(b z) + c exp(d z) at ranges (N,), fitted to optical depths beta z (N,)."""
    some = slice(None, None, max(1, len(far) // FITTED))

    def beta(p: np.ndarray, at: np.ndarray) -> np.ndarray:
        return p[0] * np.exp(p[1] * at) + p[2] * np.exp(p[3] * at)

    scale = float(np.median(depth / np.maximum(far, 1e-6)))
    fit = least_squares(
        lambda p: beta(p, far[some]) * far[some] - depth[some], [scale, -0.01, scale, -0.5],
        bounds=([0, -5, 0, -5], [20, 0, 20, 0]), loss="soft_l1",
    )  # fmt: skip
    return beta(fit.x, far)


def hue_error(shown: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> float:
    """Compare hues.

    Args:
        shown: The image.
        truth: The true image.
        valid: (H, W) bool, pixels to compare.

    Returns:
        Mean angle between the hues in the a*b* plane, degrees, 0 to 180, where the true chroma is GREY_CHROMA or more;
        NaN where it is nowhere.
    """
    a, b = (lab(image[valid].astype(np.float64))[..., 1:] for image in (shown, truth))
    colored = np.hypot(*b.T) >= GREY_CHROMA
    if not colored.any():
        return float("nan")
    hue_a, hue_b = (np.degrees(np.arctan2(ab[colored, 1], ab[colored, 0])) for ab in (a, b))
    return float(np.abs((hue_a - hue_b + 180) % 360 - 180).mean())
