"""Jerlov water types, for a user who knows the kind of water."""

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
MOST = 10.0  # per metre; half a metre of such water transmits less than 1 %


def water_of_type(text: str, metres_per_unit: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the initial coefficients of a water type.

    Args:
        text: A name of JERLOV in any case, or attenuation per metre such as "0.3,0.1,0.06" (red, green, blue).
        metres_per_unit: Length of one scene unit in metres.

    Returns:
        beta_D and beta_B, each (3,), per scene unit; both are the water's attenuation.

    Raises:
        InputError: For an unknown type, and where `metres_per_unit` is missing or not positive.
    """
    name = text.strip()
    values = JERLOV.get(name.upper()) or _numbers(name)
    if metres_per_unit is None or not 0 < metres_per_unit < math.inf:
        raise InputError(
            f"The water type {name} is in metres, so the scene's scale is needed: measure it with the command scale, "
            f"or set metres per unit to the number of metres that one unit of the scene is."
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
            f"The water type {name!r} is out of range: attenuation of red, green and blue must each be from 0 to "
            f"{MOST:g} per metre."
        )
    return values
