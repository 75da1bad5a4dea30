"""Splats as numpy arrays, as files hold them and Blender shows them. numpy only, Blender imports it."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import isqrt
from pathlib import Path

import numpy as np

from ..base.errors import InputError
from ..scene.georeference import Placement
from .development import SplatDevelopment

log = logging.getLogger(__name__)

LEAST_VARIANCE = 0.1
"""Least variance of a trained splat along each axis, squared pixels of the training image that samples it most finely:
half that of the 3D smoothing filter of Mip-Splatting (Yu et al. 2024, arXiv 2311.16493), which costs quality at the
training width (benchmarks/zoom.py)."""


@dataclass(eq=False)
class Splats:
    """N anisotropic Gaussians with view-dependent color, every value after its activation.

    Attributes:
        positions: (N, 3) float32, world units.
        rotations: (N, 4) float32, unit quaternions wxyz, from the Gaussian's axes to the world.
        scales: (N, 3) float32, standard deviation along each axis, world units (not their logarithm).
        opacities: (N,) float32, 0..1 (not their logit).
        sh: (N, K, 3) float32, spherical-harmonic coefficients of R, G, B, constant term first; K = 1, 4, 9 or 16 for
            degree 0 to 3. Color = .5 + sum of coefficient times basis (`transform.sh_basis`).
        extras: Name -> (N,) numbers of any real, integer or bool dtype, such as label or similarity.
        placement: Where the positions lie on the Earth: they are then in metres with z up, and their coordinates are
            positions + offset in double precision. None in any other frame.
        development: Development of restored colors that a file of these splats names. None where it is not known.
        origin: What was subtracted from the coordinates, three doubles: those of the scene or the file that the splats
            are from are positions + origin. Zero unless they are far from zero.

    Raises:
        ValueError: If a shape or a dtype is another.
    """

    positions: np.ndarray
    rotations: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    extras: dict[str, np.ndarray] = field(default_factory=dict)
    placement: Placement | None = None
    development: SplatDevelopment | None = None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        count = len(self.positions)
        coefficients = self.sh.shape[1] if self.sh.ndim == 3 else 0
        if coefficients not in (1, 4, 9, 16):
            raise ValueError(f"sh must have shape (N, 1|4|9|16, 3), got {self.sh.shape}")
        shapes = {
            "positions": (count, 3),
            "rotations": (count, 4),
            "scales": (count, 3),
            "opacities": (count,),
            "sh": (count, coefficients, 3),
        }
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape or array.dtype != np.float32:
                raise ValueError(f"{name} must be float32 of shape {shape}, got {array.dtype} of shape {array.shape}")
        for name, array in self.extras.items():
            if array.shape != (count,) or array.dtype.kind not in "biuf":
                raise ValueError(f"extra '{name}' must be {count} numbers, got {array.dtype} of shape {array.shape}")

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return isqrt(self.sh.shape[1]) - 1

    def subset(self, chosen: np.ndarray) -> "Splats":
        """Return some of the splats.

        Args:
            chosen: Mask (N,) bool, or indices (M,).
        """
        return Splats(
            self.positions[chosen],
            self.rotations[chosen],
            self.scales[chosen],
            self.opacities[chosen],
            self.sh[chosen],
            {name: array[chosen] for name, array in self.extras.items()},
            self.placement,
            self.development,
            self.origin,
        )


def concatenate(parts: Sequence[Splats]) -> Splats:
    """Join splats.

    Args:
        parts: At least one.

    Returns:
        All splats; spherical harmonics and extras that a part lacks are zero for its splats. They have a placement, and
        a development, where all parts have the same. Their origin is that of the first part.
    """
    if len(parts) == 1:
        return parts[0]
    origin = np.array(parts[0].origin)
    apart = [np.array(part.origin) - origin for part in parts]
    ends = np.cumsum([len(part) for part in parts])
    places = [slice(end - len(part), end) for end, part in zip(ends, parts, strict=True)]
    sh = np.zeros((ends[-1], max(part.sh.shape[1] for part in parts), 3), np.float32)
    kinds: dict[str, np.dtype] = {}
    for place, part in zip(places, parts, strict=True):
        sh[place, : part.sh.shape[1]] = part.sh
        for name, values in part.extras.items():
            kinds[name] = np.promote_types(kinds.get(name, values.dtype), values.dtype)
    extras = {name: np.zeros(ends[-1], kind) for name, kind in kinds.items()}
    for place, part in zip(places, parts, strict=True):
        for name, values in part.extras.items():
            extras[name][place] = values
    return Splats(
        np.concatenate([part.positions + shift.astype("f4") for part, shift in zip(parts, apart, strict=True)]),
        np.concatenate([part.rotations for part in parts]),
        np.concatenate([part.scales for part in parts]),
        np.concatenate([part.opacities for part in parts]),
        sh,
        extras,
        parts[0].placement if all(part.placement == parts[0].placement for part in parts) else None,
        parts[0].development if all(part.development == parts[0].development for part in parts) else None,
        parts[0].origin,
    )


def clean_splats(splats: Splats, path: Path) -> Splats:
    """Normalise quaternions, and drop splats with a NaN or an infinity.

    Quaternions of length 0 become no rotation, as in 3DGS renderers. A NaN or an infinity in an extra becomes 0. The
    numbers of dropped splats and of changed values are logged.

    Args:
        splats: Splats as they were read.
        path: The file that they were read from, for messages.

    Returns:
        The splats that can be shown.

    Raises:
        InputError: If there are none.
    """
    lengths = np.linalg.norm(splats.rotations.astype(np.float64), axis=1)
    rotations = splats.rotations.copy()
    scaled = (np.abs(lengths - 1) > 1e-6) & (lengths > 0) & np.isfinite(lengths)  # the others stay the same to the bit
    rotations[scaled] = rotations[scaled] / lengths[scaled, None]
    rotations[lengths == 0] = (1, 0, 0, 0)
    extras = dict(splats.extras)
    for name, values in splats.extras.items():
        if wrong := len(values) - int(np.isfinite(values).sum()):
            extras[name] = np.where(np.isfinite(values), values, 0).astype(values.dtype)
            log.warning("%s: %d values of %s are a NaN or an infinity and were read as 0", path, wrong, name)
    splats = replace(splats, rotations=rotations, extras=extras)

    finite = np.isfinite(splats.opacities)
    for array in (splats.positions, rotations, splats.scales, splats.sh.reshape(len(splats), splats.sh.shape[1] * 3)):
        finite &= np.isfinite(array).all(axis=1)
    if not finite.any():
        raise InputError(f"{path} holds no splat with finite numbers; write it again with the program that made it.")
    if finite.all():
        return splats
    log.warning("%s: %d of %d splats hold a NaN or an infinity and were dropped", path, (~finite).sum(), len(splats))
    return splats.subset(finite)
