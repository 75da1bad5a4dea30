"""Which code draws: compiled kernels on the CPU, CUDA kernels, or plain torch."""

from types import ModuleType

import torch
from torch import Tensor

from ..base.errors import InputError
from . import cpu, cuda

BACKENDS = ("auto", "cpu", "cuda", "torch")
KERNELS = {"cpu": cpu, "cuda": cuda}


def kernels_for(backend: str, *tensors: Tensor) -> ModuleType | None:
    """The module of kernels (cpu or cuda) that takes `tensors`, None where torch does it.

    backend: "cpu" or "cuda" (float32 on that device), "torch" (any dtype and device, slow), or "auto": kernels where
    they can. Raises ValueError for another word, InputError when the kernels that are asked for cannot run.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend {backend!r} is none of {', '.join(BACKENDS)}")
    if backend == "torch":
        return None
    for name, kernels in KERNELS.items():
        if backend in ("auto", name) and kernels.can_run(*tensors):
            return kernels
    if backend != "auto":
        kind = f"{tensors[0].dtype} on {tensors[0].device}".removeprefix("torch.")
        because = KERNELS[backend].reason() or f"it takes float32 on its own device, not {kind}."
        raise InputError(f"The {backend} backend cannot run here: {because}")
    return None


def device_for(backend: str) -> torch.device:
    """Where a run with this backend keeps its tensors. Raises InputError when "cuda" is asked for and cannot run."""
    if backend == "cuda" and (reason := cuda.reason()):
        raise InputError(f"The cuda backend cannot run here: {reason}")
    launcher = cuda.driver()
    if backend in ("auto", "cuda") and not isinstance(launcher, str):
        return torch.device(launcher.device_type)
    if backend == "torch" and torch.accelerator.is_available():
        return torch.accelerator.current_accelerator() or torch.device("cpu")
    return torch.device("cpu")
