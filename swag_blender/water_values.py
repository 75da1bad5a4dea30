"""The water of a run as inputs of the node groups."""

import dataclasses
from typing import Any

import numpy as np

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.water import DAMAGED, has_background_light

Triple = tuple[float, float, float]
ATTENUATION, BACKSCATTER, OF_DISPLAY = "Attenuation", "Backscatter", "Of Display Values"
BACKGROUND = tuple(f"Background Light {index}" for index in range(9))
"""Names of the inputs of the node groups."""
_NONE = (0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class WaterValues:
    """The coefficients of a water; by default there is none.

    Attributes:
        beta_D: attenuation of red, green and blue per unit of the splats' own space.
        beta_B: backscatter, likewise.
        background: SH coefficients (9, 3) of the background light, B_inf = sigmoid(their sum).
        display: whether the formula acts on sRGB values and not on linear light.
    """

    beta_D: Triple = _NONE
    beta_B: Triple = _NONE
    background: tuple[Triple, ...] = (_NONE,) * 9
    display: bool = False

    @classmethod
    def from_json(cls, water: dict[str, Any], metres_per_unit: float) -> "WaterValues":
        """Make it from the contents of a run's water.json.

        Args:
            water: the contents.
            metres_per_unit: of the run, for water per metre.

        Raises:
            InputError: the contents are no coefficients of a water.
        """
        unit = metres_per_unit if water.get("per") == "metre" else 1.0
        try:
            beta_D, beta_B = (_triples([water[name]], unit)[0] for name in ("beta_D", "beta_B"))
            background = _triples(water["background_sh"])
            display = {"linear": False, "srgb": True}[water["light"]]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(DAMAGED) from error
        if len(background) != len(BACKGROUND) or not unit:
            raise InputError(DAMAGED)
        return cls(beta_D, beta_B, background, display)

    def to_json(self) -> dict[str, Any]:
        """The contents that from_json takes, per scene unit."""
        light = "srgb" if self.display else "linear"
        return {
            "beta_D": self.beta_D,
            "beta_B": self.beta_B,
            "background_sh": self.background,
            "light": light,
            "per": "unit",
        }

    @property
    def has_background_light(self) -> bool:
        """Whether the water adds light, so that open water is behind the splats."""
        return has_background_light(self.background)

    def inputs(self) -> dict[str, Triple | bool]:
        """The values by the names of the node groups' inputs."""
        background = dict(zip(BACKGROUND, self.background, strict=True))
        return {ATTENUATION: self.beta_D, BACKSCATTER: self.beta_B, **background, OF_DISPLAY: self.display}


def _triples(rows: Any, factor: float = 1.0) -> tuple[Triple, ...]:
    """Rows of three finite numbers, each times a factor. Raises ValueError for anything else."""
    values = np.array(rows, np.float64) * factor
    if values.ndim != 2 or values.shape[1] != 3 or not np.isfinite(values).all():
        raise ValueError("no triples of finite numbers")
    return tuple((red, green, blue) for red, green, blue in values.tolist())
