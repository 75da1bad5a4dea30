"""Gaussians to pixels: one differentiable function over all backends."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..kernels.backends import kernels_for
from . import projection, reference

MAX_SCORED = 8
"""Channels that contributions() takes at most."""


@dataclass
class Rendering:
    """channels (H, W, C) over the background, alpha (H, W) = 1 - final transmittance, both differentiable.

    means2d (N, 2): projected centres in pixels, pixel centres at +0.5; keeps its gradient when it has one.
    radii (N,): extent in pixels, 0 where a Gaussian is not visible; no gradient.
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
) -> Rendering:
    """Render N Gaussians with any number C of channels; the blending is defined in reference.blend.

    means (N, 3) in world units; quats (N, 4) wxyz, of any length; scales (N, 3) linear sigmas; opacities (N,) in 0..1;
    channels (N, C); viewmat (4, 4) world to camera (x right, y down, z forward); K (3, 3) px; background (C,).
    All tensors share one floating dtype and device; gradients reach the five per-Gaussian inputs and the background.
    Gaussians with NaN or infinite parameters are not drawn and get zero gradients.

    backend: as in backends.kernels_for. The torch backend takes any floating dtype.
    Raises ValueError for wrong shapes, dtypes or devices, InputError when the backend asked for cannot run.
    """
    _check(means, quats, scales, opacities, channels, viewmat, K, width, height, background)
    kernels = kernels_for(backend, means)
    # The kernels have no gradient by the camera.
    project = kernels.project if kernels and not (viewmat.requires_grad or K.requires_grad) else projection.project
    projected = project(means, quats, scales, opacities, channels, viewmat, K, width, height)
    if projected.means2d.requires_grad:
        projected.means2d.retain_grad()
    blend = kernels.blend if kernels else reference.blend
    blended, alpha = blend(
        projected.means2d, projected.conics, opacities, channels, background, projected.depths, projected.radii,
        width, height,
    )  # fmt: skip
    return Rendering(blended, alpha, projected.means2d, projected.radii)


@dataclass
class Contributions:
    """What each of N Gaussians does to one picture; no gradients.

    With g = exp(-s) the value of the projected Gaussian at a pixel (alpha = opacity g), dC/dg is the picture's change
    by it, opacity T (channel - what is seen behind), 0 where alpha is clamped. Sums over all pixels:
    weighted (N, R): T alpha times each weight image;
    importance (N,): |dC/dg|^2, and error (N,): (image_gradient . dC/dg)^2, as in SWAGSplatting's reallocation.
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
) -> Contributions:
    """What each Gaussian does to the picture that rasterize() makes of the same arguments, in one pass over it.

    weights (H, W, R): images that the sums of T alpha are weighted with; image_gradient (H, W, C): the loss by the
    channels. Without them `weighted` has no columns and `error` is 0. At most MAX_SCORED channels.
    Raises as rasterize() does.
    """
    _check(means, quats, scales, opacities, channels, viewmat, K, width, height, background)
    channel_count = channels.shape[1]
    if channel_count > MAX_SCORED:
        raise ValueError(f"contributions are taken over at most {MAX_SCORED} channels, not {channel_count}")
    weights = means.new_zeros(height, width, 0) if weights is None else weights
    image_gradient = means.new_zeros(height, width, channel_count) if image_gradient is None else image_gradient
    pictures: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        "weights": (weights, (height, width, weights.shape[-1])),
        "image_gradient": (image_gradient, (height, width, channel_count)),
    }
    _check_tensors(pictures, means)
    kernels = kernels_for(backend, means)
    projected = (kernels or projection).project(means, quats, scales, opacities, channels, viewmat, K, width, height)
    return Contributions(
        *(kernels or reference).contributions(
            projected.means2d, projected.conics, opacities, channels, background, projected.depths, projected.radii,
            width, height, weights, image_gradient,
        )
    )  # fmt: skip


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
