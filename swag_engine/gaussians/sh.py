"""Colour by direction: real spherical harmonics up to degree 3."""

import torch
from torch import Tensor

from ..kernels.backends import kernels_for

# Constants of the real spherical harmonics (Condon-Shortley phase included), in the order l, m = -l .. l, as 3DGS files
# have them. E.g. Y_00 = sqrt(1 / 4 pi).
C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Values (N, (degree + 1)^2) of the basis functions for unit `directions` (N, 3); degree 0 to 3."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, C0)]
    if degree >= 1:
        basis += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * zz - xx - yy), -C2[0] * x * z, C2[2] * (xx - yy)]
    if degree >= 3:
        basis += [
            -C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            -C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -C3[2] * x * (4 * zz - xx - yy),
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, -1)


def evaluate_sh(sh0: Tensor, shN: Tensor, directions: Tensor, degree: int, backend: str = "auto") -> Tensor:
    """Colours (N, 3) = max(0, 1/2 + sum_k sh_k Y_k(direction)), differentiable in all three.

    sh0 (N, 1, 3), shN (N, K - 1, 3): raw coefficients, the constant one apart; directions: (N, 3) unit, from the camera
    to the Gaussian; degree: 0 to 3, may be less than what shN holds. Signs and order are those of 3DGS files.
    """
    count = sh0.shape[1] + shN.shape[1]
    if not 0 <= degree <= 3 or count < (degree + 1) ** 2:
        raise ValueError(f"degree {degree} of 0 to 3 needs {(degree + 1) ** 2} coefficients, there are {count}")
    kernels = kernels_for(backend, sh0)
    # The kernels have no gradient by direction: training takes none.
    if kernels and not directions.requires_grad:
        return kernels.sh_colors(sh0, shN, directions, degree)
    basis = sh_basis(directions, degree)
    sh = torch.cat([sh0, shN[:, : basis.shape[1] - 1]], 1)
    return (0.5 + (basis[:, :, None] * sh).sum(1)).clamp(min=0)
