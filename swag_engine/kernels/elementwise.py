"""The kernels that take each Gaussian or colour by itself: called alike on the CPU and on a card.

Each function's `run(kernel, count, *arguments)` launches a kernel of its backend over [0, count).
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..base.timing import part

Run = Callable[..., None]


class Project(torch.autograd.Function):
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
        run: Run,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        n = len(means)
        viewmat, K, means, quats, scales = (tensor.contiguous() for tensor in (viewmat, K, means, quats, scales))
        means2d, conics, depths, radii = (means.new_empty(n, *shape) for shape in ((2,), (3,), (), ()))
        limits = opacities.contiguous(), channels.contiguous()
        inputs = width, height, channels.shape[1], viewmat, K, means, quats, scales, *limits
        run("project_forward", n, *inputs, means2d, conics, depths, radii)
        ctx.save_for_backward(viewmat, K, means, quats, scales, radii)
        ctx.size, ctx.run = (width, height), run
        ctx.mark_non_differentiable(depths, radii)
        return means2d, conics, depths, radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("project backward")
    def backward(ctx: Any, by_means2d: Tensor, by_conics: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        results = [torch.empty_like(tensor) for tensor in saved[2:5]]
        incoming = by_means2d.contiguous(), by_conics.contiguous()
        ctx.run("project_backward", len(results[0]), *ctx.size, *saved, *incoming, *results)
        return *results, None, None, None, None, None, None, None


class Colors(torch.autograd.Function):
    @staticmethod
    @part("colours")
    def forward(ctx: Any, sh0: Tensor, shN: Tensor, directions: Tensor, degree: int, run: Run) -> Tensor:
        sh0, shN, directions = sh0.contiguous(), shN.contiguous(), directions.contiguous()
        colors = torch.empty_like(directions)
        run("sh_forward", len(sh0), shN.shape[1], degree, sh0, shN, directions, colors)
        ctx.save_for_backward(directions, colors)
        ctx.sizes, ctx.run = (shN.shape[1], degree), run
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("colours backward")
    def backward(ctx: Any, by_colors: Tensor) -> tuple[Tensor | None, ...]:
        directions, colors = ctx.saved_tensors
        n, (higher, degree) = len(directions), ctx.sizes
        by_sh0, by_shN = directions.new_empty(n, 1, 3), directions.new_empty(n, higher, 3)
        ctx.run("sh_backward", n, higher, degree, directions, colors, by_colors.contiguous(), by_sh0, by_shN)
        return by_sh0, by_shN, None, None, None


class Relit(torch.autograd.Function):
    @staticmethod
    @part("light")
    def forward(ctx: Any, display: Tensor, log_factor: Tensor, run: Run) -> Tensor:
        display, n, strides = display.contiguous(), len(display), log_factor.stride()
        shown, logs = torch.empty_like(display), log_factor.as_strided((1,), (1,))  # where its numbers begin
        run("relit_forward", n, *strides, display, logs, shown)
        ctx.save_for_backward(display, log_factor)
        ctx.run = run
        return shown

    @staticmethod
    @torch.autograd.function.once_differentiable
    @part("light backward")
    def backward(ctx: Any, by_shown: Tensor) -> tuple[Tensor, Tensor, None]:
        display, log_factor = ctx.saved_tensors
        n, strides, logs = len(display), log_factor.stride(), log_factor.as_strided((1,), (1,))
        by_display, by_log_factor = torch.empty_like(display), torch.empty_like(display)
        ctx.run("relit_backward", n, *strides, display, logs, by_shown.contiguous(), by_display, by_log_factor)
        return by_display, by_log_factor, None
