"""Memory of a run: what it needs, how it is reduced to what is free, and what happens when memory runs out."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from ...base.errors import InputError
from ...gaussians.cloud import GaussianCloud
from ...gaussians.densify import PER_GAUSSIAN
from ...kernels.protocol import TooManyPairs
from ...settings.presets import FEWEST
from ...settings.settings import TrainSettings
from .speed import Extent

BYTES_PER_GAUSSIAN = 1400
"""Memory of one Gaussian with its moments, gradients and copies."""
BYTES_PER_PIXEL = 24
"""Memory of one pixel of a training image at all sizes."""
USABLE_FRACTION = 0.8
"""Fraction of the free memory that a run may take."""
NARROWEST = 160
"""Pixels of image width that a run is reduced to, at least."""
KEPT = 0.7
"""Fraction of the Gaussians that are kept each time a run runs out of memory."""
MOST_SHRINK = 8
"""Factor by which images are reduced, at most, when a run has run out of memory."""
TOO_LITTLE = "This needs more memory than there is: close other programs, use fewer Gaussians or a smaller width."

T = TypeVar("T")


def needed(extent: Extent, width: int, gaussians: int) -> int:
    """Estimate the memory that a run needs.

    Args:
        extent: Size of the scene.
        width: Width of the images, pixels.
        gaussians: Largest number of Gaussians.

    Returns:
        Bytes.
    """
    return gaussians * BYTES_PER_GAUSSIAN + int(
        extent.pixels(width) * (extent.training + extent.held_out) * BYTES_PER_PIXEL
    )


def fit_memory(extent: Extent, settings: TrainSettings, free: int | None) -> tuple[TrainSettings, str]:
    """Reduce a run to what fits into memory: fewer Gaussians first, then smaller images.

    Args:
        extent: Size of the scene.
        settings: Settings with all sizes filled in.
        free: Free bytes, None where that is not known.

    Returns:
        The settings, and a sentence for the user where they were reduced, else an empty text.

    Raises:
        InputError: If even the smallest run does not fit.
    """
    limit = USABLE_FRACTION * free if free else float("inf")
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
            f"{(free or 0) / 1e9:.2f} GB are free: close other programs or use fewer images."
        )
    note = (
        f"Memory: {settings.max_gaussians} Gaussians and images of {settings.width} pixels need {asked:.2f} GB, "
        f"and {(free or 0) / 1e9:.2f} GB are free; trained with {gaussians} and {width}."
    )
    return replace(settings, max_gaussians=gaussians, width=width), note


@torch.no_grad()
def reduced(cloud: GaussianCloud) -> tuple[GaussianCloud, Tensor]:
    """Keep the most opaque fraction KEPT of a cloud in their order; also return their indices (N',)."""
    kept = torch.sort(cloud.opacity_logits, descending=True, stable=True).indices[: max(1, int(KEPT * len(cloud)))]
    kept = kept.sort().values
    values = {name: getattr(cloud, name)[kept] for name in PER_GAUSSIAN}
    return GaussianCloud(**values, background=cloud.background), kept


@dataclass
class Relief:
    """How a run was reduced after it ran out of memory.

    Attributes:
        shrink: Factor by which images are reduced, at least.
        most: Limit of the number of Gaussians, None for that of the settings.
        times: How often memory ran out.
        unscored: Whether memory did not suffice to score held-out images.
    """

    shrink: int = 1
    most: int | None = None
    times: int = 0
    unscored: bool = False

    @property
    def exhausted(self) -> bool:
        """Whether the run cannot be reduced any further."""
        return bool(self.times) and 2 * self.shrink > MOST_SHRINK

    def relieve(self, gaussians: int) -> None:
        """Reduce the run again: no more than so many Gaussians, then smaller images too.

        Args:
            gaussians: Gaussians that are left.

        Raises:
            InputError: If the run cannot be reduced any further.
        """
        if self.exhausted:
            raise InputError(TOO_LITTLE)
        if self.times:
            self.shrink *= 2
        self.most, self.times = gaussians, self.times + 1

    @property
    def note(self) -> str:
        """A sentence for the user, empty where nothing happened."""
        sentences = []
        if self.times:
            pictures = f" and images reduced to 1/{self.shrink} of their size" if self.shrink > 1 else ""
            sentences.append(
                f"Memory ran out {self.times} times: the run continued with at most {self.most} Gaussians{pictures}."
            )
        if self.unscored:
            sentences.append("Memory did not suffice to score all held-out images.")
        return " ".join(sentences)


def is_shortage(error: Exception) -> bool:
    """Return whether an error means that memory ran out, on any device."""
    words = str(error).lower()
    return isinstance(error, MemoryError | torch.OutOfMemoryError | TooManyPairs) or (
        isinstance(error, RuntimeError) and ("out of memory" in words or "can't allocate memory" in words)
    )


def none_if_out_of_memory(compute: Callable[[], T]) -> T | None:
    """Return what `compute` returns, None where it runs out of memory."""
    try:
        return compute()
    except (MemoryError, RuntimeError, TooManyPairs) as error:
        if not is_shortage(error):
            raise
    # The tensors that the error's frames held are released only now.
    if torch.cuda.is_initialized():
        torch.cuda.empty_cache()
    return None
