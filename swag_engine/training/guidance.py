"""Guidance of training by regions of the images: features of the Gaussians, and switches that act on rendered images.

L_s moves only features (docs/method.md section 5); the switches of settings/recipes.py let labels act on the pictures.
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
from ..rendering.render import background_color
from ..scene.cameras import Camera
from ..scene.colmap import Scene
from ..scene.images import TrainingImage, cache_folder
from ..semantics.assign import FEATURES_EVERY, assign, semantic_loss, targets_in_view
from ..semantics.labels import write_semantics
from ..semantics.providers import choose_provider, make_embedder, make_provider
from ..semantics.regions import SceneRegions, check_words, find_regions, resized_labels
from ..semantics.saliency import OPEN_WATER, open_water, resize_for_saliency, saliency
from ..settings.recipes import Recipe
from ..settings.settings import TrainSettings
from ..splats.splats import Splats
from ..water.medium import Medium
from ..water.network import WaterNetwork
from .targets import Target

PRUNED = ("haze", "fish", OPEN_WATER)
"""Classes that are no part of the scene, by a word of their name."""
SURE = 0.7
"""Cosine of a Gaussian's feature with that of a label, and length of the feature, from which it has the label."""


class Guidance:
    """Regions of a scene's training images, and what they do during a run by the switches of its recipe.

    Features of Gaussians start at 0 and approach those of the regions that they are seen in; `labels_of` reads them.

    Args:
        regions: The regions.
        images: The training images.
        recipe: What the run computes.
        about: Origin of the regions, for labels.json.
        backend: What computes.
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
        """Return the labels (H, W) of the image that `camera` took, at the camera's size."""
        key = camera.name, camera.width
        if key not in self.maps:
            self.maps[key] = resized_labels(self.regions.maps[camera.name], camera.width, camera.height)
        return self.maps[key]

    def emphasise(self, targets: Sequence[Target]) -> None:
        """Weigh each pixel by the salience of its label where the recipe says so, 1 for the most salient."""
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
        """Compute what the regions of an image add to its loss.

        In one iteration of FEATURES_EVERY that is L_s, differentiable in the cloud's features alone; and, where the
        recipe says so, open_water_loss.

        Args:
            cloud: The Gaussians.
            alpha: (H, W) of the rendered image.
            target: The training image.
            medium: The water, None without.
            water_degree: Degree of the background light, 0..2.
            iteration: Number of the iteration.
            progress: How far the run is, 0..1.

        Returns:
            The loss, a scalar.
        """
        labels = self.labels_at(target.camera)
        loss = alpha.new_zeros(())
        if iteration % FEATURES_EVERY == 0:
            with torch.no_grad():
                targets, assigned = targets_in_view(cloud, target.camera, self.regions, self.backend, labels)
            loss = max(0.01, 0.3 * (1 - progress)) * semantic_loss(cloud.features, targets, assigned)
        if self.recipe.open_water and OPEN_WATER in self.regions.labels:
            water = torch.from_numpy(labels == self.regions.labels.index(OPEN_WATER) + 1).to(alpha.device)
            behind = background_color(cloud, target.camera, medium, water_degree, self.backend)
            cost = open_water_loss(alpha, behind, target.color, water & target.valid)
            loss = loss + self.recipe.open_water * cost
        return loss

    @torch.no_grad()
    def labels_of(self, features: Tensor) -> Tensor:
        """Return the labels (N,) int64 that features (N, 32) are close to, 0 for those that are not SURE."""
        cosines, best = (features @ torch.from_numpy(self.regions.prototypes).to(features).T).max(1)
        lengths = features.norm(dim=1)
        return torch.where((lengths > SURE) & (cosines > SURE * lengths), best + 1, 0)

    def densification_weights(self, cloud: GaussianCloud) -> Tensor | None:
        """Return factors (N,) float32 on the scores of densification and relocation by salience; None without."""
        if not self.recipe.salient_densification:
            return None
        return self.weights.to(cloud.features)[self.labels_of(cloud.features)]

    @torch.no_grad()
    def prune(self, cloud: GaussianCloud) -> None:
        """Make Gaussians of PRUNED classes transparent where the recipe says so, unless they are most of the cloud.

        Densification then drops them.
        """
        numbers = [number for number, label in enumerate(self.regions.labels, start=1) if is_pruned(label)]
        if self.recipe.class_pruning:
            dropped = torch.isin(self.labels_of(cloud.features), torch.tensor(numbers, device=cloud.features.device))
            if dropped.float().mean() < 0.5:
                cloud.opacity_logits[dropped] = -20.0

    def write(self, folder: Path, splats: Splats, up: Sequence[float], cloud: GaussianCloud) -> None:
        """Write a run's result with labels, as the command `label` does: labels by votes, features as learned."""
        made = assign(cloud, self.regions, self.cameras, self.backend)
        learned = torch.nn.functional.normalize(cloud.features.detach(), dim=1)
        write_semantics(folder, splats, up, self.regions, replace(made, features=learned), self.about)


def find_guidance(
    scene: Scene, training: Sequence[TrainingImage], recipe: Recipe, settings: TrainSettings, weights_dir: Path | None
) -> tuple[str, Guidance | None]:
    """Find the regions of the training images.

    Args:
        scene: The scene.
        training: The training images.
        recipe: What the run computes.
        settings: Words and masks that the user gave.
        weights_dir: Folder where networks are looked for first.

    Returns:
        A sentence for the user, and the guidance; None where regions cannot be found.
    """
    try:
        words = check_words(settings.words.split(",")) if settings.words else ()
        chosen, masks = choose_provider(scene, words, Path(settings.masks) if settings.masks else None)
        finder, captioner = make_provider(chosen, scene, masks, bool(words), weights_dir, download=False)
        embedder = make_embedder(weights_dir, download=False)
        regions = find_regions(training, finder, embedder, words, captioner, cache_folder(scene, "semantics"))
    except InputError as error:
        return f"No labels: {error}", None
    about = {"regions": chosen, "embedder": embedder.name, "words": list(words), "photographs": len(training)}
    note = " ".join([f"Labelled by {chosen}: {', '.join(regions.labels[:8])}.", *regions.notes])
    return note, Guidance(regions, training, recipe, about, settings.backend)


def salience(regions: SceneRegions, images: Sequence[TrainingImage]) -> Tensor:
    """Return the salience (L + 1,) float32 of each label, .5 to 1.5; open water counts as not salient, label 0 as 1."""
    count = len(regions.labels) + 1
    sums, pixels = np.zeros(count), np.zeros(count)
    for image in images:
        small = resize_for_saliency(image.pixels)
        standing = np.where(open_water(small), 0, saliency(small)).astype(np.float32)
        found = cv2.resize(standing, image.valid.shape[::-1])
        labels = regions.maps[image.camera.name].ravel()
        sums += np.bincount(labels, found.ravel(), count)
        pixels += np.bincount(labels, minlength=count)
    means = sums / np.maximum(pixels, 1)
    weights = 0.5 + means / max(means[1:].max(), 1e-9)
    weights[0] = 1
    return torch.from_numpy(weights.astype(np.float32))


def open_water_loss(alpha: Tensor, behind: Tensor, image: Tensor, water: Tensor) -> Tensor:
    """Penalise opacity in front of open water, and a background color that differs from it.

    Open water is the background behind all Gaussians: whatever covers it is a floater.

    Args:
        alpha: (H, W) of the rendered image.
        behind: (H, W, 3) or (3,) background color, 0..1.
        image: (H, W, 3) training image, 0..1.
        water: (H, W) bool, pixels that show open water.

    Returns:
        Mean opacity plus mean absolute difference over these pixels, 0 without any; differentiable in alpha, behind.
    """
    cost = alpha + (behind - image).abs().mean(-1)
    return torch.where(water, cost, torch.zeros_like(cost)).sum() / water.sum().clamp(min=1)


def is_pruned(label: str) -> bool:
    """Return whether a label is of one of the PRUNED classes."""
    return any(f" {word} " in f" {label.casefold()} " for word in PRUNED)
