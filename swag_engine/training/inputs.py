"""Inputs of a training run: what is read from the scene once and never changes while the run lasts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ..base.errors import InputError
from ..gaussians.sizes import nearest_offsets
from ..kernels.hardware import hardware_of
from ..scene.colmap import Scene
from ..scene.images import TrainingImage, describe_empty, load_images
from ..settings.settings import TrainSettings
from .schedule import Schedule

NEAR_POINTS, NEAREST_SURFACE = 0.01, 0.9
"""Fraction of the sparse points that may lie before the nearest surface, since a few are wrong; and the range of that
surface as a fraction of the least range of all other points."""

Event = dict[str, Any]
"""A message to whoever started the run: `progress`, `plan`, `preview`, `checkpoint` or `result`."""


@dataclass(frozen=True)
class RunInputs:
    """Images and settings of one run.

    Attributes:
        scene: The scene, with cameras and sparse points.
        settings: Settings with all sizes filled in.
        training: Images that the loss is computed on.
        validation: Images that decisions of the run are made on.
        test: Images for the reported figures only.
        median_range: Median distance from the training cameras to the sparse points, scene units.
        device: Where the run keeps its tensors.
        schedule: When things happen.
        notes: Sentences about masks, and images without valid pixels, which are in none of the lists.
    """

    scene: Scene
    settings: TrainSettings
    training: Sequence[TrainingImage]
    validation: Sequence[TrainingImage]
    test: Sequence[TrainingImage]
    median_range: float
    device: torch.device
    schedule: Schedule
    notes: Sequence[str] = ()

    @property
    def known(self) -> list[TrainingImage]:
        """All images that a run may look at: training and validation."""
        return [*self.training, *self.validation]

    @cached_property
    def values(self) -> float:
        """Number of values, three for each pixel, of a training image; the mean of all."""
        return float(np.mean([image.pixels.size for image in self.training]))

    @cached_property
    def least_range(self) -> float:
        """Range from any training camera within which there is hardly a surface, scene units; 0 without points."""
        points = torch.from_numpy(self.scene.points.positions)
        if not len(points):
            return 0.0
        distances = nearest_offsets(points, [image.camera for image in self.training]).norm(dim=1)
        return NEAREST_SURFACE * float(np.quantile(distances.numpy(), NEAR_POINTS))

    def median_color(self) -> np.ndarray:
        """Return the median display color (3,) of the training images, in 0..1."""
        return np.median(np.stack([np.median(image.pixels, axis=(0, 1)) for image in self.training]), axis=0) / 255


def load_inputs(
    scene: Scene, settings: TrainSettings, schedule: Schedule, on_event: Callable[[Event], None]
) -> RunInputs:
    """Load the images of a scene at the training width and split them.

    Args:
        scene: The scene to train.
        settings: Settings with width filled in.
        schedule: When things happen, and the learning rates.
        on_event: Gets a `progress` event for each image.

    Returns:
        The inputs of a run.

    Raises:
        InputError: If an image cannot be read, or no training image has a valid pixel.
    """

    def report(done: int, total: int) -> None:
        on_event({"event": "progress", "stage": "load", "iteration": done, "iterations": total})

    loaded = load_images(scene, scene.views, settings.width, report)
    images = {image.camera.name: image for image in loaded if image.valid.any()}
    split = scene.split
    training, validation, test = (
        [images[name] for name in names if name in images] for names in (split.train, split.validation, split.test)
    )
    masked = sum(view.path in scene.masks.of for view in scene.views)
    masks = [f"Masks for {masked} of {len(scene.views)} photos."] if masked or scene.masks.unused else []
    empty = describe_empty(loaded)
    if not training:
        raise InputError(f"No photo is left to train on. {empty} In masks, black is what is ignored.")
    return RunInputs(
        scene,
        settings,
        training,
        validation,
        test,
        median_range(scene, training),
        hardware_of(settings).device,
        schedule,
        [*masks, *scene.masks.warnings(), *filter(None, [empty])],
    )


def median_range(scene: Scene, images: Sequence[TrainingImage]) -> float:
    """Compute the median Euclidean distance between cameras and the sparse points in front of them.

    Args:
        scene: The scene with its sparse points.
        images: The images whose cameras count.

    Returns:
        Median distance in scene units; 1 where no point lies in front of any camera.
    """
    ranges = []
    for image in images:
        in_camera = (
            scene.points.positions @ image.camera.world_to_camera[:3, :3].T + image.camera.world_to_camera[:3, 3]
        )
        ranges.append(np.linalg.norm(in_camera[in_camera[:, 2] > 0], axis=1))
    together = np.concatenate(ranges)
    return float(np.median(together)) if len(together) else 1.0
