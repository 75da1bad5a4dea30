"""The water of a run, put back into colours. numpy only, Blender's Python imports it.

Water dims and veils by distance, so it belongs to a view and not to a place; a splat file has no room for it. What can
be done: give each splat the colour that it had where it was photographed from. The model is water/medium.py's.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..base.transfer import DISPLAY_TOE, LINEAR_TOE, linear_to_srgb, srgb_to_linear
from ..scene.cameras import Camera
from ..splats.splats import Splats
from ..splats.transform import sh_basis, sh_rotation

C0 = 0.28209479177387814
# Splats handled at a time: each is held against every camera.
BLOCK = 8192
DAMAGED = "water.json does not hold the coefficients of a water; train the run again."
# Display colours (N, 3) at ranges (N, 1) in directions (N, 3) -> as seen, and how much a change of them is seen.
View = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def baked(
    splats: Splats, water: dict[str, Any], cameras: Sequence[Camera], amount: float = 1.0, metres_per_unit: float = 0.0
) -> Splats:
    """The splats with `amount` (0..1) of the `water`, the contents of a run's water.json, in their colours.

    Each splat is seen by that of the `cameras` (at least one) that has it in its picture at the median range; by the
    nearest where none has. Seen from that camera it is exactly as through the water (a water network's is the mean over
    all directions); the change with direction is carried over to first order. metres_per_unit: of the splats' space,
    for water per metre. Raises InputError when the water is not as a run writes it.
    """
    view = _view(water, amount, metres_per_unit)
    sh = np.empty_like(splats.sh)
    for start in range(0, len(splats), BLOCK):
        part = slice(start, start + BLOCK)
        positions = splats.positions[part].astype(np.float64)
        offsets = positions - _seen_from(positions, cameras)
        ranges = np.linalg.norm(offsets, axis=1, keepdims=True)
        directions = offsets / np.maximum(ranges, np.finfo(np.float64).tiny)
        own = np.einsum("nk,nkc->nc", sh_basis(directions, splats.degree), splats.sh[part]) + 0.5
        seen, slope = view(np.maximum(own, 0), ranges, directions)
        # seen + slope (colour in another direction - colour in this one), as coefficients again.
        sh[part] = slope[:, None] * splats.sh[part]
        sh[part, 0] += (seen - 0.5 + slope * (0.5 - own)) / C0
    return Splats(splats.positions, splats.rotations, splats.scales, splats.opacities, sh, splats.extras)


def placed(
    water: dict[str, Any], turn: np.ndarray, scale: float, metres_per_unit: float, in_metres: bool
) -> dict[str, Any]:
    """water.json for splats turned by the rotation (3, 3) and scaled; `in_metres`: their unit is a metre now."""
    # The water's unit of length in the file's.
    length = scale * _units(water, metres_per_unit)
    changed: dict[str, Any] = {}
    try:
        for name in ("beta_D", "beta_B"):
            changed[name] = (_array(water, name, (3,)) / length).tolist()
        if "ranges" in water:
            changed["ranges"] = (_array(water, "ranges", (len(water["ranges"]),)) * length).tolist()
        if "veil_sh" in water:
            changed["veil_sh"] = (sh_rotation(turn, 2) @ _array(water, "veil_sh", (9, 3))).tolist()
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(DAMAGED) from error
    return water | changed | {"per": "metre" if in_metres else "unit"}


def _units(water: dict[str, Any], metres_per_unit: float) -> float:
    """Scene units in the water's unit of length."""
    if water.get("per") != "metre":
        return 1.0
    if not metres_per_unit:
        raise InputError("The water is per metre and the run does not know how long a metre is; train it again.")
    return 1 / metres_per_unit


def _view(water: dict[str, Any], amount: float, metres_per_unit: float) -> View:
    """What `amount` of the water does, in scene units: water/medium.py's formula, or water/network.py's."""
    unit = _units(water, metres_per_unit)
    try:
        if "veil_sh" in water:
            veil_sh = _array(water, "veil_sh", (9, 3))
            beta_D, beta_B = (_array(water, name, (3,)) * amount / unit for name in ("beta_D", "beta_B"))
            linear = {"linear": True, "srgb": False}[water["light"]]
        else:
            ranges = _array(water, "ranges", (len(water["ranges"]),)) * unit
            transmission, backscatter = (
                _array(water, name, (len(ranges), 3)) for name in ("transmission", "backscatter")
            )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(DAMAGED) from error

    def by_coefficients(color: np.ndarray, ranges: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        dimmed = np.exp(-beta_D * ranges)
        veil = amount / (1 + np.exp(-sh_basis(directions, 2) @ veil_sh))
        light = (srgb_to_linear(color) if linear else color) * dimmed - veil * np.expm1(-beta_B * ranges)
        if not linear:
            return light, dimmed
        return linear_to_srgb(light), dimmed * _light_slope(color) * _display_slope(light)

    def by_table(color: np.ndarray, here: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        dimmed, veil = (
            np.stack([np.interp(here[:, 0], ranges, column) for column in table.T], axis=1)
            for table in (transmission, backscatter)
        )
        return color * dimmed**amount + amount * veil, dimmed**amount

    return by_coefficients if "veil_sh" in water else by_table


def _array(water: dict[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    try:
        values = np.array(water[name], np.float64)
    except OverflowError:
        raise ValueError(f"{name} has a number that is too large") from None
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{name} has another shape")
    return values


def _seen_from(positions: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """For each position (N, 3) the centre (3,) of the camera that looks at it from the median range."""
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


def _light_slope(display: np.ndarray) -> np.ndarray:
    return np.where(display <= DISPLAY_TOE, 1 / 12.92, 2.4 / 1.055 * ((np.maximum(display, 0) + 0.055) / 1.055) ** 1.4)


def _display_slope(light: np.ndarray) -> np.ndarray:
    return np.where(light <= LINEAR_TOE, 12.92, 1.055 / 2.4 * np.maximum(light, LINEAR_TOE) ** (1 / 2.4 - 1))
