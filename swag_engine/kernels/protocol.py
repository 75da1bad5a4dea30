"""What every backend offers, and the values that pass between its operations."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from ..base.camera_kind import CameraKind
from ..base.errors import InputError

MAX_PAIRS = 2**27
"""Largest number of pairs of a Gaussian and a tile it meets: their lists take about 6 GB."""


class TooManyPairs(InputError):
    """Gaussians meet more tiles than can be blended."""


def check_pairs(pairs: int) -> None:
    """Refuse to blend where the lists of pairs would take more memory than a machine can spare.

    Args:
        pairs: Number of pairs of a Gaussian and a tile it meets.

    Raises:
        TooManyPairs: There are more than `MAX_PAIRS`.
    """
    if pairs > MAX_PAIRS:
        raise TooManyPairs(
            f"The Gaussians meet {pairs} tiles of the image, more than the {MAX_PAIRS} that can be blended: "
            "they are too many or too large. Use fewer Gaussians or a smaller width."
        )


@dataclass
class Projection:
    """N Gaussians on the image plane.

    Attributes:
        means2d: (N, 2) centres, pixels; pixel centres are at +0.5.
        conics: (N, 3) inverse covariances [[A, B], [B, C]] as (A, B, C), 1 / pixel^2.
        depths: (N,) z in camera coordinates, scene units.
        radii: (N,) distance from the centre to where alpha falls below 1/255, pixels; without gradient. 0 where
            nothing is drawn: the other values are then finite and without gradient.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    radii: Tensor


class Kernels(Protocol):
    """A backend: every operation that the engine runs natively.

    All tensors of a call have one floating dtype and are on one device. Gradients of native backends cannot be
    differentiated again.
    """

    def unavailable_reason(self) -> str | None:
        """Say why the backend cannot run on this machine, None where it can."""

    def can_run(self, *tensors: Tensor) -> bool:
        """Return whether the backend can run here and takes tensors of this dtype and device."""

    def device(self) -> torch.device:
        """Return where a run with this backend keeps its tensors."""

    def details(self) -> dict[str, Any]:
        """Describe what the backend runs on, for `doctor` and reports."""

    def project(
        self,
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
        """Project 3D Gaussians to 2D Gaussians on the image plane (EWA splatting, Zwicker et al. 2001).

        Gaussians behind the near plane, off screen, with alpha below 1/255 everywhere or with values that are not
        finite get radius 0 and no gradient. The projection of a perspective camera is linearised at the centre; that
        of an orthographic one is exact.

        Args:
            means: (N, 3) centres, scene units.
            quats: (N, 4) rotations wxyz, of any length.
            scales: (N, 3) standard deviations along the Gaussian's axes, scene units.
            opacities: (N,) in 0..1; they bound the radii.
            channels: (N, C) values to blend; a Gaussian is not drawn where one of them is not finite.
            viewmat: (4, 4) world to camera (x right, y down, z forward).
            K: (3, 3) intrinsics, pixels.
            width: Width of the image, pixels.
            height: Height of the image, pixels.
            kind: The kind of camera; for an orthographic one fx and fy in K are pixels per scene unit.

        Returns:
            The projected Gaussians, differentiable in means, quats, scales and the camera; depths without gradient in
            the native backends.
        """

    def blend(
        self, projected: Projection, opacities: Tensor, channels: Tensor, background: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """Blend projected Gaussians front to back.

        Each pixel centre p sees alpha_i = min(.99, o_i exp(-(p - mean_i)^T conic_i (p - mean_i) / 2)) of the Gaussians
        by depth (equal depths by index). Those with alpha < 1/255 are skipped, and the pixel ends before the Gaussian
        that would take the transmittance T to 1e-4 or less. out = sum_i T_i alpha_i channel_i + T_end background.
        The choices (order, skipping, end) and the clamp at .99 have no gradient.

        Args:
            projected: The N Gaussians.
            opacities: (N,) in 0..1.
            channels: (N, C) values to blend.
            background: (C,) values behind all Gaussians.
            width: Width of the image, pixels.
            height: Height of the image, pixels.

        Returns:
            The image (height, width, C) and alpha (height, width) = 1 - T_end.

        Raises:
            TooManyPairs: The Gaussians meet too many tiles.
        """

    def contributions(
        self,
        projected: Projection,
        opacities: Tensor,
        channels: Tensor,
        background: Tensor,
        width: int,
        height: int,
        weights: Tensor,
        image_gradient: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Sum over all pixels what each Gaussian does to the image that `blend` makes; no gradients.

        With g = exp(-s) the value of a projected Gaussian at a pixel (alpha = o g), dC/dg = o T (channel - color
        behind the Gaussian), 0 where alpha is clamped.

        Args:
            projected: The N Gaussians.
            opacities: (N,) in 0..1.
            channels: (N, C) values to blend; at most 8.
            background: (C,) values behind all Gaussians.
            width: Width of the image, pixels.
            height: Height of the image, pixels.
            weights: (height, width, R) images that the sums of T alpha are weighted with.
            image_gradient: (height, width, C) gradient of a loss by the image.

        Returns:
            (N, R) sums of T alpha times each weight image, (N,) sums of |dC/dg|^2 and (N,) sums of
            (image_gradient . dC/dg)^2.

        Raises:
            TooManyPairs: The Gaussians meet too many tiles.
        """

    def sh_colors(self, sh0: Tensor, shN: Tensor, directions: Tensor, degree: int) -> Tensor:
        """Evaluate max(0, 1/2 + sum_k sh_k Y_k(direction)), differentiable.

        Args:
            sh0: (N, 1, 3) constant coefficients.
            shN: (N, K - 1, 3) the others, in the order and with the signs of 3DGS files (arXiv 2308.04079).
            directions: (N, 3) unit vectors from the camera to the Gaussians.
            degree: Degree that is used, 0..3; K is at least (degree + 1)^2.

        Returns:
            (N, 3) colors.
        """

    def apply_gain(self, display: Tensor, log_gain: Tensor) -> Tensor:
        """Multiply the linear light of display values (sRGB, IEC 61966-2-1) by exp(log_gain), differentiable.

        Args:
            display: Display values.
            log_gain: Natural logarithm of the factor; broadcasts with `display`.

        Returns:
            Display values.
        """

    def through_water(
        self, colors: Tensor, offsets: Tensor, coefficients: Tensor, degree: int, linear: bool, amount: float
    ) -> Tensor:
        """Attenuate colors and add backscatter: J exp(-beta_D r) + B(d) (1 - exp(-beta_B r)), differentiable.

        The revised underwater image formation model (Akkaynak and Treibitz 2018), docs/method.md section 1.

        Args:
            colors: (N, 3) display values without the water.
            offsets: (N, 3) from the camera to the Gaussians, scene units; there is a gradient by their length r, and
                none by their direction d.
            coefficients: (33,) beta_D (3), beta_B (3), 1 / scene unit, and the raw SH coefficients of the background
                light B (9, 3), whose sum goes through a sigmoid.
            degree: SH degree of B that is used, 0..2.
            linear: Whether the formula works on linear light; on display values otherwise.
            amount: Factor of beta_D, beta_B and B, 0 (no water) to 1.

        Returns:
            (N, 3) display values.
        """

    def open_water(
        self,
        coefficients: Tensor,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        degree: int,
        linear: bool,
        amount: float,
    ) -> Tensor:
        """Evaluate the background light B in the direction of each pixel, differentiable in the coefficients.

        Args:
            coefficients: (33,) as in `through_water`.
            viewmat: (4, 4) world to camera.
            K: (3, 3) intrinsics, pixels.
            width: Width of the image, pixels.
            height: Height of the image, pixels.
            degree: SH degree of B that is used, 0..2.
            linear: Whether B is linear light; a display value otherwise.
            amount: Factor of B, 0 to 1.

        Returns:
            (height, width, 3) display values.
        """

    def l1_ssim(self, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Compare two images, differentiable in the first.

        SSIM after Wang et al. 2004: 11 x 11 Gaussian window of sigma 1.5, zero padding, so that every pixel counts.

        Args:
            image: (H, W, 3) display values.
            target: (H, W, 3) display values.

        Returns:
            Mean absolute difference and mean structural similarity, two scalars.
        """

    def adam_step(
        self,
        parameter: Tensor,
        gradient: Tensor,
        exp_avg: Tensor,
        exp_avg_sq: Tensor,
        rate: float,
        beta1: float,
        beta2: float,
        eps: float,
        step: int,
    ) -> None:
        """Update a parameter and its moments in place by one step of Adam (arXiv 1412.6980).

        Args:
            parameter: Contiguous tensor of any shape.
            gradient: Its gradient, of the same shape.
            exp_avg: First moment, contiguous, of the same shape.
            exp_avg_sq: Second moment, contiguous, of the same shape.
            rate: Step size.
            beta1: Decay of the first moment in a step.
            beta2: Decay of the second moment in a step.
            eps: Added to the root of the second moment.
            step: Number of the step, from 1.
        """


Gradients = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""By means2d (N, 2), conics (N, 3), opacities (N,), channels (N, C) and background (C,)."""


@dataclass
class Blended:
    """A blended image and the way back through it.

    Attributes:
        out: (H, W, C) as `Kernels.blend` returns it.
        transmittance: (H, W) 1 - alpha.
        backward: Returns the gradients from those by `out` (H, W, C) and by alpha (H, W).
    """

    out: Tensor
    transmittance: Tensor
    backward: Callable[[Tensor, Tensor], Gradients]


class NativeKernels(Kernels, Protocol):
    """A backend with all kernels of a training step, which run one by one on its tensors, without an autograd graph.

    Arguments of kernels are tensors, numbers, and 0 in place of a tensor that there is not.

    Attributes:
        viewmat_dtype: The dtype in which the projection takes the view matrix.
    """

    viewmat_dtype: torch.dtype

    def items_of_image(self, height: int, width: int) -> int:
        """Return the number of items that kernels of images have: rows or pixels."""

    def run_each(self, kernel: str, count: int, *arguments: Tensor | int | float) -> None:
        """Run a kernel over `count` items."""

    def run_by_channel(self, kernel: str, count: int, *arguments: Tensor | int | float) -> None:
        """Run a kernel over the channels of `count` colors."""

    def sum_each(self, kernel: str, count: int, size: int, *arguments: Tensor | int | float) -> Tensor:
        """Run a kernel that sums over `count` items; return the `size` sums, float64."""

    def blended(
        self, projected: Projection, opacities: Tensor, channels: Tensor, background: Tensor, width: int, height: int
    ) -> Blended:
        """Blend as `blend` does; all tensors are contiguous and have no graph."""

    def similarity(self, image: Tensor, target: Tensor) -> tuple[Tensor, Callable[[float], Tensor]]:
        """Compare two images (H, W, 3) by SSIM.

        Returns:
            The sum of SSIM over pixels and channels, (1,), float64; and what returns the gradient (H, W, 3) of that sum
            times a factor, by the image.
        """
