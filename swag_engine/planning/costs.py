"""What each effect costs in an iteration on this machine."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from ..effects.effect import CostProbe
from ..effects.registry import REGISTRY
from ..kernels.hardware import Hardware, hardware_for
from ..scene.cameras import Camera

TIMED_GAUSSIANS = 30_000
"""Gaussians on which costs are measured."""
ROUNDS = 6
"""Measurements of each cost, after one to warm up; the least counts."""


def measured_costs(width: int, height: int, backend: str = "auto") -> dict[str, float]:
    """Measure what each effect adds to an iteration, forward and backward, at TIMED_GAUSSIANS Gaussians.

    Other load on the machine must not count: processor time is measured and not the time that passes, and each round
    measures every effect once, so that a disturbance does not hit all measurements of one effect.

    Args:
        width: Width of the images, pixels.
        height: Their height, pixels.
        backend: What computes.

    Returns:
        Milliseconds by effect, of the processor, or of the graphics card where that computes (through WebGPU with
        transfers of each operation, which training avoids); 0 for effects that change only which images there are.
    """
    hardware = hardware_for(backend)
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator).to(hardware.device).requires_grad_()

    camera = Camera("", width, height, width, width, width / 2, height / 2, np.eye(4))
    probe = CostProbe(
        camera, "wgpu" if hardware.backend == "wgpu" else backend, hardware.device, random, TIMED_GAUSSIANS
    )
    works = {name: effect.cost(probe) for name, effect in REGISTRY.items() if effect.cost}
    with _one_thread():
        rounds = [{name: _seconds(work, hardware) for name, work in works.items()} for _ in range(ROUNDS + 1)][1:]
    return {
        name: 1000 * min(seconds[name] for seconds in rounds) / effect.cost_every if name in works else 0.0
        for name, effect in REGISTRY.items()
    }


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute on one thread within the block: the processor time of threads that wait for others is no cost."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _seconds(once: Callable[[], Tensor], hardware: Hardware) -> float:
    """Time of a forward and backward pass."""
    # Windows counts processor time in steps of 16 ms.
    clock = time.process_time if not hardware.card and sys.platform != "win32" else time.perf_counter
    started = clock()
    once().backward()
    hardware.synchronize()
    return clock() - started
