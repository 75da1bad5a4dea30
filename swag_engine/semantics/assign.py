"""Labels of Gaussians from labels of images, by what each Gaussian adds to each pixel (docs/method.md section 5)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..gaussians.cloud import GaussianCloud
from ..gaussians.contributions import contribution_sums
from ..rasterize.api import rasterize
from ..scene.cameras import Camera
from .embed import DIMENSIONS
from .label_gains import label_gains
from .regions import SceneRegions
from .saliency import OPEN_WATER

MIN_WEIGHT = 0.5
"""Pixels that a Gaussian must add to a region to belong to it."""
MIN_FRACTION = 0.5
"""Fraction, of all that a Gaussian adds to the image, that it must add to a region to belong to it."""
FEATURES_EVERY = 4
"""Features are learned in one iteration of so many, because that costs as much as the rest of an iteration."""
LABELS_PER_PASS = 16
"""Labels that one pass over an image sums."""
ROUNDS = 3
"""Rounds of expectation maximisation after the first votes; more did not change mIoU on the demo's validation views."""
MIN_LABEL_ALPHA = 1e-4
"""Smallest alpha of a pixel's label that the pixel's vote is divided by."""


@dataclass(frozen=True, eq=False)
class Assignment:
    """Labels and features of N Gaussians.

    Attributes:
        features: (N, 32), mean of the embeddings of the regions that the Gaussian belongs to, of length 1; 0 for none.
        labels: (N,) int64, 0 for none.
        agreement: (N,), fraction of what the Gaussian adds to labelled pixels that lies in its own label; 0 for none.
        gains: (L + 1,) float64, the factors on the coverage of labels in maps (`label_gains`).
    """

    features: Tensor
    labels: Tensor
    agreement: Tensor
    gains: np.ndarray


@torch.no_grad()
def label_weights(
    cloud: GaussianCloud, camera: Camera, labels: np.ndarray, backend: str = "auto"
) -> tuple[Tensor, Tensor, Tensor]:
    """Sum what each Gaussian adds to the labels of one image: transmittance times alpha over their pixels.

    Args:
        cloud: N Gaussians.
        camera: Camera of the image; it is resized to the labels.
        labels: (H, W) integers, 0 for none.
        backend: What computes.

    Returns:
        The R labels of the image, (R,) int64, ascending; the weights (N, R), pixels; and each Gaussian's sum (N,) over
        the whole image, pixels.
    """
    camera = camera.resized(labels.shape[1])
    present = np.unique(labels[labels > 0]).astype(np.int64)
    masks = torch.from_numpy(np.stack([labels == label for label in present] + [np.ones_like(labels)], -1))
    weights = contribution_sums(cloud, camera, masks.to(cloud.means), backend)
    return torch.from_numpy(present).to(weights.device), weights[:, :-1], weights[:, -1]


def labels_in_view(cloud: GaussianCloud, camera: Camera, labels: np.ndarray, backend: str = "auto") -> Tensor:
    """Find the label of the region of one image that each Gaussian belongs to.

    It is the label with the largest weight, if that is at least MIN_WEIGHT and MIN_FRACTION of the Gaussian's sum.

    Args:
        cloud: N Gaussians.
        camera: Camera of the image.
        labels: (H, W) integers, 0 for none.
        backend: What computes.

    Returns:
        Labels (N,) int64, 0 for none.
    """
    return _dominant_labels(*label_weights(cloud, camera, labels, backend))


def targets_in_view(
    cloud: GaussianCloud,
    camera: Camera,
    regions: SceneRegions,
    backend: str = "auto",
    resized: np.ndarray | None = None,
) -> tuple[Tensor, Tensor]:
    """Find the targets of `semantic_loss` in one view.

    Args:
        cloud: N Gaussians.
        camera: Camera of the view.
        regions: Regions of the scene's images.
        backend: What computes.
        resized: (H, W) labels of the image at another size than those of `regions`.

    Returns:
        Targets (N, 32) float32, and which Gaussians have one, (N,) bool.
    """
    labels = labels_in_view(cloud, camera, regions.maps[camera.name] if resized is None else resized, backend)
    return _features(regions, camera.name, labels), labels > 0


def semantic_loss(features: Tensor, targets: Tensor, assigned: Tensor) -> Tensor:
    """Compute L_s of docs/method.md section 5: the mean of |features - targets|^2 over the assigned Gaussians.

    Args:
        features: (N, 32).
        targets: (N, 32).
        assigned: (N,) bool.

    Returns:
        The loss, a scalar, 0 where no Gaussian is assigned; differentiable in features.
    """
    squared = (features - targets).square().sum(1)
    return torch.where(assigned, squared, torch.zeros_like(squared)).sum() / assigned.sum().clamp(min=1)


@torch.no_grad()
def assign(
    cloud: GaussianCloud, regions: SceneRegions, cameras: Mapping[str, Camera], backend: str = "auto"
) -> Assignment:
    """Assign labels and features to all Gaussians from all images that have regions.

    Each image votes with the weights of `label_weights`. It adds its regions' embeddings to the features of those
    Gaussians to which `labels_in_view` gives a label. Then the votes are repeated ROUNDS times: the vote of a pixel
    goes to the Gaussians in it in proportion to their current probability of its label. This is expectation
    maximisation of the mixture that a pixel shows; without it transparent Gaussians at a border would get the label of
    their neighbours.

    Args:
        cloud: N Gaussians.
        regions: Regions of the images.
        cameras: Camera of each image, by the image's name.
        backend: What computes.

    Returns:
        Labels, features, agreement and gains; Gaussians that no image shows have no label.
    """
    device = cloud.means.device
    votes = torch.zeros(len(cloud), len(regions.labels) + 1, device=device)
    sums = torch.zeros(len(cloud), DIMENSIONS, device=device)
    for name, labels in regions.maps.items():
        present, weights, total = label_weights(cloud, cameras[name], labels, backend)
        votes[:, present] += weights.float()
        sums += _features(regions, name, _dominant_labels(present, weights, total))
    probabilities = torch.nn.functional.normalize(votes, p=1, dim=1)
    behind = regions.labels.index(OPEN_WATER) + 1 if OPEN_WATER in regions.labels else 0
    for _ in range(ROUNDS):
        repeated = torch.zeros_like(votes)
        for name, labels in regions.maps.items():
            _add_votes(repeated, probabilities, cloud, cameras[name], labels, behind, backend)
        probabilities = torch.nn.functional.normalize(repeated, p=1, dim=1)
    highest, best = probabilities.max(1)
    labelled = highest > 0
    own = votes.gather(1, best[:, None])[:, 0] / votes.sum(1).clamp(min=1e-12)
    features = torch.nn.functional.normalize(sums, dim=1)
    chosen = torch.where(labelled, best, 0)
    gains = label_gains(cloud, chosen, regions, cameras, behind, backend)
    return Assignment(features, chosen, torch.where(labelled, own, 0), gains)


@torch.no_grad()
def render_labels(
    cloud: GaussianCloud, labels: Tensor, count: int, camera: Camera, behind: int = 0, backend: str = "auto"
) -> np.ndarray:
    """Render the label that covers most of each pixel.

    Args:
        cloud: N Gaussians.
        labels: (N,) int64, 0 for none.
        count: Number of labels.
        camera: Camera to render.
        behind: Label of what no Gaussian covers, 0 for none.
        backend: What computes.

    Returns:
        Labels (H, W) uint16.
    """
    one_hot = torch.nn.functional.one_hot(labels, count + 1).to(cloud.means)
    viewmat, intrinsics = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
    best = cloud.means.new_full((camera.height, camera.width), -1.0)
    found = torch.zeros_like(best, dtype=torch.int64)
    for start in range(0, count + 1, LABELS_PER_PASS):
        some = one_hot[:, start : start + LABELS_PER_PASS].contiguous()
        rendered = rasterize(
            cloud.means, cloud.quats, cloud.scales, cloud.opacities, some, viewmat, intrinsics, camera.width,
            camera.height, cloud.means.new_zeros(some.shape[1]), backend,
        )  # fmt: skip
        coverage = rendered.channels.clone()
        if start <= behind < start + LABELS_PER_PASS:
            coverage[..., behind - start] += 1 - rendered.alpha
        largest, index = coverage.max(-1)
        found = torch.where(largest > best, index + start, found)
        best = torch.maximum(best, largest)
    return found.cpu().numpy().astype(np.uint16)


def _add_votes(
    votes: Tensor,
    probabilities: Tensor,
    cloud: GaussianCloud,
    camera: Camera,
    labels: np.ndarray,
    behind: int,
    backend: str,
) -> None:
    """Add to votes (N, L + 1) those of one image's labels (H, W), divided by the probabilities (N, L + 1).

    `behind` is the label of what no Gaussian covers, 0 for none.
    """
    camera = camera.resized(labels.shape[1])
    image_labels = torch.from_numpy(labels.astype(np.int64)).to(votes.device)
    present = torch.unique(image_labels[image_labels > 0])
    viewmat, intrinsics = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
    label_alpha = cloud.means.new_zeros(labels.shape)  # of each pixel's own label
    for some in present.split(LABELS_PER_PASS):
        rendered = rasterize(
            cloud.means, cloud.quats, cloud.scales, cloud.opacities,
            probabilities[:, some].to(cloud.means).contiguous(), viewmat, intrinsics, camera.width, camera.height,
            cloud.means.new_zeros(len(some)), backend,
        )  # fmt: skip
        label_alpha += (rendered.channels * (image_labels[..., None] == some)).sum(-1)
        if behind in some:
            label_alpha += torch.where(image_labels == behind, 1 - rendered.alpha, 0)
    for some in present.split(LABELS_PER_PASS):
        masks = (image_labels[..., None] == some) / label_alpha.clamp(min=MIN_LABEL_ALPHA)[..., None]
        votes[:, some] += contribution_sums(cloud, camera, masks, backend).float() * probabilities[:, some]


def _dominant_labels(present: Tensor, weights: Tensor, total: Tensor) -> Tensor:
    """Return the label (N,) of the largest weight, 0 where that is too small."""
    if not len(present):
        return torch.zeros_like(total, dtype=torch.int64)
    largest, best = weights.max(1)
    enough = (largest >= MIN_WEIGHT) & (largest >= MIN_FRACTION * total)
    return torch.where(enough, present[best], 0)


def _features(regions: SceneRegions, name: str, labels: Tensor) -> Tensor:
    """Return the embeddings (N, 32) float32 of an image's regions by labels (N,), 0 for label 0."""
    table = torch.zeros(len(regions.labels) + 1, DIMENSIONS)
    for label, feature in regions.features[name].items():
        table[label] = torch.from_numpy(feature)
    return table.to(labels.device)[labels]
