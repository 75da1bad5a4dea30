"""Rendering of a cloud and its gradients by native kernels alone: `render` without an autograd graph."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isqrt

import numpy as np
import torch
from torch import Tensor

from ..base.timing import part
from ..effects.lamp import Lamp
from ..gaussians.cloud import LOG_SCALE_LIMITS, GaussianCloud
from ..kernels.protocol import NativeKernels, Projection
from ..scene.cameras import Camera
from ..water.medium import Medium
from .render import DAZZLING, FARTHEST


@dataclass(frozen=True)
class Shading:
    """What dims and lights the Gaussians, with the graphs of its few numbers.

    Attributes:
        coefficients: (33,) of the water as in `Kernels.through_water`; None without water.
        linear: Whether the water works on linear light.
        water_degree: Degree of the background light, 0..2.
        open_water: Whether the background light is behind the Gaussians, in place of the cloud's background.
        tau: () of the lamp, over the squared median range; None without a lamp.
        unit_range: Median range of the scene, scene units.
    """

    coefficients: Tensor | None
    linear: bool
    water_degree: int
    open_water: bool
    tau: Tensor | None
    unit_range: float

    @classmethod
    def of(cls, medium: Medium | None, water_degree: int, lamp: Lamp | None) -> "Shading":
        """Return the shading of a medium and a lamp."""
        return cls(
            coefficients=medium.coefficients() if medium else None,
            linear=medium is not None and medium.light == "linear",
            water_degree=water_degree,
            open_water=medium is not None and medium.background_sh is not None,
            tau=lamp.relative_tau if lamp else None,
            unit_range=lamp.unit_range if lamp else 1.0,
        )


@torch.enable_grad()
def add_gradients(outputs: Sequence[tuple[Tensor, Tensor]]) -> None:
    """Add to the parameters' gradients those by outputs: as `torch.autograd.backward` does with them, to the bit.

    The latter imports sympy first, which takes half a second.
    """
    torch.stack([(output * gradient).sum() for output, gradient in outputs]).sum().backward()


class NativeImage:
    """A cloud as a camera sees it, and the gradients of its parameters.

    The formulas are those of `render`. Numbers of water, lamp and background, a few dozen, keep a graph of their own.

    Args:
        kernels: The backend.
        cloud: The Gaussians, float32.
        camera: The camera.
        sh_degree: Degree of the Gaussians' colors, 0..3.
        medium: The water, None without.
        water_degree: Degree of the background light, 0..2.
        lamp: A lamp at the camera.
        kept: (N,) factors of the opacities, which stay at most 1; None for none.

    Attributes:
        blended: (H, W, 3) the Gaussians over the background color, or over nothing where there is open water.
        transmittance: (H, W) transmittance.
        behind: (H, W, 3) open water; None without.
        radii: (N,) extent on screen, pixels, 0 where a Gaussian is not visible.
        offsets: (N, 3) from the camera to the Gaussians, scene units.
    """

    def __init__(
        self,
        kernels: NativeKernels,
        cloud: GaussianCloud,
        camera: Camera,
        sh_degree: int,
        medium: Medium | None,
        water_degree: int,
        lamp: Lamp | None,
        kept: Tensor | None,
    ) -> None:
        self.kernels, self.cloud, self.width, self.height = kernels, cloud, camera.width, camera.height
        self.shading = Shading.of(medium, water_degree, lamp)
        self.background = None if self.shading.open_water else cloud.background.sigmoid()
        self._place(camera)
        self.sh_degree = min(sh_degree, isqrt(1 + cloud.shN.shape[1]) - 1)
        self.kept = kept
        with torch.no_grad():
            self._activate()
            self._color()
            self._blend()

    def _place(self, camera: Camera) -> None:
        # In one piece, and without waiting for the card, which computes what was asked of it before.
        numbers = np.concatenate([camera.world_to_camera, camera.K, camera.centre], axis=None)
        exact = torch.from_numpy(numbers).to(self.cloud.means.device, non_blocking=True)
        rounded = exact.float()
        self.viewmat, self.K, self.centre = rounded[:16], rounded[16:25], rounded[25:]
        self.viewmat_of_projection = rounded[:16].to(self.kernels.viewmat_dtype)

    def _empty(self, *size: int) -> Tensor:
        return self.cloud.means.new_empty(size)

    def _activate(self) -> None:
        cloud, n = self.cloud, len(self.cloud)
        self.scales, self.offsets, self.directions = (self._empty(n, 3) for _ in range(3))
        self.own_opacities = self._empty(n)
        inputs = self.centre, cloud.means, cloud.log_scales, cloud.opacity_logits
        outputs = self.scales, self.own_opacities, self.offsets, self.directions
        with part("project"):
            self.kernels.run_each("activate", n, *inputs, *LOG_SCALE_LIMITS, FARTHEST, *outputs)
        self.opacities = self.own_opacities
        if self.kept is not None:
            self.opacities = (self.own_opacities * self.kept).clamp(max=1.0)

    def _color(self) -> None:
        cloud, shading, n, kernels = self.cloud, self.shading, len(self.cloud), self.kernels
        self.colors = self.channels = self._empty(n, 3)
        with part("colors"):
            orders = cloud.shN.shape[1], self.sh_degree
            kernels.run_by_channel("sh_forward", n, *orders, cloud.sh0, cloud.shN, self.directions, self.colors)
        if shading.tau is not None:
            self.log_light, self.channels = self._empty(n), self._empty(n, 3)
            with part("light"):
                kernels.run_each("lamp_forward", n, self.offsets, shading.tau, shading.unit_range, self.log_light)
                kernels.run_by_channel("gain_forward", n, 1, 0, self.colors, self.log_light, self.channels)
        self.lit = self.channels
        if shading.coefficients is not None:
            self.lit, self.channels = self.lit.clamp(max=DAZZLING), self._empty(n, 3)
            with part("water"):
                mode = shading.water_degree, int(shading.linear), shading.coefficients
                kernels.run_each("water_forward", n, *mode, self.lit, self.offsets, self.channels)

    def _blend(self) -> None:
        cloud, shading, n, kernels = self.cloud, self.shading, len(self.cloud), self.kernels
        means2d, conics, depths, self.radii = (self._empty(n, *shape) for shape in ((2,), (3,), (), ()))
        with part("project"):
            view = self.width, self.height, 3, self.viewmat_of_projection, self.K
            gaussians = cloud.means, cloud.quats, self.scales, self.opacities, self.channels
            kernels.run_each("project_forward", n, *view, *gaussians, means2d, conics, depths, self.radii)
        projected = Projection(means2d, conics, depths, self.radii)
        background = cloud.means.new_zeros(3) if self.background is None else self.background.detach()
        with part("rasterise"):
            inputs = projected, self.opacities, self.channels, background, self.width, self.height
            blended = kernels.blended(*inputs)
        self._blend_backward = blended.backward
        self.blended, self.transmittance, self.behind = blended.out, blended.transmittance, None
        if shading.open_water and shading.coefficients is not None:
            self.behind = self._empty(self.height, self.width, 3)
            with part("water"):
                mode = self.width, shading.water_degree, int(shading.linear), shading.coefficients
                pixels = kernels.items_of_image(self.height, self.width)
                kernels.run_each("open_water_forward", pixels, *mode, self.viewmat, self.K, self.behind)

    @torch.no_grad()
    def backward(self, by_blended: Tensor, by_alpha: Tensor, by_behind: Tensor, with_geometry: bool) -> Tensor:
        """Set the gradients of the cloud's parameters, and add those of water and lamp.

        Args:
            by_blended: (H, W, 3) gradient of the loss by `blended`.
            by_alpha: (H, W) gradient by 1 - `transmittance`.
            by_behind: (H, W, 3) gradient by `behind`; not used without open water.
            with_geometry: Whether the gradients of means, quats and log_scales are set.

        Returns:
            (N, 2) gradient by the projected centres, per pixel.
        """
        with part("rasterise backward"):
            by_splats = self._blend_backward(by_blended, by_alpha)
        by_means2d, by_conics, by_opacities, by_channels, by_background = by_splats
        few = [] if self.background is None else [(self.background, by_background)]
        self._color_backward(by_channels, by_behind, few)
        self._activate_backward(by_means2d, by_conics, by_opacities.contiguous(), with_geometry)
        if few:
            add_gradients(few)
        return by_means2d

    def _color_backward(self, by_channels: Tensor, by_behind: Tensor, few: list[tuple[Tensor, Tensor]]) -> None:
        """Set the gradients of the colors; append the small tensors of the shading and their gradients to `few`."""
        cloud, shading, n, kernels = self.cloud, self.shading, len(self.cloud), self.kernels
        if shading.coefficients is not None:
            size = shading.coefficients.numel()
            mode = shading.water_degree, int(shading.linear), shading.coefficients
            by_lit = self._empty(n, 3)
            with part("water backward"):
                sums = kernels.sum_each(
                    "water_backward", n, size, *mode, self.lit, self.offsets, by_channels, by_lit, 0
                )
                if shading.open_water:
                    view, pixels = (self.viewmat, self.K), kernels.items_of_image(self.height, self.width)
                    sums += kernels.sum_each("open_water_backward", pixels, size, self.width, *mode, *view, by_behind)
            by_channels = by_lit.masked_fill_(self.lit >= DAZZLING, 0)
            few.append((shading.coefficients, sums.float()))
        if shading.tau is not None:
            by_colors, by_log = self._empty(n, 3), self._empty(n, 3)
            with part("light backward"):
                gained = self.colors, self.log_light, by_channels, by_colors, by_log
                kernels.run_by_channel("gain_backward", n, 1, 0, *gained)
                lamp = self.offsets, shading.tau, shading.unit_range, by_log
                by_tau = kernels.sum_each("lamp_backward", n, 1, *lamp)
            by_channels = by_colors
            few.append((shading.tau, by_tau[0].float()))
        with part("colors backward"):
            cloud.sh0.grad, cloud.shN.grad = torch.empty_like(cloud.sh0), torch.empty_like(cloud.shN)
            inputs = cloud.shN.shape[1], self.sh_degree, self.directions, self.colors, by_channels
            kernels.run_by_channel("sh_backward", n, *inputs, cloud.sh0.grad, cloud.shN.grad)

    def _activate_backward(
        self, by_means2d: Tensor, by_conics: Tensor, by_opacities: Tensor, with_geometry: bool
    ) -> None:
        cloud, n, run = self.cloud, len(self.cloud), self.kernels.run_each
        if self.kept is not None:
            by_opacities *= self.kept * (self.own_opacities * self.kept <= 1)
        by_means, by_quats, by_scales = (torch.zeros_like(t) for t in (cloud.means, cloud.quats, cloud.log_scales))
        with part("project backward"):
            if with_geometry:
                geometry = self.viewmat_of_projection, self.K, cloud.means, cloud.quats, self.scales, self.radii
                inputs = self.width, self.height, *geometry, by_means2d, by_conics
                run("project_backward", n, *inputs, by_means, by_quats, by_scales)
            activations = cloud.log_scales, self.scales, self.own_opacities, *LOG_SCALE_LIMITS
            run("activate_backward", n, *activations, by_scales, by_opacities)
        cloud.opacity_logits.grad = by_opacities
        if with_geometry:
            cloud.means.grad, cloud.quats.grad, cloud.log_scales.grad = by_means, by_quats, by_scales
