"""The backends and the choice among them."""

import sys
from pathlib import Path

import torch
from torch import Tensor

from ..base.errors import InputError
from .cpu import CpuKernels
from .cuda import CudaKernels
from .protocol import Kernels
from .reference.kernels import REFERENCE
from .webgpu import WebGpuKernels

CPU = CpuKernels()
"""The CPU kernels, which the backend "wgpu" needs too."""
KERNELS: dict[str, Kernels] = {"cpu": CPU, "cuda": CudaKernels(), "wgpu": WebGpuKernels(CPU), "torch": REFERENCE}
"""The backends by name; for single operations "auto" takes the first that can run, for runs `automatic_backend`."""

CARD_FILES = ("dri", "nvidia*", "dxg", "mali*", "kgsl*")
"""Files in /dev by which programs reach a card on Linux: any card, with NVIDIA's driver, in WSL, Mali, Adreno."""


def may_have_card() -> bool:
    """Return whether this machine may have a graphics card; where it has none, `wgpu` takes a second to find that."""
    return sys.platform != "linux" or any(any(Path("/dev").glob(name)) for name in CARD_FILES)


def automatic_backend() -> str:
    """Return the backend that a run with "auto" takes: cuda, then wgpu on a card, then cpu, then torch."""
    if not KERNELS["cuda"].unavailable_reason():
        return "cuda"
    if may_have_card():
        wgpu = KERNELS["wgpu"]
        assert isinstance(wgpu, WebGpuKernels)
        if not wgpu.unavailable_reason() and not wgpu.gpu.software and not wgpu.failure:
            return "wgpu"
    return "torch" if CPU.unavailable_reason() else "cpu"


def kernels_for(backend: str, *tensors: Tensor) -> Kernels:
    """Choose the backend that computes on tensors.

    Args:
        backend: A name in `KERNELS`, or "auto": native kernels where they can run, torch otherwise.
        *tensors: The tensors; "torch" takes any dtype and device, the others float32 on their own device.

    Returns:
        The backend.

    Raises:
        ValueError: There is no such backend.
        InputError: The backend cannot run here, or does not take the tensors.
    """
    if backend == "auto":
        return next(kernels for kernels in KERNELS.values() if kernels.can_run(*tensors))
    if backend not in KERNELS:
        raise ValueError(f"backend {backend!r} is none of {', '.join(('auto', *KERNELS))}")
    kernels = KERNELS[backend]
    if isinstance(kernels, WebGpuKernels) and kernels.failure:
        return kernels.cpu
    if not kernels.can_run(*tensors):
        kind = f"{tensors[0].dtype} on {tensors[0].device}".removeprefix("torch.")
        reason = kernels.unavailable_reason() or f"it takes float32 on its own device, not {kind}."
        raise InputError(f"The {backend} backend cannot run here: {reason}")
    return kernels


def device_for(backend: str) -> torch.device:
    """Choose where a run keeps its tensors.

    Args:
        backend: A name in `KERNELS`, or "auto": the card where CUDA kernels can run, the CPU otherwise.

    Returns:
        The device.

    Raises:
        InputError: The backend is "cuda" or "wgpu" and cannot run here.
    """
    if backend == "auto":
        backend = "cpu" if KERNELS["cuda"].unavailable_reason() else "cuda"
    reason = KERNELS[backend].unavailable_reason() if backend in ("cuda", "wgpu") else None
    if reason:
        raise InputError(f"The {backend} backend cannot run here: {reason}")
    return KERNELS[backend].device()
