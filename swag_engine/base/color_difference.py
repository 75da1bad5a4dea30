"""CIE L*a*b* colors and the difference between two of them."""

import numpy as np

from .transfer import srgb_to_linear


def lab(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB (..., 3) in 0..1 (IEC 61966-2-1) to CIE L*a*b* (..., 3) with white point D65."""
    linear = srgb_to_linear(srgb)
    xyz = linear @ np.array(
        [[0.4124564, 0.2126729, 0.0193339], [0.3575761, 0.7151522, 0.1191920], [0.1804375, 0.0721750, 0.9503041]]
    )
    t = xyz / (0.95047, 1.0, 1.08883)
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def delta_e_2000(lab1: np.ndarray, lab2: np.ndarray) -> np.ndarray:
    """Compute the CIEDE2000 color difference (Sharma, Wu, Dalal 2005, with k_L = k_C = k_H = 1).

    Args:
        lab1: L*a*b* colors (..., 3).
        lab2: L*a*b* colors (..., 3).

    Returns:
        Differences (...); 1 is about the smallest that people see.
    """
    (l1, a1, b1), (l2, a2, b2) = np.moveaxis(lab1, -1, 0), np.moveaxis(lab2, -1, 0)

    def saturation(chroma: np.ndarray) -> np.ndarray:
        return np.sqrt(chroma**7 / (chroma**7 + 25.0**7))

    g = 0.5 * (1 - saturation((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2))
    a1, a2 = (1 + g) * a1, (1 + g) * a2
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = np.degrees(np.arctan2(b1, a1)) % 360, np.degrees(np.arctan2(b2, a2)) % 360

    apart = np.where(c1 * c2 == 0, 0, h2 - h1)  # a grey has no hue
    wraps = np.abs(apart) > 180 + 1e-9  # opposite hues, up to rounding, do not
    turn = apart - np.where(wraps, 360 * np.sign(apart), 0)
    mean_hue = np.where(c1 * c2 == 0, h1 + h2, (h1 + h2) / 2 + np.where(wraps, 180, 0))
    mean_l, mean_c = (l1 + l2) / 2, (c1 + c2) / 2
    dl, dc, dh = l2 - l1, c2 - c1, 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2))

    hue = np.radians(mean_hue)
    t = (
        1
        - 0.17 * np.cos(hue - np.radians(30))
        + 0.24 * np.cos(2 * hue)
        + 0.32 * np.cos(3 * hue + np.radians(6))
        - 0.20 * np.cos(4 * hue - np.radians(63))
    )
    squared = (mean_l - 50) ** 2
    dl /= 1 + 0.015 * squared / np.sqrt(20 + squared)
    dc /= 1 + 0.045 * mean_c
    dh /= 1 + 0.015 * mean_c * t
    twist = np.exp(-(((np.degrees(hue) % 360 - 275) / 25) ** 2))
    rotation = -2 * saturation(mean_c) * np.sin(np.radians(60 * twist))
    return np.sqrt(dl**2 + dc**2 + dh**2 + rotation * dc * dh)
