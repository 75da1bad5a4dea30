"""Sizes of the runs of a survey: Gaussians, iterations and memory of each block and of the coarse model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..base.errors import InputError
from ..scene.colmap import Scene
from ..scene.resolved_width import resolved_width
from ..settings.presets import FEWEST, Size
from ..settings.settings import TrainSettings
from ..training.pacing.memory import USABLE_FRACTION, needed
from ..training.pacing.preset_size import largest_size, suitable_gaussians, suited
from ..training.pacing.speed import Extent
from .cut import Part

COARSE_GAUSSIANS = 200_000
"""Largest number of Gaussians of the coarse model."""
COARSE_PIXELS = 10.0
"""Pixels of the surface that one Gaussian of the coarse model is for."""
COARSE_WIDTHS = (320, 240)
"""Widths of the images of the coarse model, pixels: the second where memory does not suffice for the first."""
PROCESS_MEMORY = 400_000_000
"""Memory of a process before it reads images, bytes: Python with torch and the engine, measured on Linux."""
FEWEST_ITERATIONS = 30
"""Iterations of a run, at least, unless fewer are asked for."""


@dataclass(frozen=True)
class Sizes:
    """What the sizes of all runs of a survey follow from.

    Attributes:
        asked: What the user chose.
        largest: The largest sizes of the preset; its iterations are those of the average block.
        width: Width of the training images, pixels.
        extent: Size of the whole survey.
        memory: Bytes that one run may need, None without a limit.
    """

    asked: TrainSettings
    largest: Size
    width: int
    extent: Extent
    memory: int | None

    @classmethod
    def of(cls, scene: Scene, settings: TrainSettings, overlap: float, memory: int | None) -> "Sizes":
        """Return the sizes of a survey.

        Args:
            scene: The scene; a few of its images are read.
            settings: What the user chose.
            overlap: Mean number of images that see a point.
            memory: Bytes of the machine that trains a block, None without a limit.

        Raises:
            InputError: If an image cannot be read.
        """
        largest = largest_size(settings)
        width = settings.width or resolved_width(scene, largest.width)
        limit = None if memory is None else int(USABLE_FRACTION * memory)
        return cls(settings, largest, width, replace(Extent.of(scene), overlap=max(2.0, overlap)), limit)

    @property
    def iterations(self) -> int:
        """Iterations of the average block."""
        return self.asked.iterations or self.largest.iterations

    def block_gaussians(self, part: Part) -> int:
        """Return the largest number of Gaussians of a block.

        A number that the user gave is that of the survey, and blocks have it in proportion to their points; else it is
        what suits the surface that the block's images show.
        """
        if self.asked.max_gaussians:
            return max(FEWEST, round(self.asked.max_gaussians * part.points / max(1, self.extent.points)))
        surface = replace(self.extent, training=round(part.whole_images), held_out=0)
        return suited(self.asked, self.largest, surface, self.width).max_gaussians

    def coarse_gaussians(self, largest: int) -> int:
        """Return the largest number of Gaussians of the coarse model: at most as many as the largest block has.

        It has no more iterations than a block. More Gaussians are trained less well in them: on a generated reef of 300
        images with 1000 iterations, the training PSNR was 20.9 dB with 30 000 and 17.2 dB with 100 000.

        Args:
            largest: Largest number of Gaussians of a block.
        """
        suitable = suitable_gaussians(self.extent, min(COARSE_WIDTHS[0], self.width), COARSE_PIXELS)
        return min(COARSE_GAUSSIANS, suitable, largest)

    def block_memory(self, part: Part, largest: int = 0) -> int:
        """Estimate the memory of a block's process, bytes: its images, its Gaussians and all of the coarse model.

        Args:
            part: The block.
            largest: Largest number of Gaussians of a block; 0 where this is the largest.
        """
        extent = replace(self.extent, training=len(part.images), held_out=0)
        own = self.block_gaussians(part)
        return PROCESS_MEMORY + needed(extent, self.width, own + self.coarse_gaussians(largest or own))

    def coarse(self, training: int, held_out: int, iterations: int, largest: int) -> tuple[TrainSettings, int]:
        """Return the settings of the coarse run, and an estimate of the memory that it needs.

        Args:
            training: Number of its training images.
            held_out: Number of its validation images.
            iterations: Number of optimisation steps.
            largest: Largest number of Gaussians of a block.

        Raises:
            InputError: If memory does not suffice.
        """
        extent = replace(self.extent, training=training, held_out=held_out)
        gaussians = self.coarse_gaussians(largest)
        for coarse_width in COARSE_WIDTHS:
            width = min(coarse_width, self.width)
            memory = PROCESS_MEMORY + needed(extent, width, gaussians)
            if self.memory is None or memory <= self.memory:
                break
        else:
            raise InputError(
                f"The coarse model of the survey needs {memory / 1e9:.2f} GB of memory, and "
                f"{(self.memory or 0) / 1e9:.2f} GB are for it: plan for a machine with more memory."
            )
        sizes = Size(iterations, width, gaussians)
        return replace(self.asked, **sizes.numbers()), memory

    def fits(self, part: Part, largest: int = 0) -> bool:
        """Return whether a block's run fits into the memory; arguments as those of `block_memory`."""
        return self.memory is None or self.block_memory(part, largest) <= self.memory

    def part_iterations(self, images: int, training: Sequence[int]) -> int:
        """Return the iterations of a block or a seam: in all of them, an image is visited equally often.

        Args:
            images: Number of its training images.
            training: Numbers of training images of the blocks.
        """
        visits = self.iterations * len(training) / sum(training)
        return max(min(FEWEST_ITERATIONS, self.iterations), round(visits * images))
