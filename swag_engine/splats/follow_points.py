"""Turn and scale splats along with points that another program moved. numpy only, Blender imports it.

Such a program knows positions but not sizes, rotations and spherical harmonics. The map that moved the points is found
from their positions before and after.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from .splats import Splats
from .transform import transformed

TOLERANCE = 1e-5
"""Largest distance of a point from where a map takes it, as a fraction of the largest coordinate."""
MIN_POINTS = 8
"""A map of fewer points counts only if it explains all that moved: four points fit any affine map."""
FIT_POINTS = 4096
"""Points from which a map is fitted; more make it no more exact than float32 positions are."""


def follow_points(splats: Splats, shaped_at: np.ndarray) -> tuple[Splats, np.ndarray]:
    """Apply to sizes, rotations and spherical harmonics the affine maps that moved the points.

    Points may have been moved by several maps, each of them on a part of the rows in one piece or on the rows that
    another map left where they were, as after joining objects.

    Args:
        splats: with the positions after the move.
        shaped_at: (N, 3) float32 positions before it, for which sizes, rotations and harmonics are right.

    Returns:
        The splats, and the rows (M,) that no affine map explains, which are as before.
    """
    rows = np.flatnonzero((splats.positions != shaped_at).any(axis=1))
    if not len(rows):
        return splats, rows
    rotations, scales, sh = splats.rotations.copy(), splats.scales.copy(), splats.sh.copy()
    unexplained = np.zeros(len(splats), bool)
    for part, matrix in _affine_parts(shaped_at[rows], splats.positions[rows]):
        chosen = rows[part]
        if matrix is None:
            unexplained[chosen] = True
        elif not np.allclose(matrix[:3, :3], np.eye(3), atol=TOLERANCE):
            mask = np.zeros(len(splats), bool)
            mask[chosen] = True
            made = transformed(splats.subset(mask), matrix)
            rotations[mask], scales[mask], sh[mask] = made.rotations, made.scales, made.sh
    return replace(splats, rotations=rotations, scales=scales, sh=sh), np.flatnonzero(unexplained)


def _affine_parts(before: np.ndarray, after: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
    """Split points into sets of one affine map (4, 4); the last set may have None."""
    rest = np.arange(len(before))
    while len(rest):
        size = len(rest)
        while True:
            matrix = _fit(before[rest[:size]], after[rest[:size]])
            fits = _residuals(matrix, before[rest], after[rest]) <= _tolerance(matrix, before[rest], after[rest])
            if fits.all() or (fits[:size].all() and fits.sum() >= MIN_POINTS):
                break
            if size < MIN_POINTS:
                yield rest, None
                return
            size //= 2
        if size < len(rest):  # exacter from all the points of this map
            matrix = _fit(before[rest[fits]], after[rest[fits]])
        yield rest[fits], matrix
        rest = rest[~fits]


def _residuals(matrix: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return np.abs(before @ matrix[:3, :3].T + matrix[:3, 3] - after).max(axis=1)


def _tolerance(matrix: np.ndarray, before: np.ndarray, after: np.ndarray) -> float:
    return TOLERANCE * max(np.abs(after).max(), np.abs(before).max() * np.linalg.norm(matrix[:3, :3], 2))


def _fit(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Fit the affine map (4, 4) by least squares; the similarity where points on a plane leave the map open."""
    step = -(-len(before) // FIT_POINTS)
    source, target = before[::step].astype(np.float64), after[::step].astype(np.float64)
    middle, to = source.mean(axis=0), target.mean(axis=0)
    source, target = source - middle, target - to
    stretches = np.linalg.svd(source, compute_uv=False)
    if len(stretches) == 3 and stretches[2] > 1e-4 * stretches[0]:
        linear = np.linalg.lstsq(source, target, rcond=None)[0].T
    else:
        linear = _similarity(source, target)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, to - linear @ middle
    return matrix


def _similarity(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Fit rotation times scale (3, 3) between centred points (Umeyama 1991)."""
    left, values, right = np.linalg.svd(target.T @ source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    variance = (source**2).sum()
    # One point, or points at one place, tell nothing but their shift.
    return (left * signs) @ right * ((values * signs).sum() / variance) if variance > 0 else np.eye(3)
