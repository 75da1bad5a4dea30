"""3D Gaussians to 2D Gaussians on the image plane (EWA splatting, Zwicker et al. 2001), in torch, differentiable."""

import torch
from torch import Tensor

from ..kernels.protocol import Projection

NEAR = 0.01  # scene units; nearer centres are not drawn
BLUR = 0.3  # px^2 added to the variances: a low-pass filter, and it keeps covariances regular
GUARD = 0.3  # part of the field of view beyond the image's edges where the linearised projection stops changing
MAX_SIGMA = 1e4  # px; larger Gaussians are flat over any image
MIN_ALPHA = 1 / 255
MAX_EXTENT = 128  # squared, in sigmas; an opacity that reaches farther is no number to draw with


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
) -> Projection:
    """Project means (N, 3), quats (N, 4) wxyz of any length, scales (N, 3) with viewmat (4, 4) and K (3, 3).

    Gaussians that are behind the near plane, off screen, fainter than 1/255 or not finite get radius 0 and no gradient.
    `opacities` (N,) bound the radii, `channels` (N, C) are only looked at for numbers that are not finite. Beyond the
    guard band x/z and y/z are held, with zero derivative, in the Jacobian (not in the centre).
    """
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    camera = means @ rotation.T + translation
    with torch.no_grad():
        finite = torch.isfinite(camera.sum(1) + quats.sum(1) + scales.sum(1) + channels.sum(1))
        usable = finite & (camera[:, 2] > NEAR)
    # Stand-ins go in before anything is computed: a where() after it would turn inf * 0 into a NaN gradient. All is
    # written out by component: a batch of small matrix products is slow.
    keep = usable[:, None]
    x, y, z = torch.where(keep, camera, camera.new_tensor([0.0, 0, 1])).unbind(1)
    quats = torch.where(keep, quats, quats.new_tensor([1.0, 0, 0, 0]))
    scales = torch.where(keep, scales, scales.new_ones(3))

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
    axes = _rotation_columns(quats)
    sigmas = torch.minimum(scales, (MAX_SIGMA / torch.maximum(fx, fy) * z.detach())[:, None]).unbind(1)
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
    """The columns of the rotation matrices of `quats` (N, 4), which are normalised here; a zero quaternion is safe."""
    w, x, y, z = (quats * torch.rsqrt((quats * quats).sum(1, keepdim=True).clamp(min=1e-12))).unbind(1)
    return [
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]
