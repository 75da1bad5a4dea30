"""The backend of WGSL kernels, for float32 tensors on the CPU and a GPU of any make.

Each operation sends its tensors to the GPU and reads the result back. The water, gains and sums of contributions are
left to the CPU kernels. Sums by atomic additions differ in their last bits from run to run.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..base.camera_kind import CameraKind
from ..base.timing import part
from . import elementwise
from .cpu import CpuKernels
from .protocol import Projection, TooManyPairs, check_pairs
from .webgpu_device import WebGpu, WebGpuFailure, WebGpuUnavailable, Workspace, adapters
from .webgpu_tiles import (
    GROUP,
    MOMENTS,
    SPLAT_NUMBERS,
    THREADS,
    TILE,
    TileGrid,
    TileRows,
    count_tiles,
    depth_order,
    list_tiles,
    request_checked,
)

T = TypeVar("T")


@dataclass
class TilePairs:
    """Buffers of P pairs of a Gaussian and a tile it meets.

    Attributes:
        splats: (N, SPLAT_NUMBERS) Gaussians as they are blended.
        ids: (P,) the Gaussian of each pair, by tile, in a tile by depth.
        ranges: (tiles, 2) where each tile's pairs begin and end.
    """

    splats: Any
    ids: Any
    ranges: Any


class WebGpuKernels:
    """The backend "wgpu".

    Args:
        make_device: Gets the device when it is first needed; raises WebGpuUnavailable where that is impossible.
        cpu: Computes what has no kernel here.

    Attributes:
        failure: A sentence for the user on how the device failed, empty while it works.
    """

    def __init__(self, cpu: CpuKernels, make_device: Callable[[], WebGpu] = request_checked) -> None:
        self.cpu, self._make_device = cpu, make_device
        self.failure = ""

    def fail(self, failure: WebGpuFailure) -> None:
        """Compute everything on the CPU from now on.

        Args:
            failure: Why.
        """
        self.failure = f"{failure.finding} Training continued on the processor."

    def _or_on_cpu(self, on_gpu: Callable[[], T], on_cpu: Callable[[], T]) -> T:
        """Return what the GPU computes; what the CPU computes once the GPU has failed."""
        if not self.failure:
            try:
                return on_gpu()
            except WebGpuFailure as failure:
                self.fail(failure)
        return on_cpu()

    @cached_property
    def _device_or_reason(self) -> WebGpu | str:
        try:
            return self._make_device()
        except (WebGpuUnavailable, WebGpuFailure, MemoryError) as reason:
            return str(reason)

    @property
    def gpu(self) -> WebGpu:
        """The device, where there is one."""
        device = self._device_or_reason
        assert isinstance(device, WebGpu), device
        return device

    def unavailable_reason(self) -> str | None:
        """Say why the kernels cannot run on this machine, None where they can."""
        if isinstance(self._device_or_reason, str):
            return self._device_or_reason
        return self.cpu.unavailable_reason()

    def can_run(self, *tensors: Tensor) -> bool:
        """Return whether there is a device and all tensors are float32 on the CPU."""
        return self.cpu.can_run(*tensors) and self.unavailable_reason() is None

    def device(self) -> torch.device:
        """Return the CPU: between operations the tensors are there."""
        return torch.device("cpu")

    def details(self) -> dict[str, Any]:
        """Return the adapters of this machine, and name and memory (GB) of the one that is used, if any."""
        try:
            found = adapters()
        except WebGpuUnavailable:
            found = []
        used = None if isinstance(self._device_or_reason, str) else self.gpu
        memory = used and used.memory and round(used.memory / 1e9, 1)
        return {"device": used and used.adapter_name, "memory_gb": memory, "adapters": found}

    def run(self, kernel: str, count: int, *arguments: Any) -> None:
        """Run a kernel of `elementwise` on its tensors, in parts that fit the device's bindings."""
        getattr(self, f"_{kernel}")(count, *arguments)

    def _parts(self, count: int, numbers: int) -> Iterator[slice]:
        """Split `count` rows so that a buffer of up to `numbers` 32-bit numbers a row fits a binding."""
        size = max(1, self.gpu.largest_binding // (4 * max(numbers, 1)))
        for first in range(0, count, size):
            yield slice(first, min(first + size, count))

    def _project_forward(
        self, count: int, width: int, height: int, _: int, viewmat: Tensor, K: Tensor, *tensors: Tensor, kind: int = 0
    ) -> None:
        means, quats, scales, opacities, channels, *outputs = tensors
        shown = opacities.where(channels.isfinite().all(1), 0)
        call = camera_fields(viewmat, K) | {"width": width, "height": height, "orthographic": kind}
        gpu = self.gpu
        for rows in self._parts(count, 4):
            n = rows.stop - rows.start
            inputs = zip(("means", "quats", "scales", "opacities"), (means, quats, scales, shown), strict=True)
            buffers = {name: gpu.upload(tensor[rows]) for name, tensor in inputs}
            results = {
                name: gpu.empty(n * size) for name, size in (("means2d", 2), ("conics", 3), ("depths", 1), ("radii", 1))
            }
            gpu.run("project_forward", -(-n // THREADS), call | {"count": n}, **buffers, **results)
            for output, buffer in zip(outputs, results.values(), strict=True):
                output[rows] = gpu.read(buffer, tuple(output[rows].shape))

    def _project_orthographic_forward(self, *arguments: Any) -> None:
        self._project_forward(*arguments, kind=1)

    def _project_backward(
        self, count: int, width: int, height: int, viewmat: Tensor, K: Tensor, *tensors: Tensor, kind: int = 0
    ) -> None:
        means, quats, scales, radii, by_means2d, by_conics, *outputs = tensors
        incoming = torch.cat([by_means2d, by_conics, radii[:, None]], 1)
        call = camera_fields(viewmat, K) | {"width": width, "height": height, "orthographic": kind}
        gpu = self.gpu
        for rows in self._parts(count, 6):
            n = rows.stop - rows.start
            inputs = {"means": means, "quats": quats, "scales": scales, "radii": radii, "incoming": incoming}
            buffers = {name: gpu.upload(tensor[rows]) for name, tensor in inputs.items()}
            results = {name: gpu.empty(n * size) for name, size in (("by_means", 3), ("by_quats", 4), ("by_scales", 3))}
            gpu.run("project_backward", -(-n // THREADS), call | {"count": n}, **buffers, **results)
            for output, buffer in zip(outputs, results.values(), strict=True):
                output[rows] = gpu.read(buffer, tuple(output[rows].shape))

    def _project_orthographic_backward(self, *arguments: Any) -> None:
        self._project_backward(*arguments, kind=1)

    def _sh_forward(
        self, count: int, higher: int, degree: int, sh0: Tensor, shN: Tensor, directions: Tensor, colors: Tensor
    ) -> None:
        gpu = self.gpu
        for rows in self._parts(count, 3 * max(higher, 1)):
            n = rows.stop - rows.start
            inputs = {"sh0": sh0, "shN": shN, "directions": directions}
            buffers = {name: gpu.upload(tensor[rows]) for name, tensor in inputs.items()}
            result = gpu.empty(3 * n)
            call = {"count": n, "higher": higher, "degree": degree}
            gpu.run("sh_forward", -(-3 * n // THREADS), call, **buffers, colors=result)
            colors[rows] = gpu.read(result, (n, 3))

    def _sh_backward(
        self,
        count: int,
        higher: int,
        degree: int,
        directions: Tensor,
        colors: Tensor,
        by_colors: Tensor,
        by_sh0: Tensor,
        by_shN: Tensor,
    ) -> None:
        gpu = self.gpu
        for rows in self._parts(count, 3 * max(higher, 1)):
            n = rows.stop - rows.start
            inputs = {"directions": directions, "shown": colors, "by_colors": by_colors}
            buffers = {name: gpu.upload(tensor[rows]) for name, tensor in inputs.items()}
            results = {"by_sh0": gpu.empty(3 * n), "by_shN": gpu.empty(3 * n * higher)}
            call = {"count": n, "higher": higher, "degree": degree}
            gpu.run("sh_backward", -(-3 * n // THREADS), call, **buffers, **results, flags=gpu.empty(1))
            by_sh0[rows] = gpu.read(results["by_sh0"], (n, 1, 3))
            by_shN[rows] = gpu.read(results["by_shN"], (n, higher, 3))

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
        """See `Kernels.project`."""
        gaussians = means, quats, scales, opacities, channels
        with_camera = *gaussians, viewmat, K, width, height, kind
        return self._or_on_cpu(
            lambda: elementwise.project(self.run, torch.float64, *with_camera), lambda: self.cpu.project(*with_camera)
        )

    def _check_size(self, what: str, numbers: int) -> None:
        if 4 * numbers > self.gpu.largest_binding:
            raise TooManyPairs(
                f"{what} take {numbers * 4e-3:.1f} kB, more than the {self.gpu.largest_binding / 1e3:.1f} kB "
                f"that {self.gpu.adapter_name} reads at once. Use fewer Gaussians, a smaller width or the backend cpu."
            )

    def tile_pairs(self, projected: Projection, opacities: Tensor, width: int, height: int) -> TilePairs:
        """List the Gaussians of each tile in depth order.

        Args:
            projected: The N Gaussians.
            opacities: (N,) in 0..1.
            width: Width of the image, pixels.
            height: Height of the image, pixels.

        Returns:
            The pairs of a Gaussian and a tile.

        Raises:
            TooManyPairs: There are too many, or a buffer would be larger than the device can read.
        """
        gpu, p, n = self.gpu, projected, len(opacities)
        self._check_size("The Gaussians", n * SPLAT_NUMBERS)
        space, grid = Workspace(gpu, keeps=False), TileGrid(width, height)
        splats, keys, ids, ranges = (gpu.empty(size) for size in (n * SPLAT_NUMBERS, n, n, 2 * grid.tiles))
        if n == 0:
            return TilePairs(splats, ids, ranges)
        inputs = {
            "means2d": p.means2d, "conics": p.conics, "opacities": opacities, "depths": p.depths, "radii": p.radii
        }  # fmt: skip
        buffers = {name: gpu.upload(tensor) for name, tensor in inputs.items()}
        call = {"count": n, "width": width, "height": height}
        gpu.run("pack", -(-n // THREADS), call, **buffers, packed=splats, keys=keys, ids=ids)
        order = depth_order(space, splats, keys, ids, n)
        rows = TileRows(0, 0, grid.down)
        counted = count_tiles(space, order, grid, rows)
        pairs = int(gpu.read(counted.total, (1,), torch.int32)) & 0xFFFFFFFF
        check_pairs(pairs)
        self._check_size("The pairs of a Gaussian and a tile", pairs)
        ids = list_tiles(space, order, counted, grid, rows, pairs, ranges, gpu.empty(2))
        return TilePairs(splats, ids, ranges)

    def blend(
        self, projected: Projection, opacities: Tensor, channels: Tensor, background: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """See `Kernels.blend`."""
        p = projected
        geometry = p.means2d, p.conics, opacities, channels, background, p.depths, p.radii
        return self._or_on_cpu(
            lambda: _Blend.apply(*geometry, width, height, self),
            lambda: self.cpu.blend(p, opacities, channels, background, width, height),
        )

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
        """See `Kernels.contributions`; by the CPU kernels."""
        sizes = width, height, weights, image_gradient
        return self.cpu.contributions(projected, opacities, channels, background, *sizes)

    def sh_colors(self, sh0: Tensor, shN: Tensor, directions: Tensor, degree: int) -> Tensor:
        """See `Kernels.sh_colors`."""
        return self._or_on_cpu(
            lambda: elementwise.sh_colors(self.run, sh0, shN, directions, degree),
            lambda: self.cpu.sh_colors(sh0, shN, directions, degree),
        )

    def apply_gain(self, display: Tensor, log_gain: Tensor) -> Tensor:
        """See `Kernels.apply_gain`; by the CPU kernels."""
        return self.cpu.apply_gain(display, log_gain)

    def through_water(
        self, colors: Tensor, offsets: Tensor, coefficients: Tensor, degree: int, linear: bool, amount: float
    ) -> Tensor:
        """See `Kernels.through_water`; by the CPU kernels."""
        return self.cpu.through_water(colors, offsets, coefficients, degree, linear, amount)

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
        """See `Kernels.open_water`; by the CPU kernels."""
        return self.cpu.open_water(coefficients, viewmat, K, width, height, degree, linear, amount)

    def l1_ssim(self, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """See `Kernels.l1_ssim`."""
        return self._or_on_cpu(lambda: _L1Ssim.apply(image, target, self), lambda: self.cpu.l1_ssim(image, target))

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
        """See `Kernels.adam_step`; by the CPU kernels: the parameters of a step on the GPU are there already."""
        self.cpu.adam_step(parameter, gradient, exp_avg, exp_avg_sq, rate, beta1, beta2, eps, step)


def camera_fields(viewmat: Tensor, K: Tensor) -> dict[str, Any]:
    """Return the fields of `Call` in project.wgsl for a float64 view matrix and intrinsics."""
    turn, shift = viewmat[:3, :3].double(), viewmat[:3, 3].double()
    origin = -torch.linalg.solve(turn, shift)
    whole = origin.float()
    rows = {f"row{i}": turn[i].tolist() for i in range(3)}
    intrinsics = [float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return rows | {
        "origin": whole.tolist(), "origin_rest": (origin - whole.double()).tolist(), "intrinsics": intrinsics
    }  # fmt: skip


def _padded(values: Tensor, first: int) -> Tensor:
    """Return GROUP channels from `first` on, zeros beyond the last."""
    group = values[..., first : first + GROUP]
    return torch.nn.functional.pad(group, (0, GROUP - group.shape[-1]))


class _Blend(torch.autograd.Function):
    @staticmethod
    @part("rasterise")
    def forward(
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        channels: Tensor,
        background: Tensor,
        depths: Tensor,
        radii: Tensor,
        width: int,
        height: int,
        kernels: WebGpuKernels,
    ) -> tuple[Tensor, Tensor]:
        gpu, pixels, count = kernels.gpu, height * width, channels.shape[1]
        p = kernels.tile_pairs(Projection(means2d, conics, depths, radii), opacities, width, height)
        kernels._check_size("The image and its gradients", pixels * GROUP)
        endings, images = gpu.empty(2 * pixels), []
        tiles = -(-width // TILE) * -(-height // TILE)
        lists = {"splats": p.splats, "ids": p.ids, "ranges": p.ranges}
        for first in range(0, count, GROUP):
            image, values = gpu.empty(pixels * GROUP), gpu.upload(_padded(channels, first))
            call = {
                "background": _padded(background, first).tolist(),
                "width": width,
                "height": height,
                "end_tile": tiles,
            }
            gpu.run("blend_forward", tiles, call, **lists, channels=values, image=image, endings_out=endings)
            images.append(gpu.read(image, (height, width, GROUP)))
        transmittance = gpu.read(endings, (height, width, 2))[..., 0].clone()
        ctx.save_for_backward(channels, background, transmittance)
        ctx.kernels, ctx.pairs, ctx.endings = kernels, p, endings
        return torch.cat(images, -1)[..., :count].contiguous(), 1 - transmittance

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("rasterise backward")
    def backward(ctx: Any, by_out: Tensor, by_alpha: Tensor) -> tuple[Tensor | None, ...]:
        kernels: WebGpuKernels = ctx.kernels
        channels, background, transmittance = ctx.saved_tensors
        p: TilePairs = ctx.pairs
        gpu, (n, count), (height, width) = kernels.gpu, channels.shape, transmittance.shape
        row = MOMENTS + -(-count // GROUP) * GROUP
        kernels._check_size("The gradients of the Gaussians", n * row)
        gradients, geometry, by_alphas = gpu.empty(n * row), gpu.empty(n * MOMENTS), gpu.upload(by_alpha)
        tiles = -(-width // TILE) * -(-height // TILE)
        call = {"width": width, "height": height, "row": row, "count": n, "end_tile": tiles}
        lists = {"splats": p.splats, "ids": p.ids, "ranges": p.ranges, "endings": ctx.endings}
        for first in range(0, count, GROUP):
            of_group = {
                "channels": gpu.upload(_padded(channels, first)), "by_image": gpu.upload(_padded(by_out, first))
            }  # fmt: skip
            part_of = call | {"first_channel": first, "background": _padded(background, first).tolist()}
            gpu.run("blend_backward", tiles, part_of, **lists, **of_group, by_alpha=by_alphas, gradients=gradients)
        gpu.run("turn_moments", -(-n // THREADS), call, splats=p.splats, moments=gradients, geometry=geometry)
        by_geometry = gpu.read(geometry, (n, MOMENTS))
        by_channels = gpu.read(gradients, (n, row))[:, MOMENTS : MOMENTS + count]
        by_background = (transmittance[..., None] * by_out).sum((0, 1))
        outputs = by_geometry[:, :2], by_geometry[:, 2:5], by_geometry[:, 5], by_channels
        return *(tensor.contiguous() for tensor in outputs), by_background, None, None, None, None, None


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    @part("loss L1 and SSIM")
    def forward(ctx: Any, image: Tensor, target: Tensor, kernels: WebGpuKernels) -> tuple[Tensor, Tensor]:
        gpu, (height, width, _) = kernels.gpu, image.shape
        kernels._check_size("The derivatives of the similarity", 3 * image.numel())
        squares = -(-height // TILE) * -(-width // TILE)
        sums, derivatives = gpu.empty(2 * squares), gpu.empty(3 * image.numel())
        images = {"image": gpu.upload(image), "wanted": gpu.upload(target)}
        call = {"height": height, "width": width}
        gpu.run("l1_ssim_forward", squares, call, **images, sums=sums, derivatives=derivatives)
        ctx.kernels, ctx.call, ctx.buffers = kernels, call, images | {"slopes": derivatives}
        ctx.size, ctx.squares = image.shape, squares
        l1, similarity = (gpu.read(sums, (squares, 2)).sum(0, dtype=torch.float64) / image.numel()).float()
        return l1, similarity

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("loss L1 and SSIM backward")
    def backward(ctx: Any, by_l1: Tensor, by_ssim: Tensor) -> tuple[Tensor, None, None]:
        gpu, count = ctx.kernels.gpu, math.prod(ctx.size)
        gradient = gpu.empty(count)
        call = ctx.call | {"l1_factor": float(by_l1) / count, "ssim_factor": float(by_ssim) / count}
        gpu.run("l1_ssim_backward", ctx.squares, call, **ctx.buffers, gradient=gradient)
        return gpu.read(gradient, tuple(ctx.size)), None, None
