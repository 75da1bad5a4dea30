"""What each effect costs in an iteration on this machine."""

import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ..effects.effect import CostProbe
from ..effects.registry import REGISTRY
from ..kernels.backends import device_for
from ..scene.cameras import Camera

TIMED_GAUSSIANS = 30_000
"""Gaussians on which costs are measured."""
TIMINGS = 5
"""Measurements of each cost; the least counts."""


def measured_costs(width: int, height: int, backend: str = "auto") -> dict[str, float]:
    """Measure what each effect adds to an iteration, forward and backward, at TIMED_GAUSSIANS Gaussians.

    Args:
        width: Width of the images, pixels.
        height: Their height, pixels.
        backend: What computes.

    Returns:
        Milliseconds by effect; 0 for effects that change only which images there are.
    """
    device = device_for(backend)
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator).to(device).requires_grad_()

    camera = Camera("", width, height, width, width, width / 2, height / 2, np.eye(4))
    probe = CostProbe(camera, backend, device, random, TIMED_GAUSSIANS)
    return {
        name: _milliseconds(effect.cost(probe), device) / effect.cost_every if effect.cost else 0.0
        for name, effect in REGISTRY.items()
    }


def _milliseconds(once: Callable[[], Tensor], device: torch.device) -> float:
    """Least time of a forward and backward pass, so that other load on the machine does not count."""
    times = []
    for _ in range(TIMINGS + 1):
        started = time.perf_counter()
        once().backward()
        if device.type == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - started)
    return 1000 * min(times[1:])
