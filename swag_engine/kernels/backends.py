"""The backends and the choice among them."""

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
"""The backends by name; for single operations "auto" takes the first that can run, for runs see hardware.py."""


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
