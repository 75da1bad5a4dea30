"""Opacity of splats that stand for open water: hidden without water, as trained with all of it.

Training explains open water by splats as well as by the background light. Without water these are a haze above the
scene. A score says how sure it is that a splat is open water (rendering/haze.py). Files hold the opacities without
haze, so that every program shows clean edges, and the score as the property HAZE, from which the trained opacities
follow. numpy and torch arrays are taken alike; Blender imports this.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from ..base.errors import InputError
from .splats import Splats

Values = Any
"""A number, a numpy array or a torch tensor; a function returns what it takes."""

HAZE = "haze"
"""Property of splats in files: how sure it is that a splat is open water and no surface, 0..MOST_HAZE."""
MOST_HAZE = 0.995
"""Largest score: an opacity without haze is .005 of the trained one or more, so that this can be found again."""


def check_haze(haze: float) -> None:
    """Raise InputError for an amount of haze that is not from 0 to 1."""
    if not 0 <= haze <= 1:
        raise InputError(f"The amount of haze must be from 0 to 1, not {haze}.")


def haze_amount(water: float, haze: float) -> float:
    """Return the fraction of the haze that is shown: at least that of the water, as the photos show it in front."""
    return max(water, haze)


def opacity_without_haze(score: Values) -> Values:
    """Return the fraction of the trained opacity that splats have in files, by their score."""
    return 1 - score


def haze_gain(score: Values, amount: float) -> Values:
    """Return the factor from the opacity in files to the one that is shown.

    Args:
        score: Score of splats, 0..MOST_HAZE.
        amount: Fraction of the haze that is shown: 0 gives 1, 1 the trained opacity.
    """
    return 1 + amount * score / (1 - score)


def with_haze(splats: Splats, amount: float) -> Splats:
    """Show haze in splats of a file.

    Args:
        splats: Splats as files hold them.
        amount: Fraction of the haze that is shown, 0..1.

    Returns:
        The splats with the shown opacities; without the property HAZE where these are not the ones of files any more.
    """
    score = splats.extras.get(HAZE)
    if score is None or amount == 0:
        return splats
    opacities = np.minimum(splats.opacities * haze_gain(score.astype(np.float32), amount), 1)
    extras = {name: values for name, values in splats.extras.items() if name != HAZE}
    return replace(splats, opacities=opacities.astype(np.float32), extras=extras)
