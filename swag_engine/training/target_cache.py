"""The targets of a run, made anew when the size that is trained at or the motion masks change."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import cv2
import numpy as np
import torch

from ..evidence.image_cells import open_water_cells
from ..scene.images import TrainingImage
from .inputs import RunInputs
from .motion import MotionMasks
from .state import RunState
from .targets import Target


class Emphasis(Protocol):
    """Sets the pixel weights of targets."""

    def emphasise(self, targets: Sequence[Target]) -> None:
        """Set `emphasis` of the targets."""


class Targets:
    """The targets of a run, kept for the size that is trained at now.

    Args:
        inputs: Images and settings of the run.
        depth: Depth priors (H, W) by image name.
        frames: Interpolated frames.
        emphasis: Sets the pixel weights of targets; None where all pixels count the same.
    """

    def __init__(
        self,
        inputs: RunInputs,
        depth: Mapping[str, np.ndarray],
        frames: Sequence[TrainingImage],
        emphasis: Emphasis | None = None,
    ) -> None:
        self.inputs, self.depth, self.frames, self.emphasis = inputs, depth, frames, emphasis
        self.factor = 0
        self._made_for: MotionMasks | None = None
        self._targets: list[Target] = []
        self._open_water: np.ndarray | None = None

    def at(self, state: RunState, fraction: float) -> list[Target]:
        """Return all targets at the size of a moment of the run.

        Args:
            state: State of the run.
            fraction: How far the run is, 0..1.

        Returns:
            The training images, then the interpolated frames.
        """
        factor = next((factor for until, factor in self.inputs.schedule.coarse if fraction < until), 1)
        factor = max(factor, state.relief.shrink)
        if factor != self.factor or self._made_for is not state.motion:
            device = self.inputs.device
            images = [
                Target.shrunk(state.motion.static_pixels(image), factor, device, self.depth.get(image.camera.name))
                for image in self.inputs.training
            ]
            made = [Target.shrunk(image, factor, device, None, state.recipe.frame_weight) for image in self.frames]
            if state.recipe.coverage_of_color:
                self._mark_surfaces(images)
            if self.emphasis:
                self.emphasis.emphasise(images)
            self._targets, self.factor, self._made_for = images + made, factor, state.motion
        return self._targets

    def _mark_surfaces(self, targets: Sequence[Target]) -> None:
        """Set `surface` of the targets of all training images."""
        if self._open_water is None:
            self._open_water = open_water_cells(self.inputs.training, self.inputs.scene)
        for target, cells in zip(targets, self._open_water, strict=True):
            size = target.valid.shape[::-1]
            water = cv2.resize(cells.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
            target.surface = torch.from_numpy(~water).to(target.valid.device)

    def next(self, state: RunState, fraction: float) -> Target:
        """Return the target of the next iteration: each epoch has an order of its own, which the seed decides."""
        targets = self.at(state, fraction)
        epoch, position = divmod(state.iteration, len(targets))
        order = np.random.default_rng((self.inputs.settings.seed, epoch)).permutation(len(targets))
        return targets[order[position]]

    def clear(self) -> None:
        """Release the targets' memory."""
        self._targets, self.factor, self._made_for = [], 0, None
