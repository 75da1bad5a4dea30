"""Rendering of a cloud and its gradients by the CPU kernels alone: `render` without an autograd graph."""

from dataclasses import dataclass
from math import isqrt

import torch
from torch import Tensor

from ..base.timing import part
from ..effects.lamp import Lamp
from ..gaussians.cloud import LOG_SCALE_LIMITS, GaussianCloud
from ..kernels.cpu import WATER_PARTS, Blended, CpuKernels, blend, blend_backward
from ..kernels.cpu_library import Argument
from ..kernels.protocol import Projection
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
def add_gradient(output: Tensor, gradient: Tensor) -> None:
    """Add to the parameters' gradients those by an output, as `output.backward(gradient)` does, to the bit.

    The latter imports sympy first, which takes half a second.
    """
    (output * gradient).sum().backward()


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
        transmittance: (H, W) the part of what is behind that is seen.
        behind: (H, W, 3) open water; None without.
        radii: (N,) extent on screen, pixels, 0 where a Gaussian is not visible.
        offsets: (N, 3) from the camera to the Gaussians, scene units.
    """

    def __init__(
        self,
        kernels: CpuKernels,
        cloud: GaussianCloud,
        camera: Camera,
        sh_degree: int,
        medium: Medium | None,
        water_degree: int,
        lamp: Lamp | None,
        kept: Tensor | None,
    ) -> None:
        self.library, self.cloud, self.width, self.height = kernels.library, cloud, camera.width, camera.height
        self.shading = Shading.of(medium, water_degree, lamp)
        self.background = None if self.shading.open_water else cloud.background.sigmoid()
        self.centre, self.viewmat, self.K = (
            torch.from_numpy(array).float() for array in (camera.centre, camera.world_to_camera, camera.K)
        )
        self.sh_degree = min(sh_degree, isqrt(1 + cloud.shN.shape[1]) - 1)
        self.kept = kept
        with torch.no_grad():
            self._activate()
            self._color()
            self._blend()

    def _activate(self) -> None:
        cloud, n = self.cloud, len(self.cloud)
        self.scales, self.offsets, self.directions = (torch.empty(n, 3) for _ in range(3))
        self.own_opacities = torch.empty(n)
        inputs = self.centre, cloud.means, cloud.log_scales, cloud.opacity_logits
        outputs = self.scales, self.own_opacities, self.offsets, self.directions
        with part("project"):
            self.library.run("activate", n, *inputs, *LOG_SCALE_LIMITS, FARTHEST, *outputs)
        self.opacities = self.own_opacities
        if self.kept is not None:
            self.opacities = (self.own_opacities * self.kept).clamp(max=1.0)

    def _color(self) -> None:
        cloud, shading, n, run = self.cloud, self.shading, len(self.cloud), self.library.run
        self.colors = self.channels = torch.empty(n, 3)
        with part("colors"):
            orders = cloud.shN.shape[1], self.sh_degree
            run("sh_forward", n, *orders, cloud.sh0, cloud.shN, self.directions, self.colors)
        if shading.tau is not None:
            self.log_light, self.channels = torch.empty(n), torch.empty(n, 3)
            with part("light"):
                run("lamp_forward", n, self.offsets, float(shading.tau), shading.unit_range, self.log_light)
                run("gain_forward", n, 1, 0, self.colors, self.log_light, self.channels)
        self.lit = self.channels
        if shading.coefficients is not None:
            self.lit, self.channels = self.lit.clamp(max=DAZZLING), torch.empty(n, 3)
            with part("water"):
                mode = shading.water_degree, int(shading.linear), shading.coefficients
                run("water_forward", n, *mode, self.lit, self.offsets, self.channels)

    def _blend(self) -> None:
        cloud, shading, n, run = self.cloud, self.shading, len(self.cloud), self.library.run
        means2d, conics, depths, self.radii = (torch.empty(n, *shape) for shape in ((2,), (3,), (), ()))
        with part("project"):
            view = self.width, self.height, 3, self.viewmat, self.K
            gaussians = cloud.means, cloud.quats, self.scales, self.opacities, self.channels
            run("project_forward", n, *view, *gaussians, means2d, conics, depths, self.radii)
        projected = Projection(means2d, conics, depths, self.radii)
        background = torch.zeros(3) if self.background is None else self.background.detach()
        with part("rasterise"):
            blended: Blended = blend(
                self.library, projected, self.opacities, self.channels, background, self.width, self.height
            )
        self._saved = blended.saved(self.channels, background)
        self.blended, self.transmittance, self.behind = blended.out, blended.transmittance, None
        if shading.open_water and shading.coefficients is not None:
            self.behind = torch.empty(self.height, self.width, 3)
            with part("water"):
                mode = self.width, shading.water_degree, int(shading.linear), shading.coefficients
                run("open_water_forward", self.height, *mode, self.viewmat, self.K, self.behind)

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
            by_means2d, by_conics, by_opacities, by_channels, by_background = blend_backward(
                self.library, self._saved, by_blended, by_alpha
            )
        few = [] if self.background is None else [(self.background, by_background)]
        self._color_backward(by_channels, by_behind, few)
        self._activate_backward(by_means2d, by_conics, by_opacities.contiguous(), with_geometry)
        for numbers, gradient in few:
            add_gradient(numbers, gradient)
        return by_means2d

    def _color_backward(self, by_channels: Tensor, by_behind: Tensor, few: list[tuple[Tensor, Tensor]]) -> None:
        """Set the gradients of the colors; append the small tensors of the shading and their gradients to `few`."""
        cloud, shading, n, library = self.cloud, self.shading, len(self.cloud), self.library
        if shading.coefficients is not None:
            mode = shading.water_degree, int(shading.linear), shading.coefficients
            sums = torch.zeros(2, WATER_PARTS, shading.coefficients.numel(), dtype=torch.float64)
            by_lit = torch.empty(n, 3)
            with part("water backward"):
                water: list[Argument] = [*mode, self.lit, self.offsets, by_channels, by_lit, 0]
                library.run_parts("water_backward", n, water, sums[0])
                if shading.open_water:
                    view: list[Argument] = [self.width, *mode, self.viewmat, self.K, by_behind]
                    library.run_parts("open_water_backward", self.height, view, sums[1])
            by_channels = by_lit.masked_fill_(self.lit >= DAZZLING, 0)
            few.append((shading.coefficients, sums.sum((0, 1)).float()))
        if shading.tau is not None:
            by_colors, by_log = torch.empty(n, 3), torch.empty(n, 3)
            by_tau = torch.empty(WATER_PARTS, dtype=torch.float64)
            with part("light backward"):
                library.run("gain_backward", n, 1, 0, self.colors, self.log_light, by_channels, by_colors, by_log)
                lamp: list[Argument] = [self.offsets, float(shading.tau), shading.unit_range, by_log]
                library.run_parts("lamp_backward", n, lamp, by_tau)
            by_channels = by_colors
            few.append((shading.tau, by_tau.sum().float()))
        with part("colors backward"):
            cloud.sh0.grad, cloud.shN.grad = torch.empty_like(cloud.sh0), torch.empty_like(cloud.shN)
            inputs = cloud.shN.shape[1], self.sh_degree, self.directions, self.colors, by_channels
            library.run("sh_backward", n, *inputs, cloud.sh0.grad, cloud.shN.grad)

    def _activate_backward(
        self, by_means2d: Tensor, by_conics: Tensor, by_opacities: Tensor, with_geometry: bool
    ) -> None:
        cloud, n, run = self.cloud, len(self.cloud), self.library.run
        if self.kept is not None:
            by_opacities *= self.kept * (self.own_opacities * self.kept <= 1)
        by_means, by_quats, by_scales = (torch.zeros_like(t) for t in (cloud.means, cloud.quats, cloud.log_scales))
        with part("project backward"):
            if with_geometry:
                inputs = self.viewmat, self.K, cloud.means, cloud.quats, self.scales, self.radii, by_means2d, by_conics
                run("project_backward", n, self.width, self.height, *inputs, by_means, by_quats, by_scales)
            activations = cloud.log_scales, self.scales, self.own_opacities, *LOG_SCALE_LIMITS
            run("activate_backward", n, *activations, by_scales, by_opacities)
        cloud.opacity_logits.grad = by_opacities
        if with_geometry:
            cloud.means.grad, cloud.quats.grad, cloud.log_scales.grad = by_means, by_quats, by_scales
