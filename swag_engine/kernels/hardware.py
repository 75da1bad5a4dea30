"""What computes a run: the one place where "auto" becomes a backend."""

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from ..base.computer_memory import free_memory, total_memory
from ..base.errors import InputError
from ..settings.settings import TrainSettings
from .backends import CPU, KERNELS
from .webgpu import WebGpuKernels
from .webgpu_device import ALLOW_SOFTWARE

CARD_FILES = ("dri", "nvidia*", "dxg", "mali*", "kgsl*")
"""Files in /dev by which programs reach a card on Linux: any card, with NVIDIA's driver, in WSL, Mali, Adreno."""
WGPU_RECIPES = ("swag", "3dgs")
"""Recipes that are trained on a graphics card through WebGPU."""


@dataclass(frozen=True)
class Hardware:
    """What computes a run.

    Attributes:
        backend: Name in `KERNELS`.
        card: Whether it is a graphics card; the processor otherwise.
        name: Name of the card, or of the processor.
        memory: Memory of the card or of the computer, bytes; None where the system does not say.
    """

    backend: str
    card: bool
    name: str
    memory: int | None

    @property
    def device(self) -> torch.device:
        """Where torch keeps the tensors: for "wgpu" the CPU."""
        return KERNELS[self.backend].device()

    def free_memory(self) -> int | None:
        """Return how many bytes a run may take, None where that is not known."""
        if self.device.type == "cuda":
            return torch.cuda.mem_get_info(self.device)[0]
        return min((known for known in (free_memory(), self.memory) if known), default=None)

    def synchronize(self) -> None:
        """Wait until the card has done what was asked of it; other backends wait themselves."""
        if self.device.type == "cuda":
            torch.cuda.synchronize()


def may_have_card() -> bool:
    """Return whether this machine may have a graphics card; where it has none, `wgpu` takes a second to find that."""
    return sys.platform != "linux" or any(any(Path("/dev").glob(name)) for name in CARD_FILES)


def hardware_for(backend: str, with_wgpu: bool = True) -> Hardware:
    """Choose what computes.

    Args:
        backend: A name in `KERNELS`, or "auto": cuda, then wgpu on a card, then cpu, then torch, the first that runs.
        with_wgpu: Whether "auto" may be wgpu.

    Returns:
        The hardware; the processor once the card of "wgpu" has failed.

    Raises:
        InputError: The backend is "cuda" or "wgpu" and cannot run here.
    """
    if backend == "auto":
        backend = _automatic(with_wgpu)
    kernels = KERNELS[backend]
    wgpu = kernels if isinstance(kernels, WebGpuKernels) else None
    if wgpu and wgpu.failure:
        return hardware_for("cpu")
    if backend in ("cuda", "wgpu") and (reason := kernels.unavailable_reason()):
        raise InputError(f"The {backend} backend cannot run here: {reason}")
    device = kernels.device()
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        return Hardware(backend, True, properties.name, properties.total_memory)
    if wgpu:
        card = not wgpu.gpu.software or os.environ.get(ALLOW_SOFTWARE) == "1"
        return Hardware(backend, card, wgpu.gpu.adapter_name, wgpu.gpu.memory)
    name = f"CPU, {os.cpu_count()} cores" if device.type == "cpu" else str(device)
    return Hardware(backend, device.type != "cpu", name, total_memory())


def hardware_of(settings: TrainSettings) -> Hardware:
    """Choose what computes a run; errors as of `hardware_for`."""
    with_wgpu = settings.recipe in WGPU_RECIPES
    return hardware_for("cpu" if settings.backend == "wgpu" and not with_wgpu else settings.backend, with_wgpu)


def with_backend_of_run(settings: TrainSettings, resume: bool) -> tuple[TrainSettings, str]:
    """Replace a backend that a run does not have; errors as of `hardware_for`.

    Args:
        settings: What the user chose.
        resume: Whether the run continues, which it does without the card that it began on.

    Returns:
        The settings, and a sentence for the user where a run on "wgpu" is computed on the processor.
    """
    if settings.backend == "wgpu" and settings.recipe not in WGPU_RECIPES:
        note = (
            f"The recipe {settings.recipe} does not run on the backend wgpu, which has {' and '.join(WGPU_RECIPES)}: "
            "this run was computed on the processor."
        )
        return replace(settings, backend="cpu"), note
    if settings.backend == "wgpu" and resume and (reason := KERNELS["wgpu"].unavailable_reason()):
        return replace(settings, backend="cpu"), f"The run was continued on the processor: {reason}"
    found = hardware_of(settings).backend
    return replace(settings, backend=found if found == "wgpu" else settings.backend), ""


def device_for(backend: str) -> torch.device:
    """Choose where tensors are that are not trained; arguments and errors as of `hardware_for`."""
    return hardware_for(backend, with_wgpu=False).device


def _automatic(with_wgpu: bool) -> str:
    if not KERNELS["cuda"].unavailable_reason():
        return "cuda"
    if with_wgpu and may_have_card():
        wgpu = KERNELS["wgpu"]
        assert isinstance(wgpu, WebGpuKernels)
        if not wgpu.unavailable_reason() and not wgpu.gpu.software and not wgpu.failure:
            return "wgpu"
    return "torch" if CPU.unavailable_reason() else "cpu"
