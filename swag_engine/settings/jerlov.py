"""Known kinds of water, for a user who knows better than the photographs tell."""

import math

import numpy as np

from ..base.errors import InputError

JERLOV = {
    "I": (0.235, 0.043, 0.018),
    "IA": (0.240, 0.048, 0.025),
    "IB": (0.245, 0.054, 0.033),
    "II": (0.260, 0.076, 0.062),
    "III": (0.295, 0.116, 0.116),
    "1C": (0.30, 0.13, 0.17),
    "3C": (0.33, 0.20, 0.29),
    "5C": (0.40, 0.31, 0.43),
    "7C": (0.48, 0.49, 0.71),
    "9C": (0.60, 0.78, 1.23),
}
"""Diffuse attenuation per metre at 600, 525 and 475 nm (red, green, blue) of Jerlov's water types, from the clearest
ocean (I) to the murkiest coast (9C): Jerlov, Marine Optics, 1976."""
MOST = 10.0  # per metre; nothing is seen through it


def water_of_type(text: str, metres_per_unit: float | None) -> tuple[np.ndarray, np.ndarray]:
    """beta_D and beta_B (3,) per scene unit of a water type, to start from: both the water's attenuation.

    text: a name of JERLOV in any case, or attenuation per metre as in "0.3,0.1,0.06" (red, green, blue).
    Raises InputError for anything else, and where metres_per_unit is missing or no positive number.
    """
    name = text.strip()
    values = JERLOV.get(name.upper()) or _numbers(name)
    if metres_per_unit is None or not 0 < metres_per_unit < math.inf:
        raise InputError(
            f"The water type {name} is in metres, so the scene's scale is needed: set metres per unit to the number of "
            f"metres that one unit of the scene is."
        )
    beta = np.array(values) * metres_per_unit
    return beta, beta.copy()


def _numbers(name: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in name.split(","))
    except ValueError:
        values = ()
    if len(values) != 3:
        raise InputError(
            f"The water type {name!r} is not known: use one of {', '.join(JERLOV)}, or three numbers per metre for "
            f"red, green and blue as in 0.3,0.1,0.06."
        )
    if not all(0 <= value <= MOST for value in values):
        raise InputError(
            f"The water type {name!r} is no water: attenuation of red, green and blue must each be from 0 to {MOST:g} "
            f"per metre."
        )
    return values
