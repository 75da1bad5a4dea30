"""Development in the colors of splats themselves, for programs that cannot develop pictures. Blender imports it."""

from dataclasses import replace

import numpy as np

from .development import NO_DEVELOPMENT, Development, SplatDevelopment
from .splats import Splats
from .transform import C0


def bake_development(splats: Splats, development: Development) -> Splats:
    """Develop the colors of splats.

    The mean color of a splat over directions is developed exactly, its change with direction to first order. Highlights
    are not rolled off: colors of single splats are often above 1 where the picture is not, and a roll-off of each would
    darken it (27 dB on the demo scene; without roll-off 44 dB for a stop of exposure, 51 dB for a white point, 33 dB
    for a contrast of 1.2, against the developed picture).

    Args:
        splats: Splats with restored colors.
        development: What is done to their pictures.

    Returns:
        The splats with other spherical harmonics, and with the development; the argument itself without one.
    """
    if development == NO_DEVELOPMENT:
        return splats
    per_splat = replace(development, knee=1.0)
    if per_splat == NO_DEVELOPMENT:
        return name_development(splats, development)
    slope = per_splat.slope()
    mean = 0.5 + C0 * splats.sh[:, 0].astype(np.float64)
    sh = splats.sh @ slope.T
    sh[:, 0] = (per_splat.apply(np.maximum(mean, 0)) + np.minimum(mean, 0) @ slope.T - 0.5) / C0
    return replace(splats, sh=sh.astype(splats.sh.dtype), development=SplatDevelopment(development, applied=True))


def name_development(splats: Splats, development: Development) -> Splats:
    """Return splats that carry the development of their pictures, with restored colors as they are."""
    named = None if development == NO_DEVELOPMENT else SplatDevelopment(development, applied=False)
    return replace(splats, development=named)


def undo_development(splats: Splats) -> Splats:
    """Return splats with the colors that they had before `bake_development`.

    Colors below 0 come back to first order where the development mixes channels.

    Args:
        splats: Splats as a file has them.

    Returns:
        The splats with restored colors and the same development; the argument itself where none was applied.
    """
    if splats.development is None or not splats.development.applied:
        return splats
    per_splat = replace(splats.development.development, knee=1.0)
    unslope = np.linalg.inv(per_splat.slope())
    mean = 0.5 + C0 * splats.sh[:, 0].astype(np.float64)
    sh = splats.sh @ unslope.T
    sh[:, 0] = (per_splat.inverse(np.maximum(mean, 0)) + np.minimum(mean, 0) @ unslope.T - 0.5) / C0
    restored = replace(splats, sh=sh.astype(splats.sh.dtype))
    return name_development(restored, splats.development.development)
