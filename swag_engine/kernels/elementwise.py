"""Operations whose kernels take each Gaussian or color by itself: called alike on the CPU and on a card.

`run(kernel, count, *arguments)` launches a kernel of the backend over [0, count).
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..base.camera_kind import CameraKind
from ..base.timing import part
from .protocol import NativeKernels, Projection
from .reference.kernels import REFERENCE

Run = Callable[..., None]
KERNELS: dict[CameraKind, str] = {"perspective": "project", "orthographic": "project_orthographic"}
"""First part of the names of the kernels that project Gaussians, by the kind of camera."""


class _Project(torch.autograd.Function):
    @staticmethod
    @part("project")
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        channels: Tensor,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        kind: CameraKind,
        run: Run,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        n = len(means)
        viewmat, K, means, quats, scales = (tensor.contiguous() for tensor in (viewmat, K, means, quats, scales))
        means2d, conics, depths, radii = (means.new_empty(n, *shape) for shape in ((2,), (3,), (), ()))
        limits = opacities.contiguous(), channels.contiguous()
        inputs = width, height, channels.shape[1], viewmat, K, means, quats, scales, *limits
        kernel = KERNELS[kind]
        run(f"{kernel}_forward", n, *inputs, means2d, conics, depths, radii)
        ctx.save_for_backward(viewmat, K, means, quats, scales, radii)
        ctx.size, ctx.kernel, ctx.run = (width, height), kernel, run
        ctx.mark_non_differentiable(depths, radii)
        return means2d, conics, depths, radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("project backward")
    def backward(ctx: Any, by_means2d: Tensor, by_conics: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        results = [torch.empty_like(tensor) for tensor in saved[2:5]]
        incoming = by_means2d.contiguous(), by_conics.contiguous()
        ctx.run(f"{ctx.kernel}_backward", len(results[0]), *ctx.size, *saved, *incoming, *results)
        return *results, None, None, None, None, None, None, None, None


def project(
    run: Run,
    camera_dtype: torch.dtype,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    channels: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    kind: CameraKind,
) -> Projection:
    """Project Gaussians by a native kernel, or by torch where a gradient by the camera is needed.

    Args:
        run: Launches a kernel of the backend.
        camera_dtype: The dtype in which the kernel takes the view matrix.
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
    if viewmat.requires_grad or K.requires_grad:
        return REFERENCE.project(means, quats, scales, opacities, channels, viewmat, K, width, height, kind)
    viewmat = viewmat.to(camera_dtype)
    return Projection(*_Project.apply(means, quats, scales, opacities, channels, viewmat, K, width, height, kind, run))


class _Colors(torch.autograd.Function):
    @staticmethod
    @part("colors")
    def forward(ctx: Any, sh0: Tensor, shN: Tensor, directions: Tensor, degree: int, run: Run) -> Tensor:
        sh0, shN, directions = sh0.contiguous(), shN.contiguous(), directions.contiguous()
        colors = torch.empty_like(directions)
        run("sh_forward", len(sh0), shN.shape[1], degree, sh0, shN, directions, colors)
        ctx.save_for_backward(directions, colors)
        ctx.sizes, ctx.run = (shN.shape[1], degree), run
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("colors backward")
    def backward(ctx: Any, by_colors: Tensor) -> tuple[Tensor | None, ...]:
        directions, colors = ctx.saved_tensors
        n, (higher, degree) = len(directions), ctx.sizes
        by_sh0, by_shN = directions.new_empty(n, 1, 3), directions.new_empty(n, higher, 3)
        ctx.run("sh_backward", n, higher, degree, directions, colors, by_colors.contiguous(), by_sh0, by_shN)
        return by_sh0, by_shN, None, None, None


def sh_colors(run: Run, sh0: Tensor, shN: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Evaluate spherical harmonics by a native kernel, or by torch where a gradient by the directions is needed.

    Args:
        run: Launches a kernel of the backend.
        sh0: (N, 1, 3) constant coefficients.
        shN: (N, K - 1, 3) the others.
        directions: (N, 3) unit vectors from the camera to the Gaussians.
        degree: Degree that is used, 0..3.

    Returns:
        (N, 3) colors.
    """
    if directions.requires_grad:
        return REFERENCE.sh_colors(sh0, shN, directions, degree)
    return _Colors.apply(sh0, shN, directions, degree, run)


class _Gain(torch.autograd.Function):
    @staticmethod
    @part("light")
    def forward(ctx: Any, display: Tensor, log_gain: Tensor, run: Run) -> Tensor:
        display, n, strides = display.contiguous(), len(display), log_gain.stride()
        shown, logs = torch.empty_like(display), log_gain.as_strided((1,), (1,))  # the first of its numbers
        run("gain_forward", n, *strides, display, logs, shown)
        ctx.save_for_backward(display, log_gain)
        ctx.run = run
        return shown

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("light backward")
    def backward(ctx: Any, by_shown: Tensor) -> tuple[Tensor, Tensor, None]:
        display, log_gain = ctx.saved_tensors
        n, strides, logs = len(display), log_gain.stride(), log_gain.as_strided((1,), (1,))
        by_display, by_log_gain = torch.empty_like(display), torch.empty_like(display)
        ctx.run("gain_backward", n, *strides, display, logs, by_shown.contiguous(), by_display, by_log_gain)
        return by_display, by_log_gain, None


def apply_gain(run: Run, display: Tensor, log_gain: Tensor) -> Tensor:
    """Multiply linear light by a native kernel, or by torch where the shapes are not those of colors and their gains.

    Args:
        run: Launches a kernel of the backend.
        display: (..., 3) display values for the kernel; any shape for torch.
        log_gain: Logarithm of the factor; expands to the shape of `display` for the kernel.

    Returns:
        Display values.
    """
    sizes = zip(reversed(log_gain.shape), reversed(display.shape), strict=False)
    expands = log_gain.dim() <= display.dim() and all(small in (1, size) for small, size in sizes)
    if display.shape[-1:] != (3,) or not expands:
        return REFERENCE.apply_gain(display, log_gain)
    logs = log_gain.expand_as(display).reshape(-1, 3)
    return _Gain.apply(display.reshape(-1, 3), logs, run).view_as(display)


class _Water(torch.autograd.Function):
    @staticmethod
    @part("water")
    def forward(
        ctx: Any,
        colors: Tensor,
        offsets: Tensor,
        coefficients: Tensor,
        degree: int,
        linear: bool,
        kernels: NativeKernels,
    ) -> Tensor:
        colors, offsets, coefficients = colors.contiguous(), offsets.contiguous(), coefficients.contiguous()
        shown = torch.empty_like(colors)
        kernels.run_each("water_forward", len(colors), degree, int(linear), coefficients, colors, offsets, shown)
        ctx.save_for_backward(colors, offsets, coefficients)
        ctx.kernels, ctx.mode = kernels, (degree, int(linear))
        return shown

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("water backward")
    def backward(ctx: Any, by_shown: Tensor) -> tuple[Tensor | None, ...]:
        colors, offsets, coefficients = ctx.saved_tensors
        by_colors, by_offsets = torch.empty_like(colors), torch.empty_like(offsets)
        arguments = *ctx.mode, coefficients, colors, offsets, by_shown.contiguous(), by_colors, by_offsets
        sums = ctx.kernels.sum_each("water_backward", len(colors), len(coefficients), *arguments)
        return by_colors, by_offsets, sums.float(), None, None, None


class _OpenWater(torch.autograd.Function):
    @staticmethod
    @part("water")
    def forward(
        ctx: Any,
        coefficients: Tensor,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        degree: int,
        linear: bool,
        kernels: NativeKernels,
    ) -> Tensor:
        coefficients, viewmat, K = coefficients.contiguous(), viewmat.contiguous(), K.contiguous()
        shown, items = coefficients.new_empty(height, width, 3), kernels.items_of_image(height, width)
        kernels.run_each("open_water_forward", items, width, degree, int(linear), coefficients, viewmat, K, shown)
        ctx.save_for_backward(coefficients, viewmat, K)
        ctx.kernels, ctx.mode = kernels, (width, degree, int(linear))
        return shown

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("water backward")
    def backward(ctx: Any, by_shown: Tensor) -> tuple[Tensor | None, ...]:
        coefficients, viewmat, K = ctx.saved_tensors
        items = ctx.kernels.items_of_image(*by_shown.shape[:2])
        arguments = *ctx.mode, coefficients, viewmat, K, by_shown.contiguous()
        sums = ctx.kernels.sum_each("open_water_backward", items, len(coefficients), *arguments)
        return sums.float(), None, None, None, None, None, None, None


class ElementwiseKernels:
    """What native backends share of `Kernels`: kernels that take each Gaussian, color or pixel by itself."""

    def project(
        self: NativeKernels,
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
        """See `Kernels.project`."""
        gaussians = means, quats, scales, opacities, channels
        return project(self.run_each, self.viewmat_dtype, *gaussians, viewmat, K, width, height, kind)

    def sh_colors(self: NativeKernels, sh0: Tensor, shN: Tensor, directions: Tensor, degree: int) -> Tensor:
        """See `Kernels.sh_colors`."""
        return sh_colors(self.run_by_channel, sh0, shN, directions, degree)

    def apply_gain(self: NativeKernels, display: Tensor, log_gain: Tensor) -> Tensor:
        """See `Kernels.apply_gain`."""
        return apply_gain(self.run_by_channel, display, log_gain)

    def through_water(
        self: NativeKernels,
        colors: Tensor,
        offsets: Tensor,
        coefficients: Tensor,
        degree: int,
        linear: bool,
        amount: float,
    ) -> Tensor:
        """See `Kernels.through_water`."""
        if amount != 1:
            return REFERENCE.through_water(colors, offsets, coefficients, degree, linear, amount)
        return _Water.apply(colors, offsets, coefficients, degree, linear, self)

    def open_water(
        self: NativeKernels,
        coefficients: Tensor,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        degree: int,
        linear: bool,
        amount: float,
    ) -> Tensor:
        """See `Kernels.open_water`."""
        if amount != 1:
            return REFERENCE.open_water(coefficients, viewmat, K, width, height, degree, linear, amount)
        return _OpenWater.apply(coefficients, viewmat, K, width, height, degree, linear, self)
