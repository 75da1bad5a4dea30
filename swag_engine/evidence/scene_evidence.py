"""All that decisions about effects are made from, computed when it is first asked for."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..scene.colmap import Scene
from ..scene.images import TrainingImage
from .image_cells import open_water_light
from .observations import LEAST_OBSERVATIONS, Observations, observe
from .water_terms import WaterTerms, find_water_terms

DepthNetwork = Callable[[TrainingImage], np.ndarray]
"""Inverse depth (H, W) of an image, up to scale and shift."""
FrameNetwork = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""A frame (H, W, 3) uint8 between two, at a fraction of the way."""


@dataclass
class SceneEvidence:
    """Images and sparse points of a scene, and what follows from them.

    Attributes:
        scene: The scene.
        images: Images that may be looked at, sorted by name.
        labels_wanted: Whether the user asked for labels.
        depth: A depth network, None without one.
        interpolator: A frame interpolation network, None without one.
    """

    scene: Scene
    images: Sequence[TrainingImage]
    labels_wanted: bool = False
    depth: DepthNetwork | None = None
    interpolator: FrameNetwork | None = None

    @cached_property
    def names(self) -> list[str]:
        """Names of the images."""
        return [image.camera.name for image in self.images]

    @cached_property
    def observations(self) -> Observations:
        """Linear light of the sparse points in the images."""
        views = {view.name: view for view in self.scene.views}
        return observe(self.images, [views[name].point_indices for name in self.names], self.scene.points)

    @cached_property
    def water_terms(self) -> WaterTerms | None:
        """Water, lamp and camera terms; None where there are too few observations."""
        if len(self.observations) < LEAST_OBSERVATIONS:
            return None
        return find_water_terms(self.observations, open_water_light(self.images, self.scene))
