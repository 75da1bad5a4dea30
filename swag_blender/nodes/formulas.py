"""Colour curves, spherical harmonics and water as nodes; the same nodes stand in geometry and in shader trees."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import bpy

from ..water_values import ATTENUATION, BACKSCATTER, OF_DISPLAY, VEIL
from .build import Field, Operand, combined

# Real spherical harmonics in the order and with the signs of 3DGS files: 1 / (2 sqrt(pi)) and so on.
SH_0 = 0.28209479177387814
_SH_1 = 0.4886025119029199
_SH_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_SH_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def harmonics(direction: Field) -> list[list[Field]]:
    """The functions of degree 1, 2 and 3 (3, 5 and 7 of them) for a unit direction."""
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
    """Linear light of a display value: the curve of IEC 61966-2-1; above one it goes on by the same formula."""
    curved = ((value + 0.055) * (1 / 1.055)).math("POWER", 2.4)
    return mixed(value * (1 / 12.92), curved, value.math("GREATER_THAN", 0.04045))


def to_display(light: Field) -> Field:
    """Display value of linear light, the inverse of to_light."""
    curved = light.math("MAXIMUM", 0.0).math("POWER", 1 / 2.4) * 1.055 - 0.055
    return mixed(light * 12.92, curved, light.math("GREATER_THAN", 0.0031308))


def mixed(off: Field, on: Field, factor: Operand) -> Field:
    """off at factor 0, on at factor 1, numbers or vectors."""
    return off + (on - off) * factor


def by_channel(tree: bpy.types.NodeTree, function: Callable[[Field], Field], color: Field) -> Field:
    """A function of numbers, of each component of a vector."""
    return combined(tree, [function(channel) for channel in color.xyz()])


@dataclasses.dataclass
class Water:
    """The inputs of the water's formula. amount: 0 to 1; attenuation, backscatter: vectors per unit of length; veil:
    nine vectors, the coefficients of B = sigmoid(their harmonics); display: 1 where the formula is of display values,
    0 where it is of light."""

    amount: Field
    attenuation: Field
    backscatter: Field
    veil: Sequence[Field]
    display: Field

    @classmethod
    def of(cls, inputs: Mapping[str, Field], amount: Field) -> Water:
        """From inputs by the names of WaterValues."""
        veil = [inputs[name] for name in VEIL]
        return cls(amount, inputs[ATTENUATION], inputs[BACKSCATTER], veil, inputs[OF_DISPLAY])

    def open_water(self, tree: bpy.types.NodeTree, direction: Field) -> Field:
        """amount times B along a unit direction, in the water's light: what is seen where nothing is."""
        total, index = self.veil[0] * SH_0, 1
        for functions in harmonics(direction)[:2]:
            for function in functions:
                total = self.veil[index].vector("MULTIPLY_ADD", function, total)
                index += 1
        return by_channel(tree, lambda v: ((v * -1.0).math("EXPONENT") + 1.0).math("POWER", -1.0), total) * self.amount

    def through(self, tree: bpy.types.NodeTree, light: Field, distance: Field, veil: Field) -> Field:
        """swag_engine/water/medium.py's through_water, of values in the water's light; veil: open_water()."""

        def left(coefficients: Field) -> Field:
            path = coefficients * (distance * self.amount * -1.0)
            return by_channel(tree, lambda value: value.math("EXPONENT"), path)

        return light * left(self.attenuation) + veil * (left(self.backscatter) * -1.0 + (1.0, 1.0, 1.0))
