"""Gaussians to pixels: differentiable functions over all backends."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..base.camera_kind import CameraKind
from ..kernels.backends import kernels_for

MAX_SCORED = 8
"""Largest number of channels that `contributions` takes: what the kernels hold in registers."""


@dataclass
class Rendering:
    """A rendered image and where its N Gaussians are on it.

    Attributes:
        channels: (H, W, C) blended channels over the background, differentiable.
        alpha: (H, W) = 1 - final transmittance, differentiable.
        means2d: (N, 2) projected centres, pixels, with pixel centres at +0.5; keeps its gradient when it has one.
        radii: (N,) extent, pixels, 0 where a Gaussian is not visible; no gradient.
    """

    channels: Tensor
    alpha: Tensor
    means2d: Tensor
    radii: Tensor


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    channels: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor,
    backend: str = "auto",
    kind: CameraKind = "perspective",
) -> Rendering:
    """Render Gaussians with any number of channels.

    `kernels.protocol.Kernels` has the formulas of projection and blending. All tensors have one floating dtype and are
    on one device. Gaussians with NaN or infinite parameters are not drawn and get zero gradients.

    Args:
        means: (N, 3) centres, scene units.
        quats: (N, 4) rotations wxyz, of any length.
        scales: (N, 3) standard deviations along the Gaussian's axes, scene units.
        opacities: (N,) in 0..1.
        channels: (N, C) values to blend.
        viewmat: (4, 4) world to camera (x right, y down, z forward).
        K: (3, 3) intrinsics, pixels.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        background: (C,) values behind all Gaussians.
        backend: What computes, as in `kernels_for`.
        kind: The kind of camera, as in `Kernels.project`.

    Returns:
        The image, with gradients by the five tensors of the Gaussians, by the camera and by the background.

    Raises:
        ValueError: A tensor has the wrong shape, dtype or device.
        InputError: The backend cannot run here.
        TooManyPairs: The Gaussians meet too many tiles.
    """
    _check(means, quats, scales, opacities, channels, viewmat, K, width, height, background)
    kernels = kernels_for(backend, means)
    projected = kernels.project(means, quats, scales, opacities, channels, viewmat, K, width, height, kind)
    if projected.means2d.requires_grad:
        projected.means2d.retain_grad()
    blended, alpha = kernels.blend(projected, opacities, channels, background, width, height)
    return Rendering(blended, alpha, projected.means2d, projected.radii)


@dataclass
class Contributions:
    """What each of N Gaussians does to one image; no gradients.

    With g = exp(-s) the value of the projected Gaussian at a pixel (alpha = opacity g), dC/dg is the image's change
    by it, opacity T (channel - color behind the Gaussian), 0 where alpha is clamped. Importance and error are those
    of SWAGSplatting's relocation (docs/method.md, section 6).

    Attributes:
        weighted: (N, R) sums over all pixels of T alpha times each weight image.
        importance: (N,) sums of |dC/dg|^2.
        error: (N,) sums of (image_gradient . dC/dg)^2.
    """

    weighted: Tensor
    importance: Tensor
    error: Tensor


@torch.no_grad()
def contributions(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    channels: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor,
    weights: Tensor | None = None,
    image_gradient: Tensor | None = None,
    backend: str = "auto",
    kind: CameraKind = "perspective",
) -> Contributions:
    """Sum what each Gaussian does to the image that `rasterize` makes of the same arguments, in one pass over it.

    Args:
        means: (N, 3) centres, scene units.
        quats: (N, 4) rotations wxyz, of any length.
        scales: (N, 3) standard deviations along the Gaussian's axes, scene units.
        opacities: (N,) in 0..1.
        channels: (N, C) values to blend; C is at most MAX_SCORED.
        viewmat: (4, 4) world to camera.
        K: (3, 3) intrinsics, pixels.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        background: (C,) values behind all Gaussians.
        weights: (H, W, R) images that the sums of T alpha are weighted with; none by default.
        image_gradient: (H, W, C) gradient of a loss by the channels; 0 by default.
        backend: What computes, as in `kernels_for`.
        kind: The kind of camera, as in `Kernels.project`.

    Returns:
        The sums.

    Raises:
        ValueError: A tensor has the wrong shape, dtype or device, or there are too many channels.
        InputError: The backend cannot run here.
        TooManyPairs: The Gaussians meet too many tiles.
    """
    _check(means, quats, scales, opacities, channels, viewmat, K, width, height, background)
    channel_count = channels.shape[1]
    if channel_count > MAX_SCORED:
        raise ValueError(f"contributions are taken over at most {MAX_SCORED} channels, not {channel_count}")
    weights = means.new_zeros(height, width, 0) if weights is None else weights
    image_gradient = means.new_zeros(height, width, channel_count) if image_gradient is None else image_gradient
    images: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        "weights": (weights, (height, width, weights.shape[-1])),
        "image_gradient": (image_gradient, (height, width, channel_count)),
    }
    _check_tensors(images, means)
    kernels = kernels_for(backend, means)
    projected = kernels.project(means, quats, scales, opacities, channels, viewmat, K, width, height, kind)
    sums = kernels.contributions(projected, opacities, channels, background, width, height, weights, image_gradient)
    return Contributions(*sums)


def _check(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    channels: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor,
) -> None:
    n, channel_count = len(means), channels.shape[-1]
    expected = {
        "means": (means, (n, 3)),
        "quats": (quats, (n, 4)),
        "scales": (scales, (n, 3)),
        "opacities": (opacities, (n,)),
        "channels": (channels, (n, channel_count)),
        "viewmat": (viewmat, (4, 4)),
        "K": (K, (3, 3)),
        "background": (background, (channel_count,)),
    }
    _check_tensors(expected, means)
    if width < 1 or height < 1 or channel_count < 1:
        raise ValueError(f"cannot render {channel_count} channels of {width} x {height} pixels")


def _check_tensors(expected: dict[str, tuple[Tensor, tuple[int, ...]]], means: Tensor) -> None:
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")
        if tensor.dtype != means.dtype or tensor.device != means.device or not tensor.is_floating_point():
            raise ValueError(f"{name} is {tensor.dtype} on {tensor.device}, means are {means.dtype} on {means.device}")
