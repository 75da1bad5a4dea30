"""What regions of the photographs do in a training: features for every Gaussian, and what acts on pictures by them.

L_s moves only features (METHOD.md section 5); the switches of training/recipes.py let labels act on the pictures.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ..base.errors import InputError
from ..gaussians.cloud import GaussianCloud
from ..rendering.render import tail
from ..scene.cameras import Camera
from ..scene.colmap import Scene
from ..scene.images import TrainingImage, cache_folder
from ..semantics.assign import EVERY, assign, semantic_loss, targets_in_view
from ..semantics.labels import write_semantics
from ..semantics.providers import choose, region_embedder, region_provider
from ..semantics.regions import SceneRegions, checked_words, find_regions, resized_labels
from ..semantics.saliency import OPEN_WATER, open_water, saliency, small_copy
from ..settings.recipes import Recipe
from ..settings.settings import TrainSettings
from ..splats.splats import Splats
from ..water.medium import Medium
from ..water.network import WaterNetwork
from .targets import Target

PRUNED = ("haze", "fish", OPEN_WATER)
"""Classes that are no part of the place, by a word of their name."""
SURE = 0.7
"""Cosine of a Gaussian's feature with a label's, and length of the feature, from which the Gaussian is taken for it."""


class Guidance:
    """Regions of a scene's training photographs, and what they say during a run by the switches of its recipe.

    about: what labels.json shall say of where they are from. Features of Gaussians start as 0 and are pulled to those
    of the regions that they are seen in; `labels_of` reads them.
    """

    def __init__(
        self,
        regions: SceneRegions,
        images: Sequence[TrainingImage],
        recipe: Recipe,
        about: dict[str, Any],
        backend: str = "auto",
    ) -> None:
        self.regions, self.recipe, self.about, self.backend = regions, recipe, about, backend
        self.cameras = {image.camera.name: image.camera for image in images}
        self.weights = salience(regions, images)
        self.maps: dict[tuple[str, int], np.ndarray] = {}

    def labels_at(self, camera: Camera) -> np.ndarray:
        """(H, W) labels of the photograph that `camera` took, at the camera's size."""
        key = camera.name, camera.width
        if key not in self.maps:
            self.maps[key] = resized_labels(self.regions.maps[camera.name], camera.width, camera.height)
        return self.maps[key]

    def emphasise(self, targets: Sequence[Target]) -> None:
        """Let each pixel count by its label where the recipe says so: all of it for what stands out most."""
        for target in targets if self.recipe.salient_pixels else ():
            labels = torch.from_numpy(self.labels_at(target.camera).astype(np.int64))
            target.emphasis = (self.weights / self.weights.max())[labels].to(target.pixels.device)

    def loss(
        self,
        cloud: GaussianCloud,
        alpha: Tensor,
        target: Target,
        medium: Medium | WaterNetwork | None,
        water_degree: int,
        iteration: int,
        progress: float,
    ) -> Tensor:
        """What the regions of a photograph add to its loss in an iteration, `progress` (0..1) of the way through.

        L_s, in one iteration of EVERY, differentiable in the cloud's features alone; and, where the recipe says so,
        open_water_loss of the picture's alpha (H, W) and of the medium, or of the cloud's background without one.
        """
        labels = self.labels_at(target.camera)
        loss = alpha.new_zeros(())
        if iteration % EVERY == 0:
            with torch.no_grad():
                targets, assigned = targets_in_view(cloud, target.camera, self.regions, self.backend, labels)
            loss = max(0.01, 0.3 * (1 - progress)) * semantic_loss(cloud.features, targets, assigned)
        if self.recipe.open_water and OPEN_WATER in self.regions.labels:
            water = torch.from_numpy(labels == self.regions.labels.index(OPEN_WATER) + 1).to(alpha.device)
            behind = tail(cloud, target.camera, medium, water_degree, self.backend)
            cost = open_water_loss(alpha, behind, target.color, water & target.valid)
            loss = loss + self.recipe.open_water * cost
        return loss

    @torch.no_grad()
    def labels_of(self, features: Tensor) -> Tensor:
        """(N,) int64: the label that features (N, 32) have come near to, 0 for those that are not SURE."""
        cosines, best = (features @ torch.from_numpy(self.regions.prototypes).to(features).T).max(1)
        lengths = features.norm(dim=1)
        return torch.where((lengths > SURE) & (cosines > SURE * lengths), best + 1, 0)

    def growth_weights(self, cloud: GaussianCloud) -> Tensor | None:
        """(N,) float32 factors on the scores of growth and reallocation, larger for what stands out; None without."""
        if not self.recipe.salient_growth:
            return None
        return self.weights.to(cloud.features)[self.labels_of(cloud.features)]

    @torch.no_grad()
    def prune(self, cloud: GaussianCloud) -> None:
        """Make Gaussians of PRUNED classes transparent where the recipe says so, for growth to drop them; never most
        of a cloud."""
        numbers = [number for number, label in enumerate(self.regions.labels, start=1) if is_pruned(label)]
        if self.recipe.class_pruning:
            dropped = torch.isin(self.labels_of(cloud.features), torch.tensor(numbers, device=cloud.features.device))
            if dropped.float().mean() < 0.5:
                cloud.opacity_logits[dropped] = -20.0

    def write(self, folder: Path, splats: Splats, up: Sequence[float], cloud: GaussianCloud) -> None:
        """Write a run's result with labels, as `label` would: labels by votes, features as they were learned."""
        made = assign(cloud, self.regions, self.cameras, self.backend)
        learned = torch.nn.functional.normalize(cloud.features.detach(), dim=1)
        write_semantics(folder, splats, up, self.regions, replace(made, features=learned), self.about)


def find_guidance(
    scene: Scene, training: Sequence[TrainingImage], recipe: Recipe, settings: TrainSettings, weights_dir: Path | None
) -> tuple[str, Guidance | None]:
    """A sentence, and the guidance by the regions of the training photographs; None where they cannot be had."""
    try:
        words = checked_words(settings.words.split(",")) if settings.words else ()
        chosen, masks = choose(scene, words, Path(settings.masks) if settings.masks else None)
        finder, captioner = region_provider(chosen, scene, masks, bool(words), weights_dir, download=False)
        embedder = region_embedder(weights_dir, download=False)
        regions = find_regions(training, finder, embedder, words, captioner, cache_folder(scene, "semantics"))
    except InputError as error:
        return f"No labels: {error}", None
    about = {"regions": chosen, "embedder": embedder.name, "words": list(words), "photographs": len(training)}
    note = " ".join([f"Labelled by {chosen}: {', '.join(regions.labels[:8])}.", *regions.notes])
    return note, Guidance(regions, training, recipe, about, settings.backend)


def salience(regions: SceneRegions, images: Sequence[TrainingImage]) -> Tensor:
    """(L + 1,) float32, .5 to 1.5 by label: how much its pixels stand out, open water not at all; 1 for label 0."""
    count = len(regions.labels) + 1
    sums, pixels = np.zeros(count), np.zeros(count)
    for image in images:
        small = small_copy(image.pixels)
        standing = np.where(open_water(small), 0, saliency(small)).astype(np.float32)
        found = cv2.resize(standing, image.valid.shape[::-1])
        labels = regions.maps[image.camera.name].ravel()
        sums += np.bincount(labels, found.ravel(), count)
        pixels += np.bincount(labels, minlength=count)
    means = sums / np.maximum(pixels, 1)
    weights = 0.5 + means / max(means[1:].max(), 1e-9)
    weights[0] = 1
    return torch.from_numpy(weights.astype(np.float32))


def open_water_loss(alpha: Tensor, behind: Tensor, photograph: Tensor, water: Tensor) -> Tensor:
    """Where a photograph shows open water: mean opacity, 0..1, and mean absolute difference of what is behind all
    Gaussians from the photograph; 0 where it shows none. Differentiable in alpha and behind.

    Open water is the tail behind all Gaussians: whatever covers it is a floater, and its colour is the tail's. alpha
    (H, W); behind (H, W, 3) or (3,) and photograph (H, W, 3) in 0..1; water (H, W) bool.
    """
    cost = alpha + (behind - photograph).abs().mean(-1)
    return torch.where(water, cost, torch.zeros_like(cost)).sum() / water.sum().clamp(min=1)


def is_pruned(label: str) -> bool:
    """Whether a label is of one of the PRUNED classes."""
    return any(f" {word} " in f" {label.casefold()} " for word in PRUNED)
