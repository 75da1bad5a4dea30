"""Gaussians to pixels: one differentiable function over all backends."""

from dataclasses import dataclass

from torch import Tensor

from ..errors import InputError
from . import cpu, projection, reference

BACKENDS = ("auto", "cpu", "torch")


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

    backend: "cpu" (compiled kernels, float32), "torch" (any dtype and device, slow), or "auto": cpu where it can.
    Raises ValueError for wrong shapes, dtypes or devices, InputError when "cpu" is asked for and cannot run.
    """
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
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")
        if tensor.dtype != means.dtype or tensor.device != means.device or not tensor.is_floating_point():
            raise ValueError(f"{name} is {tensor.dtype} on {tensor.device}, means are {means.dtype} on {means.device}")
    if width < 1 or height < 1 or channel_count < 1:
        raise ValueError(f"cannot render {channel_count} channels of {width} x {height} pixels")
    if backend not in BACKENDS:
        raise ValueError(f"backend {backend!r} is none of {', '.join(BACKENDS)}")

    kernels = backend != "torch" and cpu.can_run(means)
    if backend == "cpu" and not kernels:
        raise InputError("The cpu backend cannot run here: it needs its compiled kernels and float32 on the CPU.")
    blend = cpu.blend if kernels else reference.blend

    project = cpu.project if kernels and not (viewmat.requires_grad or K.requires_grad) else projection.project
    projected = project(means, quats, scales, opacities, channels, viewmat, K, width, height)
    if projected.means2d.requires_grad:
        projected.means2d.retain_grad()
    blended, alpha = blend(
        projected.means2d, projected.conics, opacities, channels, background, projected.depths, projected.radii,
        width, height,
    )  # fmt: skip
    return Rendering(blended, alpha, projected.means2d, projected.radii)
