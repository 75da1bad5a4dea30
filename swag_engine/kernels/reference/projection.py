"""3D Gaussians to 2D Gaussians on the image plane (EWA splatting, Zwicker et al. 2001), in torch, differentiable."""

import torch
from torch import Tensor

from ...base.camera_kind import CameraKind
from ..protocol import Projection

NEAR = 0.01
"""Depth below which centres are not drawn, scene units: the near plane."""
BLUR = 0.3
"""Added to the variances, pixel^2: a low-pass filter as in 3DGS, and it keeps covariances regular."""
GUARD = 0.3
"""Fraction of the field of view beyond the image's edges where the linearised projection stops changing, as in 3DGS."""
MAX_SIGMA = 1e4
"""Largest standard deviation, pixels: larger Gaussians are flat over any image."""
MIN_ALPHA = 1 / 255
"""Alpha below which a Gaussian is not drawn: one step of an 8-bit image."""
MAX_EXTENT = 128
"""Largest squared distance, in standard deviations, to where alpha falls below MIN_ALPHA; beyond it the opacity is
broken (1e25 or more) and the Gaussian is not drawn."""


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    channels: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    kind: CameraKind = "perspective",
) -> Projection:
    """Project 3D Gaussians onto the image plane, with gradients by the camera and through the depths, too.

    The orthographic projection is linear: the projected Gaussians are exact. Of a perspective camera x/z and y/z are
    held beyond the guard band, with zero derivative, in the Jacobian (not in the centre).

    Args:
        means: (N, 3) centres, scene units.
        quats: (N, 4) rotations wxyz, of any length.
        scales: (N, 3) standard deviations, scene units.
        opacities: (N,) in 0..1.
        channels: (N, C) values to blend.
        viewmat: (4, 4) world to camera.
        K: (3, 3) intrinsics, pixels.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        kind: The kind of camera.

    Returns:
        The projected Gaussians, as `Kernels.project` describes them.
    """
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    camera = means @ rotation.T + translation
    with torch.no_grad():
        finite = torch.isfinite(camera.sum(1) + quats.sum(1) + scales.sum(1) + channels.sum(1))
        usable = finite & (camera[:, 2] > NEAR)
    # Replacements go in before anything is computed: a where() after it would turn inf * 0 into a NaN gradient. All is
    # written out by component: a batch of small matrix products is slow.
    keep = usable[:, None]
    x, y, z = torch.where(keep, camera, camera.new_tensor([0.0, 0, 1])).unbind(1)
    quats = torch.where(keep, quats, quats.new_tensor([1.0, 0, 0, 0]))
    scales = torch.where(keep, scales, scales.new_ones(3))

    largest_sigma = MAX_SIGMA / torch.maximum(fx, fy)
    if kind == "orthographic":
        means2d = torch.stack([fx * x + cx, fy * y + cy], 1)
        row_x, row_y = [fx * rotation[0, i] for i in range(3)], [fy * rotation[1, i] for i in range(3)]
        largest_sigma = largest_sigma.expand_as(z)
    else:
        inverse_z = 1 / z
        x_over_z, y_over_z = x * inverse_z, y * inverse_z
        means2d = torch.stack([fx * x_over_z + cx, fy * y_over_z + cy], 1)
        guard_x, guard_y = GUARD * width / (2 * fx), GUARD * height / (2 * fy)
        x_over_z = x_over_z.clamp(-cx / fx - guard_x, (width - cx) / fx + guard_x)
        y_over_z = y_over_z.clamp(-cy / fy - guard_y, (height - cy) / fy + guard_y)
        # Rows of J R, with J the Jacobian of the projection: fx / z (R_0 - x/z R_2), fy / z (R_1 - y/z R_2).
        per_x, per_y = fx * inverse_z, fy * inverse_z
        row_x = [per_x * (rotation[0, i] - x_over_z * rotation[2, i]) for i in range(3)]
        row_y = [per_y * (rotation[1, i] - y_over_z * rotation[2, i]) for i in range(3)]
        largest_sigma = largest_sigma * z.detach()
    axes = _rotation_columns(quats)
    sigmas = torch.minimum(scales, largest_sigma.detach()[:, None]).unbind(1)
    # M = J R times the scaled axes (2, 3); the covariance is M M^T.
    mx = [(row_x[0] * a[0] + row_x[1] * a[1] + row_x[2] * a[2]) * s for a, s in zip(axes, sigmas, strict=True)]
    my = [(row_y[0] * a[0] + row_y[1] * a[1] + row_y[2] * a[2]) * s for a, s in zip(axes, sigmas, strict=True)]
    xx = mx[0] * mx[0] + mx[1] * mx[1] + mx[2] * mx[2]
    xy = mx[0] * my[0] + mx[1] * my[1] + mx[2] * my[2]
    yy = my[0] * my[0] + my[1] * my[1] + my[2] * my[2]
    # det(M M^T) as the sum of the squared minors (Cauchy-Binet): never negative, exact for needles.
    minors = [mx[i] * my[j] - mx[j] * my[i] for i, j in ((0, 1), (0, 2), (1, 2))]
    det = minors[0] * minors[0] + minors[1] * minors[1] + minors[2] * minors[2] + BLUR * (xx + yy) + BLUR * BLUR
    xx, yy = xx + BLUR, yy + BLUR
    inverse_det = 1 / det
    conics = torch.stack([yy * inverse_det, -xy * inverse_det, xx * inverse_det], 1)

    with torch.no_grad():
        extent = 2 * torch.log(opacities / MIN_ALPHA)  # squared, in sigmas
        radius_x, radius_y = (extent * xx).sqrt(), (extent * yy).sqrt()
        middle = (xx + yy) / 2
        largest = middle + (middle * middle - det).clamp(min=0).sqrt()
        u, v = means2d.unbind(1)
        drawn = usable & (extent > 0) & (extent < MAX_EXTENT) & (u + radius_x > 0) & (u - radius_x < width)
        drawn &= (v + radius_y > 0) & (v - radius_y < height) & torch.isfinite(largest)
        radii = torch.where(drawn, (extent * largest).sqrt(), 0)
    return Projection(means2d, conics, z, radii)


def _rotation_columns(quats: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Columns of the rotation matrices of `quats` (N, 4), which are normalised here; a zero quaternion is safe."""
    w, x, y, z = (quats * torch.rsqrt((quats * quats).sum(1, keepdim=True).clamp(min=1e-12))).unbind(1)
    return [
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]
