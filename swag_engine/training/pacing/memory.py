"""What memory a run takes, before it is spent, and how a run goes on that has too little of it."""

import ctypes
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from ...base.errors import InputError
from ...gaussians.cloud import GaussianCloud
from ...gaussians.densify import PER_GAUSSIAN
from ...kernels.protocol import TooManyPairs
from ...settings.settings import TrainSettings
from .speed import Extent

BYTES_PER_GAUSSIAN, BYTES_PER_PIXEL = 1280, 24
SHARE = 0.8
"""Of the free memory that a run may take."""
FEWEST, NARROWEST = 5_000, 160
"""Gaussians and pixels of width that a run is cut down to, at most."""
KEPT = 0.7
"""Share of the Gaussians that are kept each time a run meets the end of memory."""
SMALLEST = 8
"""Part of their size that photographs are shrunk to, at most, when a run has met the end of memory."""
TOO_LITTLE = "This needs more memory than there is: close other programs, use fewer Gaussians or a smaller width."

T = TypeVar("T")


def needed(extent: Extent, width: int, gaussians: int) -> int:
    """Bytes of a run: photographs of the whole scene at `width` pixels and so many Gaussians with all their copies."""
    return gaussians * BYTES_PER_GAUSSIAN + int(
        extent.pixels(width) * (extent.training + extent.held_out) * BYTES_PER_PIXEL
    )


def free_memory(device: torch.device) -> int | None:
    """Bytes that are free on a device, None where the system does not tell."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    if sys.platform == "win32":
        status = (ctypes.c_uint64 * 8)()
        ctypes.cast(status, ctypes.POINTER(ctypes.c_uint32))[0] = ctypes.sizeof(status)
        return int(status[2]) if ctypes.windll.kernel32.GlobalMemoryStatusEx(status) else None
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return 1024 * int(next(line.split()[1] for line in lines if line.startswith("MemAvailable")))
    except (OSError, StopIteration):
        return None


def fit_memory(extent: Extent, settings: TrainSettings, free: int | None) -> tuple[TrainSettings, str]:
    """The settings with as many Gaussians, then pixels, as fit `free` bytes, and a sentence where that is fewer.

    Raises InputError where even the least does not fit.
    """
    limit = SHARE * free if free else float("inf")
    gaussians, width = settings.max_gaussians, settings.width
    while needed(extent, width, gaussians) > limit and gaussians > FEWEST:
        gaussians = max(FEWEST, int(0.9 * gaussians))
    while needed(extent, width, gaussians) > limit and width > NARROWEST:
        width = max(NARROWEST, int(0.9 * width))
    if (gaussians, width) == (settings.max_gaussians, settings.width):
        return settings, ""
    asked = needed(extent, settings.width, settings.max_gaussians) / 1e9
    if needed(extent, width, gaussians) > limit:
        raise InputError(
            f"This scene needs {needed(extent, width, gaussians) / 1e9:.2f} GB of memory at the least and "
            f"{(free or 0) / 1e9:.2f} GB are free: close other programs or use fewer photographs."
        )
    note = (
        f"Memory: {settings.max_gaussians} Gaussians and photographs of {settings.width} pixels need {asked:.2f} GB, "
        f"and {(free or 0) / 1e9:.2f} GB are free; trained with {gaussians} and {width}."
    )
    return replace(settings, max_gaussians=gaussians, width=width), note


@torch.no_grad()
def reduced(cloud: GaussianCloud) -> tuple[GaussianCloud, Tensor]:
    """The most opaque KEPT of a cloud, in their order, and their indices (N',)."""
    kept = torch.sort(cloud.opacity_logits, descending=True, stable=True).indices[: max(1, int(KEPT * len(cloud)))]
    kept = kept.sort().values
    values = {name: getattr(cloud, name)[kept] for name in PER_GAUSSIAN}
    return GaussianCloud(**values, background=cloud.background), kept


@dataclass
class Relief:
    """How a run was cut down after it met the end of memory. shrink: factor that photographs are smaller by, at
    least; most: limit of the Gaussians, None for the settings'; times: how often; unscored: whether memory did not
    reach for held-out photographs."""

    shrink: int = 1
    most: int | None = None
    times: int = 0
    unscored: bool = False

    def relieve(self, gaussians: int) -> None:
        """Cut down again: no more than so many Gaussians, then smaller photographs. Raises InputError at the end."""
        if self.times:
            self.shrink *= 2
        if self.shrink > SMALLEST:
            raise InputError(TOO_LITTLE)
        self.most, self.times = gaussians, self.times + 1

    @property
    def note(self) -> str:
        """A sentence for the user, empty where nothing happened."""
        sentences = []
        if self.times:
            pictures = f" and photographs down to 1/{self.shrink} of their size" if self.shrink > 1 else ""
            sentences.append(
                f"Memory ran out {self.times} times: the run went on with at most {self.most} Gaussians{pictures}."
            )
        if self.unscored:
            sentences.append("Memory did not reach to score all held-out photographs.")
        return " ".join(sentences)


def is_shortage(error: Exception) -> bool:
    """Whether something failed for want of memory, on any device."""
    words = str(error).lower()
    return isinstance(error, MemoryError | torch.OutOfMemoryError | TooManyPairs) or (
        isinstance(error, RuntimeError) and ("out of memory" in words or "can't allocate memory" in words)
    )


def within_memory(compute: Callable[[], T]) -> T | None:
    """What `compute` returns, None where memory does not reach for it."""
    try:
        return compute()
    except (MemoryError, RuntimeError, TooManyPairs) as error:
        if not is_shortage(error):
            raise
    # Not before the error is gone are the tensors that its frames held.
    if torch.cuda.is_initialized():
        torch.cuda.empty_cache()
    return None
