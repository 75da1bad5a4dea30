"""Transfer functions, spherical harmonics and water as nodes, for geometry and shader trees."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import bpy

from ...swag_engine.splats.development import GREY
from ..water_values import ATTENUATION, BACKGROUND, BACKSCATTER, OF_DISPLAY
from .build import Field, Operand, combined

SH_0 = 0.28209479177387814
_SH_1 = 0.4886025119029199
_SH_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_SH_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
"""Factors of the real spherical harmonics with the order and signs of 3DGS files: 1 / (2 sqrt(pi)) and so on."""
SH_FACTORS = (_SH_1, *_SH_2, *_SH_3)


_LEAST_PEAK = 1e-6
"""Least largest channel that is divided by, linear light."""


def harmonics(direction: Field) -> list[list[Field]]:
    """Spherical harmonics of degree 1, 2 and 3 (3, 5 and 7 of them) of a unit direction."""
    x, y, z = direction.xyz()
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    around = zz * 4.0 - xx - yy
    return [
        [y * -_SH_1, z * _SH_1, x * -_SH_1],
        [xy * _SH_2[0], yz * -_SH_2[0], (zz * 2.0 - xx - yy) * _SH_2[1], xz * -_SH_2[0], (xx - yy) * _SH_2[2]],
        [
            y * (xx * 3.0 - yy) * -_SH_3[0],
            xy * z * _SH_3[1],
            y * around * -_SH_3[2],
            z * (zz * 2.0 - xx * 3.0 - yy * 3.0) * _SH_3[3],
            x * around * -_SH_3[2],
            z * (xx - yy) * _SH_3[4],
            x * (xx - yy * 3.0) * -_SH_3[0],
        ],
    ]


def to_light(value: Field) -> Field:
    """Convert an sRGB value to linear light (IEC 61966-2-1); the same formula is used above 1."""
    curved = ((value + 0.055) * (1 / 1.055)).math("POWER", 2.4)
    return mixed(value * (1 / 12.92), curved, value.math("GREATER_THAN", 0.04045))


def to_display(light: Field) -> Field:
    """Convert linear light to an sRGB value, the inverse of to_light."""
    curved = light.math("MAXIMUM", 0.0).math("POWER", 1 / 2.4) * 1.055 - 0.055
    return mixed(light * 12.92, curved, light.math("GREATER_THAN", 0.0031308))


def mixed(off: Field, on: Field, factor: Operand) -> Field:
    """Linear interpolation of numbers or vectors: `off` at factor 0, `on` at factor 1."""
    return off + (on - off) * factor


def by_channel(tree: bpy.types.NodeTree, function: Callable[[Field], Field], color: Field) -> Field:
    """Apply a function of numbers to each component of a vector."""
    return combined(tree, [function(channel) for channel in color.xyz()])


@dataclasses.dataclass
class Water:
    """The inputs of the water's formula.

    Attributes:
        amount: fraction of the water that is shown, 0 to 1.
        attenuation: beta_D, a vector, per unit of length.
        backscatter: beta_B, a vector, per unit of length.
        background: nine vectors, the SH coefficients of the background light B_inf = sigmoid(their sum).
        display: 1 where the formula acts on sRGB values, 0 where it acts on linear light.
    """

    amount: Field
    attenuation: Field
    backscatter: Field
    background: Sequence[Field]
    display: Field

    @classmethod
    def of(cls, inputs: Mapping[str, Field], amount: Field) -> Water:
        """Make it from inputs with the names of WaterValues."""
        background = [inputs[name] for name in BACKGROUND]
        return cls(amount, inputs[ATTENUATION], inputs[BACKSCATTER], background, inputs[OF_DISPLAY])

    def background_light(self, tree: bpy.types.NodeTree, direction: Field) -> Field:
        """B_inf along a unit direction times the amount: what a camera sees without any surface."""
        total, index = self.background[0] * SH_0, 1
        for functions in harmonics(direction)[:2]:
            for function in functions:
                total = self.background[index].vector("MULTIPLY_ADD", function, total)
                index += 1
        return by_channel(tree, lambda v: ((v * -1.0).math("EXPONENT") + 1.0).math("POWER", -1.0), total) * self.amount

    def through(self, tree: bpy.types.NodeTree, light: Field, distance: Field, background: Field) -> Field:
        """The image formation model of swag_engine/water/medium.py.

        Args:
            tree: where the nodes are made.
            light: color of the surface without water, sRGB or linear as the water needs it.
            distance: from the camera to the surface, in the water's unit of length.
            background: background_light() along the ray.
        """

        def transmission(coefficients: Field) -> Field:
            path = coefficients * (distance * self.amount * -1.0)
            return by_channel(tree, lambda value: value.math("EXPONENT"), path)

        gained = transmission(self.backscatter) * -1.0 + (1.0, 1.0, 1.0)
        return light * transmission(self.attenuation) + background * gained


@dataclasses.dataclass
class Development:
    """The inputs of the formula of swag_engine/splats/development.py: restored colors, then what a user adjusts.

    Attributes:
        water: fraction of the water that is shown, by which the development of restored colors fades.
        rows: three vectors, the matrix of restored colors.
        contrast: exponent of restored colors.
        gains: a vector, the gains of any colors.
        own_contrast: exponent of any colors.
        knee: linear light above which restored colors are rolled off; None for no roll-off.
    """

    water: Field
    rows: Sequence[Field]
    contrast: Field
    gains: Field
    own_contrast: Field
    knee: Field | None = None

    def apply(self, tree: bpy.types.NodeTree, light: Field) -> Field:
        """Develop linear light."""
        kept = self.water * -1.0 + 1.0
        seen = combined(tree, [row.dot(light) for row in self.rows])
        light = (seen * kept + light * self.water) * self.gains
        red, green, blue = light.xyz()
        peak = red.math("MAXIMUM", green).math("MAXIMUM", blue).math("MAXIMUM", _LEAST_PEAK)
        exponent = self.contrast.math("POWER", kept) * self.own_contrast
        wanted = (peak * (1 / GREY)).math("POWER", exponent) * GREY
        if self.knee is not None:
            least = (self.knee * -1.0 + 1.0) * kept  # 1 - knee
            begin = least * -1.0 + 1.0
            over = (wanted - begin).math("MAXIMUM", 0.0).math("DIVIDE", least.math("MAXIMUM", _LEAST_PEAK))
            rolled = wanted.math("MINIMUM", begin) + least * over.math("DIVIDE", over + 1.0)
            wanted = mixed(wanted, rolled, least.math("GREATER_THAN", _LEAST_PEAK))
        return light.scaled(wanted.math("DIVIDE", peak))
