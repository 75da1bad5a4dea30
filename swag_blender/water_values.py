"""The water of a run, as the node groups take it."""

import dataclasses
from typing import Any

import numpy as np

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.water import DAMAGED

Triple = tuple[float, float, float]
ATTENUATION, BACKSCATTER, OF_DISPLAY = "Attenuation", "Backscatter", "Of Display Values"
VEIL = tuple(f"Veil {index}" for index in range(9))
_NONE = (0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class WaterValues:
    """beta_D and beta_B (R, G, B) per unit of the splats' own space; veil: nine (R, G, B), raw SH coefficients of B =
    sigmoid(their sum); display: the formula is of display values, not of light. The default is no water."""

    beta_D: Triple = _NONE
    beta_B: Triple = _NONE
    veil: tuple[Triple, ...] = (_NONE,) * 9
    display: bool = False

    @classmethod
    def from_json(cls, water: dict[str, Any], metres_per_unit: float) -> "WaterValues":
        """From the contents of a run's water.json. Raises InputError where they are no coefficients of a water."""
        unit = metres_per_unit if water.get("per") == "metre" else 1.0
        try:
            beta_D, beta_B = (_triples([water[name]], unit)[0] for name in ("beta_D", "beta_B"))
            veil = _triples(water["veil_sh"])
            display = {"linear": False, "srgb": True}[water["light"]]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(DAMAGED) from error
        if len(veil) != len(VEIL) or not unit:
            raise InputError(DAMAGED)
        return cls(beta_D, beta_B, veil, display)

    def to_json(self) -> dict[str, Any]:
        """The same as from_json takes it, per scene unit."""
        light = "srgb" if self.display else "linear"
        return {"beta_D": self.beta_D, "beta_B": self.beta_B, "veil_sh": self.veil, "light": light, "per": "unit"}

    def inputs(self) -> dict[str, Triple | bool]:
        """By the names of the node groups' inputs."""
        veil = dict(zip(VEIL, self.veil, strict=True))
        return {ATTENUATION: self.beta_D, BACKSCATTER: self.beta_B, **veil, OF_DISPLAY: self.display}


def _triples(rows: Any, factor: float = 1.0) -> tuple[Triple, ...]:
    values = np.array(rows, np.float64) * factor
    if values.ndim != 2 or values.shape[1] != 3 or not np.isfinite(values).all():
        raise ValueError("no triples of finite numbers")
    return tuple(tuple(row) for row in values.tolist())
