"""Water of a run, added to the colors of splats. numpy only, Blender imports it.

Attenuation and backscatter depend on the range from the camera, which a splat file cannot express. Instead each splat
gets the color that it had in an image of the scene. The formulas are those of docs/method.md section 1.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..base.errors import DAMAGE, InputError
from ..base.transfer import DISPLAY_TOE, LINEAR_TOE, linear_to_srgb, srgb_to_linear
from ..scene.cameras import Camera
from ..splats.splats import Splats
from ..splats.transform import C0, sh_basis, sh_rotation

BLOCK = 8192
"""Splats computed at a time: each is compared with every camera."""
NO_BACKGROUND_LIGHT = -100.0
"""Raw SH coefficient of degree 0 whose sigmoid is 0 in float32: the background light of water that only attenuates."""
DAMAGED = "water.json does not hold the coefficients of a water; train the run again."
ThroughWater = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function of display colors (N, 3), ranges (N, 1) and directions (N, 3) that returns the display colors seen through
the water, and their derivative (N, 3) by the colors."""


def bake_water(
    splats: Splats, water: dict[str, Any], cameras: Sequence[Camera], amount: float = 1.0, metres_per_unit: float = 0.0
) -> Splats:
    """Add water to the colors of splats.

    Each splat is seen by the camera that has it in its image at the median range, or by the nearest camera where none
    has it. Seen from that camera its color is exactly that through the water (that of a water network is averaged over
    directions); the change of color with direction is kept to first order.

    Args:
        splats: Splats without water.
        water: Contents of the run's water.json.
        cameras: Cameras of the splats' world, at least one.
        amount: How much of the water, 0..1.
        metres_per_unit: Length of one unit of the splats' world in metres, needed for water per metre.

    Returns:
        The splats with other spherical harmonics.

    Raises:
        InputError: If `water` is not as a run writes it, or is per metre and `metres_per_unit` is 0.
    """
    through_water = _through_water(water, amount, metres_per_unit)
    sh = np.empty_like(splats.sh)
    for start in range(0, len(splats), BLOCK):
        part = slice(start, start + BLOCK)
        positions = splats.positions[part].astype(np.float64)
        offsets = positions - _viewpoints(positions, cameras)
        ranges = np.linalg.norm(offsets, axis=1, keepdims=True)
        directions = offsets / np.maximum(ranges, np.finfo(np.float64).tiny)
        own = np.einsum("nk,nkc->nc", sh_basis(directions, splats.degree), splats.sh[part]) + 0.5
        seen, slope = through_water(np.maximum(own, 0), ranges, directions)
        # Coefficients of seen + slope (color in another direction - color in this one).
        sh[part] = slope[:, None] * splats.sh[part]
        sh[part, 0] += (seen - 0.5 + slope * (0.5 - own)) / C0
    return replace(splats, sh=sh)


def has_background_light(background_sh: Sequence[Sequence[float]]) -> bool:
    """Return whether water adds light, by its raw SH coefficients (9, 3); water that only attenuates adds none."""
    return max(background_sh[0]) > NO_BACKGROUND_LIGHT / 2


def transform_water(
    water: dict[str, Any], rotation: np.ndarray, scale: float, metres_per_unit: float, in_metres: bool
) -> dict[str, Any]:
    """Transform water together with its splats.

    Args:
        water: Contents of a run's water.json.
        rotation: (3, 3) rotation of the splats.
        scale: Factor by which the splats were scaled.
        metres_per_unit: Length of one scene unit in metres before that, needed for water per metre.
        in_metres: Whether the unit of the scaled splats is a metre.

    Returns:
        Contents of water.json for the transformed splats.

    Raises:
        InputError: If `water` is not as a run writes it, or is per metre and `metres_per_unit` is 0.
    """
    length = scale * _units(water, metres_per_unit)  # the water's unit of length, in units of the transformed splats
    changed: dict[str, Any] = {}
    try:
        for name in ("beta_D", "beta_B"):
            changed[name] = (_array(water, name, (3,)) / length).tolist()
        if "ranges" in water:
            changed["ranges"] = (_array(water, "ranges", (len(water["ranges"]),)) * length).tolist()
        if "background_sh" in water:
            changed["background_sh"] = (sh_rotation(rotation, 2) @ _array(water, "background_sh", (9, 3))).tolist()
    except DAMAGE as error:
        raise InputError(DAMAGED) from error
    return water | changed | {"per": "metre" if in_metres else "unit"}


def _units(water: dict[str, Any], metres_per_unit: float) -> float:
    """Return the water's unit of length in scene units."""
    if water.get("per") != "metre":
        return 1.0
    if not metres_per_unit:
        raise InputError("The water is per metre and the run does not know the length of a metre; train it again.")
    return 1 / metres_per_unit


def _through_water(water: dict[str, Any], amount: float, metres_per_unit: float) -> ThroughWater:
    """Return the function that adds `amount` of the water, in scene units.

    It computes the formula of water/medium.py, or interpolates in the table that water/network.py writes.
    """
    unit = _units(water, metres_per_unit)
    try:
        if "background_sh" in water:
            background_sh = _array(water, "background_sh", (9, 3))
            beta_D, beta_B = (_array(water, name, (3,)) * amount / unit for name in ("beta_D", "beta_B"))
            linear = {"linear": True, "srgb": False}[water["light"]]
        else:
            ranges = _array(water, "ranges", (len(water["ranges"]),)) * unit
            transmission, backscatter = (
                _array(water, name, (len(ranges), 3)) for name in ("transmission", "backscatter")
            )
    except DAMAGE as error:
        raise InputError(DAMAGED) from error

    def by_coefficients(color: np.ndarray, ranges: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        transmitted = np.exp(-beta_D * ranges)
        background = amount / (1 + np.exp(-sh_basis(directions, 2) @ background_sh))
        light = (srgb_to_linear(color) if linear else color) * transmitted - background * np.expm1(-beta_B * ranges)
        if not linear:
            return light, transmitted
        return linear_to_srgb(light), transmitted * _slope_to_linear(color) * _slope_to_srgb(light)

    def by_table(color: np.ndarray, own_ranges: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        transmitted, added = (
            np.stack([np.interp(own_ranges[:, 0], ranges, column) for column in table.T], axis=1)
            for table in (transmission, backscatter)
        )
        return color * transmitted**amount + amount * added, transmitted**amount

    return by_coefficients if "background_sh" in water else by_table


def _array(water: dict[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    try:
        values = np.array(water[name], np.float64)
    except OverflowError:
        raise ValueError(f"{name} has a number that is too large") from None
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{name} does not have the shape {shape}, or is not finite")
    return values


def _viewpoints(positions: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return for each position (N, 3) the centre of the camera that sees it at the median range, (N, 3)."""
    centres = np.stack([camera.centre for camera in cameras])
    ranges = np.linalg.norm(positions[:, None] - centres, axis=2)
    sees = np.empty(ranges.shape, bool)
    for column, camera in enumerate(cameras):
        x, y, z = (positions @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).T
        depth = np.where(z > 0, z, np.inf)
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        sees[:, column] = (z > 0) & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
    order = np.argsort(np.where(sees, ranges, np.inf), axis=1)
    middle = np.take_along_axis(order, np.maximum(sees.sum(axis=1, keepdims=True) - 1, 0) // 2, axis=1)[:, 0]
    return centres[np.where(sees.any(axis=1), middle, ranges.argmin(axis=1))]


def _slope_to_linear(display: np.ndarray) -> np.ndarray:
    """Return the derivative of `srgb_to_linear`."""
    return np.where(display <= DISPLAY_TOE, 1 / 12.92, 2.4 / 1.055 * ((np.maximum(display, 0) + 0.055) / 1.055) ** 1.4)


def _slope_to_srgb(light: np.ndarray) -> np.ndarray:
    """Return the derivative of `linear_to_srgb`."""
    return np.where(light <= LINEAR_TOE, 12.92, 1.055 / 2.4 * np.maximum(light, LINEAR_TOE) ** (1 / 2.4 - 1))
