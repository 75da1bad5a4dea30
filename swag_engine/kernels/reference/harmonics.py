"""Real spherical harmonics up to degree 3."""

import torch
from torch import Tensor

# Constants of the real spherical harmonics (Condon-Shortley phase included), in the order l, m = -l .. l, as 3DGS files
# have them.
C0 = 0.28209479177387814
"""Y_00 = sqrt(1 / (4 pi)); no unit."""
C1 = 0.4886025119029199
"""sqrt(3 / (4 pi)), of degree 1."""
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
"""sqrt(15 / (4 pi)), sqrt(5 / (16 pi)), sqrt(15 / (16 pi)), of degree 2."""
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
"""sqrt(35 / (32 pi)), sqrt(105 / (4 pi)), sqrt(21 / (32 pi)), sqrt(7 / (16 pi)), sqrt(105 / (16 pi)), of degree 3."""


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate the basis functions.

    Args:
        directions: (N, 3) unit vectors.
        degree: Highest degree, 0..3.

    Returns:
        (N, (degree + 1)^2) values in the order l, m = -l .. l.
    """
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
