"""Color by direction: real spherical harmonics up to degree 3."""

from torch import Tensor

from ..kernels.backends import kernels_for


def evaluate_sh(sh0: Tensor, shN: Tensor, directions: Tensor, degree: int, backend: str = "auto") -> Tensor:
    """Evaluate max(0, 1/2 + sum_k sh_k Y_k(direction)), with signs and order of 3DGS files (arXiv 2308.04079).

    Args:
        sh0: (N, 1, 3) constant coefficients.
        shN: (N, K - 1, 3) the others.
        directions: (N, 3) unit vectors from the camera to the Gaussians.
        degree: Degree that is used, 0..3; may be less than what `shN` holds.
        backend: What computes, as in `kernels_for`.

    Returns:
        (N, 3) colors, differentiable in coefficients and directions.

    Raises:
        ValueError: There is no such degree, or there are too few coefficients for it.
    """
    count = sh0.shape[1] + shN.shape[1]
    if not 0 <= degree <= 3 or count < (degree + 1) ** 2:
        raise ValueError(f"degree {degree} of 0 to 3 needs {(degree + 1) ** 2} coefficients, there are {count}")
    return kernels_for(backend, sh0).sh_colors(sh0, shN, directions, degree)
