"""Alignment of two surveys of one place by what did not change: robust iterative closest points on splats' centres."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..base.errors import InputError
from ..splats.splats import Splats
from ..splats.transform import C0

SOLID = 0.5
"""Least opacity of splats that are compared."""
POINTS = 20_000
"""Largest number of splats of a survey that are compared."""
FEW = 1500
"""Number of splats with which orientations are tried."""
NEIGHBOURS = 10
"""Neighbours that a normal is fitted to."""
ORIENTATIONS = 36
"""Directions around the vertical that are tried where the frames have nothing else in common."""
SCALES = (0.8, 0.9, 1.0, 1.1, 1.25)
"""Scales that are tried where it is free, relative to the ratio of the sizes."""
CELLS = 64
"""Cells along each edge of the maps of color that the shift of a direction is found from."""
TRIALS = 12
"""Guesses that are tried, those at which maps of color agree best."""
TRIAL_ROUNDS, ROUNDS = 12, 60
STOP = 1e-6
"""Change of the transform, relative to the size of the place, at which the search ends."""
TUKEY = 4.685
"""Residual at which Tukey's biweight is 0, in standard deviations: 95 % efficiency (Holland and Welsch 1977)."""
COLOR = 2.0
"""Distance, in spacings of the splats, that one standard deviation of color counts as."""
SLIDING = 0.05
"""Weight of distances along the surface, relative to those across it: keeps flat places from sliding."""
KEPT = 0.7
"""Fraction of the nearest matches that an orientation is judged by."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Similarity from one survey to the other, and how well it fits.

    Attributes:
        matrix: (4, 4), which multiplies column vectors from the left.
        scale: Its scale.
        residual: Robust standard deviation of the distances between the surfaces, length units.
        static: Fraction of the splats that agree with it, 0 to 1.
        points: Number of splats that were compared.
    """

    matrix: np.ndarray
    scale: float
    residual: float
    static: float
    points: int


def align(moving: Splats, fixed: Splats, initial: np.ndarray | None, free_scale: bool, seed: int = 0) -> Alignment:
    """Find the similarity that takes a survey to another one; both have z up.

    Args:
        moving: The survey that is moved.
        fixed: The other one.
        initial: First guess (4, 4) where both are georeferenced; without it the frames as they are, which targets on
            the ground may have measured, and all directions around the vertical are tried.
        free_scale: Whether the scale is found, too.
        seed: Of the random choice of splats.

    Returns:
        The alignment.

    Raises:
        InputError: If there are too few solid splats.
    """
    random = np.random.default_rng(seed)
    points, colors = _sample(moving, random)
    targets, target_colors = _sample(fixed, random)
    tree = cKDTree(targets)
    distances, nearest = tree.query(targets, NEIGHBOURS + 1)
    spacing = float(np.median(distances[:, 1])) or 1e-9
    normals = _normals(targets[nearest])
    colored = cKDTree(np.concatenate([targets, COLOR * spacing * target_colors], axis=1))
    if initial is None:
        guesses = [np.eye(4), *_guesses(points, colors, targets, target_colors, free_scale)]
        few = random.permutation(len(points))[:FEW]
        tried = []
        for guess in guesses:
            # With a free scale a wrong guess would shrink to where all is near.
            matrix = _iterate(points[few], colors[few], guess, targets, normals, colored, spacing, False, TRIAL_ROUNDS)
            tried.append((_score(points[few], colors[few], matrix, colored, spacing), matrix))
        initial = min(tried, key=lambda pair: pair[0])[1]
    matrix = _iterate(points, colors, initial, targets, normals, colored, spacing, free_scale, ROUNDS)
    across = _across(points, colors, matrix, targets, normals, colored, spacing)[0]
    residual = 1.4826 * float(np.median(np.abs(across)))
    static = float((np.abs(across) < TUKEY * max(residual, 1e-12)).mean())
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return Alignment(matrix, scale, residual, static, len(points))


def _sample(splats: Splats, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions (M, 3) and standardised colors (M, 3), which other light or water does not change, of solid splats."""
    solid = np.flatnonzero(splats.opacities >= SOLID)
    if len(solid) < 10 * NEIGHBOURS:
        raise InputError(f"There are only {len(solid)} solid splats: too few to align two surveys.")
    chosen = random.permutation(solid)[:POINTS]
    colors = 0.5 + C0 * splats.sh[chosen, 0].astype(np.float64)
    colors = (colors - np.median(colors, axis=0)) / np.maximum(colors.std(axis=0), 1e-3)
    return splats.positions[chosen].astype(np.float64), np.clip(colors, -3, 3)


def _normals(groups: np.ndarray) -> np.ndarray:
    """Normals (M, 3) of planes through groups (M, K, 3) of points."""
    centred = groups - groups.mean(axis=1, keepdims=True)
    return np.linalg.eigh(centred.transpose(0, 2, 1) @ centred)[1][:, :, 0]


def _guesses(
    points: np.ndarray, colors: np.ndarray, targets: np.ndarray, target_colors: np.ndarray, free_scale: bool
) -> list[np.ndarray]:
    """Return transforms (4, 4) turned around the vertical, each with the shift at which maps of color agree best."""
    guesses: list[tuple[float, np.ndarray]] = []
    middle, target = np.median(points, axis=0), np.median(targets, axis=0)
    reach = [
        np.quantile(np.linalg.norm((one - of)[:, :2], axis=1), KEPT)
        for one, of in ((points, middle), (targets, target))
    ]
    for scale in float(reach[1] / reach[0]) * np.array(SCALES) if free_scale else (1.0,):
        cell = 4 * float(max(reach[1], scale * reach[0])) / CELLS
        fixed = _color_spectrum(targets - target, target_colors, cell)
        for angle in 2 * np.pi * np.arange(ORIENTATIONS) / ORIENTATIONS:
            matrix = np.eye(4)
            matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            matrix[:3, :3] *= scale
            turned = _color_spectrum((points - middle) @ matrix[:3, :3].T, colors, cell)
            agreement = np.fft.ifft2((turned * fixed.conj()).sum(axis=0)).real
            best = np.array(np.unravel_index(agreement.argmax(), agreement.shape))
            shift = -cell * ((best + CELLS) % (2 * CELLS) - CELLS)
            matrix[:3, 3] = target + [*shift, 0] - matrix[:3, :3] @ middle
            guesses.append((-agreement.max() / (np.linalg.norm(turned) * np.linalg.norm(fixed) + 1e-12), matrix))
    return [matrix for _, matrix in sorted(guesses, key=lambda pair: pair[0])[:TRIALS]]


def _color_spectrum(points: np.ndarray, colors: np.ndarray, cell: float) -> np.ndarray:
    """Fourier transform (3, 2 CELLS, 2 CELLS) of the mean colors in cells about the origin, with empty cells around."""
    places = np.floor(points[:, :2] / cell).astype(np.int64) + CELLS // 2
    inside = ((places >= 0) & (places < CELLS)).all(axis=1)
    number = places[inside] @ [2 * CELLS, 1]
    counts = np.bincount(number, minlength=4 * CELLS**2)
    sums = [np.bincount(number, channel, 4 * CELLS**2) for channel in colors[inside].T]
    return np.fft.fft2((np.stack(sums) / np.maximum(counts, 1)).reshape(3, 2 * CELLS, 2 * CELLS))


def _across(
    points: np.ndarray,
    colors: np.ndarray,
    matrix: np.ndarray,
    targets: np.ndarray,
    normals: np.ndarray,
    colored: cKDTree,
    spacing: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Match moved points; return distances across the surface, offsets, moved points and normals."""
    moved = points @ matrix[:3, :3].T + matrix[:3, 3]
    _, nearest = colored.query(np.concatenate([moved, COLOR * spacing * colors], axis=1))
    offsets = moved - targets[nearest]
    return (offsets * normals[nearest]).sum(axis=1), offsets, moved, normals[nearest]


def _iterate(
    points: np.ndarray,
    colors: np.ndarray,
    matrix: np.ndarray,
    targets: np.ndarray,
    normals: np.ndarray,
    colored: cKDTree,
    spacing: float,
    free_scale: bool,
    rounds: int,
) -> np.ndarray:
    """Minimise distances across the surface (Chen and Medioni 1992) with Tukey's weights; a little, those along it."""
    size = float(np.linalg.norm(targets.std(axis=0)))
    for _ in range(rounds):
        across, offsets, moved, facing = _across(points, colors, matrix, targets, normals, colored, spacing)
        lengths = np.linalg.norm(offsets, axis=1)
        weights = _tukey(across) * _tukey(lengths)
        middle = np.average(moved, axis=0, weights=weights + 1e-12)
        centred = moved - middle
        zero = np.zeros(len(centred))
        x, y, z = centred.T
        ones, columns = np.ones(len(centred)), []
        # Derivatives of each coordinate by turn (3), shift (3) and scale.
        columns = np.stack(
            [
                np.stack([zero, z, -y, ones, zero, zero, x], axis=1),
                np.stack([-z, zero, x, zero, ones, zero, y], axis=1),
                np.stack([y, -x, zero, zero, zero, ones, z], axis=1),
            ],
            axis=1,
        )
        columns = columns if free_scale else columns[:, :, :6]
        along_normal = np.einsum("nd,ndp->np", facing, columns)
        normal = (along_normal * weights[:, None]).T @ along_normal
        normal += SLIDING * np.einsum("ndp,n,ndq->pq", columns, weights, columns)
        right = along_normal.T @ (weights * across) + SLIDING * np.einsum("ndp,n,nd->p", columns, weights, offsets)
        step = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(len(normal)), right)
        change = _small_similarity(step, middle)
        matrix = change @ matrix
        if np.abs(step[:3]).max() + np.abs(step[3:6]).max() / size < STOP:
            break
    return matrix


def _tukey(residuals: np.ndarray) -> np.ndarray:
    limit = TUKEY * 1.4826 * max(float(np.median(np.abs(residuals))), 1e-12)
    return np.maximum(1 - (residuals / limit) ** 2, 0) ** 2


def _small_similarity(step: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """The similarity (4, 4) about `middle` with a rotation vector, a shift and a logarithm of scale."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() * (np.exp(step[6]) if len(step) > 6 else 1.0)
    matrix[:3, 3] = middle + step[3:6] - matrix[:3, :3] @ middle
    return matrix


def _score(points: np.ndarray, colors: np.ndarray, matrix: np.ndarray, colored: cKDTree, spacing: float) -> float:
    """Mean distance, color included, of the nearest matches."""
    moved = points @ matrix[:3, :3].T + matrix[:3, 3]
    distances, _ = colored.query(np.concatenate([moved, COLOR * spacing * colors], axis=1))
    return float(np.sort(distances)[: int(KEPT * len(distances))].mean())
