"""Affine transforms of splats, colors included. numpy only, Blender imports it.

Everything is computed in float64 and rounded once to float32, except the product that rotates spherical harmonics.
"""

from collections.abc import Sequence

import numpy as np

from .splats import Splats

C0 = 0.28209479177387814
"""Constant spherical harmonic, 1 / (2 sqrt(pi))."""


def transformed(splats: Splats, matrix: np.ndarray) -> Splats:
    """Apply an affine map to splats.

    Covariances become A Sigma A^T with A = matrix[:3, :3]. Colors rotate with the splats, so that a camera that is
    transformed along sees the same. Under an uneven scale or a shear, which no finite degree of spherical harmonics can
    follow exactly, they rotate with the orthogonal factor of the polar decomposition of A.

    Args:
        splats: Splats to transform.
        matrix: (4, 4), which multiplies column vectors from the left.

    Returns:
        The transformed splats, with the same opacities, extras and development, and without a placement. Their
        origin is transformed as a direction is.

    Raises:
        ValueError: If the matrix is not finite or not affine.
    """
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise ValueError("a transform must be a finite affine matrix of shape (4, 4)")
    linear = matrix[:3, :3]
    x, y, z = (linear @ splats.origin).tolist()
    positions = (splats.positions @ linear.T + matrix[:3, 3]).astype(np.float32)
    left, stretches, right = np.linalg.svd(linear)
    rotation = left @ right  # orthogonal; a reflection when the matrix mirrors
    if stretches[0] - stretches[2] <= 1e-7 * stretches[0]:
        # A Gaussian is symmetric about its centre, so a reflection acts on it as the rotation -reflection does.
        proper = rotation * np.sign(np.linalg.det(rotation))
        rotations = splats.rotations @ _left_product(quaternions(proper)).T
        scales = splats.scales * stretches.mean()
    else:
        variances, axes = np.linalg.eigh(linear @ covariances(splats) @ linear.T)
        axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
        rotations = quaternions(axes)
        scales = np.sqrt(np.maximum(variances, 0))
    count, coefficients = splats.sh.shape[:2]
    # One product of (N, 3K) with (3K, 3K): much faster than N small ones.
    mixing = np.kron(sh_rotation(rotation, splats.degree), np.eye(3)).astype(np.float32)
    return Splats(
        positions,
        rotations.astype(np.float32),
        scales.astype(np.float32),
        splats.opacities,
        (splats.sh.reshape(count, coefficients * 3) @ mixing.T).reshape(splats.sh.shape),
        splats.extras,
        development=splats.development,
        origin=(x, y, z),
    )


def covariances(splats: Splats) -> np.ndarray:
    """Return Sigma = R diag(scales^2) R^T of each splat, (N, 3, 3) float64, world units squared."""
    factor = rotation_matrices(splats.rotations) * splats.scales.astype(np.float64)[:, None, :]
    return factor @ factor.transpose(0, 2, 1)


def rotation_matrices(rotations: np.ndarray) -> np.ndarray:
    """Convert unit quaternions (..., 4) wxyz to rotation matrices (..., 3, 3) float64."""
    w, x, y, z = np.moveaxis(np.asarray(rotations, np.float64), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (..., 3, 3) to unit quaternions (..., 4) wxyz float64, largest component positive."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(np.asarray(matrices, np.float64), (-2, -1), (0, 1))
    # 4 q q^T from the matrix; its row with the largest diagonal is q times a number well away from zero.
    products = np.stack(
        [
            np.stack([1 + xx + yy + zz, zy - yz, xz - zx, yx - xy], axis=-1),
            np.stack([zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx], axis=-1),
            np.stack([xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy], axis=-1),
            np.stack([yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz], axis=-1),
        ],
        axis=-2,
    )
    largest = np.diagonal(products, axis1=-2, axis2=-1).argmax(axis=-1)
    rows = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Evaluate the real spherical harmonics of 3D Gaussian Splatting (Kerbl et al. 2023), with Condon-Shortley phase.

    Args:
        directions: (M, 3), of unit length, from the camera centre to the splat.
        degree: 0 to 3.

    Returns:
        Values (M, (degree + 1)^2) float64, constant term first.
    """
    x, y, z = np.asarray(directions, np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    basis = [np.full_like(x, C0)]
    if degree > 0:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree > 2:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return np.stack(basis, axis=1)


def sh_rotation(rotation: np.ndarray, degree: int) -> np.ndarray:
    """Make the matrix that rotates spherical-harmonic coefficients.

    Each degree maps to itself, so its block follows exactly, by least squares, from values in more directions than it
    has coefficients.

    Args:
        rotation: (3, 3) orthogonal matrix, a rotation or a reflection.
        degree: 0 to 3.

    Returns:
        Matrix (K, K) float64, K = (degree + 1)^2, from the coefficients of f(d) to those of f(rotation^-1 d).
    """
    # A spiral of directions, uniform over the sphere and without symmetry.
    steps = np.arange(32)
    height, angle = (2 * steps + 1) / 32 - 1, steps * np.pi * (3 - 5**0.5)
    radius = np.sqrt(1 - height**2)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    after, before = sh_basis(directions, degree), sh_basis(directions @ rotation, degree)
    result = np.zeros(((degree + 1) ** 2,) * 2)
    for band in range(degree + 1):
        block = slice(band**2, (band + 1) ** 2)
        result[block, block] = np.linalg.lstsq(after[:, block], before[:, block], rcond=None)[0]
    result[np.abs(result) < 1e-12] = 0  # so that rotations by multiples of 90 degrees are exact
    return result


def rotation_to_y_up(up: Sequence[float] | np.ndarray) -> np.ndarray:
    """Make the rotation from axes with any up direction to axes with y up.

    Args:
        up: Up direction (3,), of any length.

    Returns:
        Matrix (3, 3) float64 that takes `up` to y: by 180 degrees around x first where `up` points below, then by the
        smallest angle.

    Raises:
        ValueError: If `up` is not three finite numbers, or is zero.
    """
    direction = np.asarray(up, np.float64)
    length = np.linalg.norm(direction)
    if direction.shape != (3,) or not np.isfinite(length) or not length:
        raise ValueError(f"up must be a direction of three numbers, got {up}")
    flip = np.diag([1.0, -1.0, -1.0]) if direction[1] < 0 else np.eye(3)
    x, y, z = flip @ direction / length
    cross = np.array([[0, -x, 0], [x, 0, z], [0, -z, 0]])  # of the axis, direction x (0, 1, 0) = (-z, 0, x)
    return (np.eye(3) + cross + cross @ cross / (1 + y)) @ flip


def _left_product(quaternion: np.ndarray) -> np.ndarray:
    """Return the matrix (4, 4) that multiplies a quaternion wxyz by `quaternion` from the left."""
    w, x, y, z = quaternion
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
