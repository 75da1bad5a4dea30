"""The constants of the kernels in C++, CUDA and WGSL, from the values of the reference.

    python -m swag_engine.kernels.constants          writes constants.h, which C++ and CUDA include

WGSL gets its text when a kernel is compiled.
"""

import math
from pathlib import Path

import numpy as np

from ..base.transfer import DISPLAY_TOE, LINEAR_TOE
from .reference import blending, harmonics, projection, similarity

HEADER = Path(__file__).with_name("constants.h")
"""What C++ and CUDA include."""


def values() -> dict[str, float]:
    """Return the constants by name; their units and sources are beside them in the reference."""
    return {
        "NEAR": projection.NEAR,
        "BLUR": projection.BLUR,
        "GUARD": projection.GUARD,
        "MAX_SIGMA": projection.MAX_SIGMA,
        "MAX_EXTENT": projection.MAX_EXTENT,
        "MIN_ALPHA": projection.MIN_ALPHA,
        "LOG255": -math.log(projection.MIN_ALPHA),
        "MAX_ALPHA": blending.MAX_ALPHA,
        "MIN_TRANSMITTANCE": blending.MIN_TRANSMITTANCE,
        "SSIM_C1": similarity.C1,
        "SSIM_C2": similarity.C2,
        "DISPLAY_TOE": DISPLAY_TOE,
        "LINEAR_TOE": LINEAR_TOE,
        "SH_C0": harmonics.C0,
        "SH_C1": harmonics.C1,
        **{f"SH_C2_{number}": value for number, value in enumerate(harmonics.C2)},
        **{f"SH_C3_{number}": value for number, value in enumerate(harmonics.C3)},
    }


def window() -> list[float]:
    """Return the window of SSIM from its centre outwards; the values of the whole window sum to 1."""
    distances = np.arange(similarity.WINDOW) - similarity.WINDOW // 2
    weights = np.exp(-(distances**2) / (2 * similarity.SIGMA**2))
    half = (weights / weights.sum())[similarity.WINDOW // 2 :]
    return [float(f"{value:.9e}") for value in half]


def header() -> str:
    """Return the text of constants.h."""
    lines = [f"constexpr double {name} = {float(value)!r};" for name, value in values().items()]
    numbers = ", ".join(map(repr, window()))
    return "\n".join(
        [
            "// Written by constants.py from the values of the reference, which says what they are.",
            "#pragma once",
            "",
            "namespace constants {",
            *lines,
            f"constexpr double WINDOW[] = {{{numbers}}};",
            "}  // namespace constants",
            "",
        ]
    )


def wgsl() -> str:
    """Return the constants as WGSL."""
    lines = [f"const {name} = {float(value)!r};" for name, value in values().items()]
    half = window()
    return "\n".join([*lines, f"const WINDOW = array<f32, {len(half)}>({', '.join(map(repr, half))});", ""])


if __name__ == "__main__":
    HEADER.write_text(header(), encoding="utf-8")
