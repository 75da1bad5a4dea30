"""From labelled photographs to labelled Gaussians, by what each Gaussian adds to each pixel."""

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
from .regions import SceneRegions
from .saliency import OPEN_WATER

MIN_WEIGHT, MIN_SHARE = 0.5, 0.5
"""Pixels, and share of all it adds to the picture, that a Gaussian needs in a region (docs/method.md section 5)."""
EVERY = 4
"""Features are learned in one iteration of so many: it costs as much as all else in an iteration."""
AT_ONCE = 16
"""Labels that one pass over a picture sums."""
ROUNDS = 3
"""In which votes are cast again; more change no label that counts (mIoU of the demo's validation views)."""
LEAST_SAID = 1e-4
"""Opacity with a pixel's label, below which the pixel says nothing."""


@dataclass(frozen=True, eq=False)
class Assignment:
    """features (N, 32): mean of the embeddings of the regions that the Gaussian lay in, of length 1, 0 where none;
    labels (N,) int64, 0 for none; agreement (N,): the share of all that it adds to labelled pixels which lies in its
    own label, 0 where none."""

    features: Tensor
    labels: Tensor
    agreement: Tensor


@torch.no_grad()
def label_weights(
    cloud: GaussianCloud, camera: Camera, labels: np.ndarray, backend: str = "auto"
) -> tuple[Tensor, Tensor, Tensor]:
    """What each Gaussian adds to the labels of one photograph, sum of T alpha over their pixels, occlusion counted.

    labels (H, W) integers, 0 for none, of the photograph that `camera` took; the camera is brought to their size.
    Returns the labels there, (R,) int64 and rising, the weights (N, R) in pixels, and each Gaussian's sum (N,) over the
    whole picture.
    """
    camera = camera.resized(labels.shape[1])
    here = np.unique(labels[labels > 0]).astype(np.int64)
    pictures = torch.from_numpy(np.stack([labels == label for label in here] + [np.ones_like(labels)], -1))
    weights = contribution_sums(cloud, camera, pictures.to(cloud.means), backend)
    return torch.from_numpy(here).to(weights.device), weights[:, :-1], weights[:, -1]


def labels_in_view(cloud: GaussianCloud, camera: Camera, labels: np.ndarray, backend: str = "auto") -> Tensor:
    """(N,) int64: the label that each Gaussian lies in as this camera sees it, 0 for none.

    That with the largest weight, if it has MIN_WEIGHT pixels and MIN_SHARE of all that the Gaussian adds.
    """
    return _surest(*label_weights(cloud, camera, labels, backend))


def targets_in_view(
    cloud: GaussianCloud, camera: Camera, regions: SceneRegions, backend: str = "auto", shown: np.ndarray | None = None
) -> tuple[Tensor, Tensor]:
    """What `semantic_loss` compares with in one view: targets (N, 32) float32 and assigned (N,) bool.

    shown: the photograph's labels at another size than the regions'.
    """
    labels = labels_in_view(cloud, camera, regions.maps[camera.name] if shown is None else shown, backend)
    return _features(regions, camera.name, labels), labels > 0


def semantic_loss(features: Tensor, targets: Tensor, assigned: Tensor) -> Tensor:
    """L_s of docs/method.md section 5: the mean over the assigned Gaussians of |features - targets|^2, 0 without any.

    features and targets (N, 32), assigned (N,) bool. Differentiable in features.
    """
    squared = (features - targets).square().sum(1)
    return torch.where(assigned, squared, torch.zeros_like(squared)).sum() / assigned.sum().clamp(min=1)


@torch.no_grad()
def assign(
    cloud: GaussianCloud, regions: SceneRegions, cameras: Mapping[str, Camera], backend: str = "auto"
) -> Assignment:
    """Labels and features of all Gaussians from all photographs that have regions.

    cameras: by the photograph's name. A photograph votes with the weights of `label_weights` for its labels, and takes
    part in the features of those Gaussians that `labels_in_view` gives a label. Then votes are cast again: a pixel's
    goes to the Gaussians in it as far as they have its label, so that what is faint at a border does not take the
    label of what it borders on. That is expectation maximisation of the mixture that a pixel shows. What no photograph
    says anything of stays without a label.
    """
    device = cloud.means.device
    votes = torch.zeros(len(cloud), len(regions.labels) + 1, device=device)
    sums = torch.zeros(len(cloud), DIMENSIONS, device=device)
    for name, labels in regions.maps.items():
        here, weights, total = label_weights(cloud, cameras[name], labels, backend)
        votes[:, here] += weights.float()
        sums += _features(regions, name, _surest(here, weights, total))
    shares = torch.nn.functional.normalize(votes, p=1, dim=1)
    behind = regions.labels.index(OPEN_WATER) + 1 if OPEN_WATER in regions.labels else 0
    for _ in range(ROUNDS):
        again = torch.zeros_like(votes)
        for name, labels in regions.maps.items():
            _vote_again(again, shares, cloud, cameras[name], labels, behind, backend)
        shares = torch.nn.functional.normalize(again, p=1, dim=1)
    most, best = shares.max(1)
    labelled = most > 0
    own = votes.gather(1, best[:, None])[:, 0] / votes.sum(1).clamp(min=1e-12)
    features = torch.nn.functional.normalize(sums, dim=1)
    return Assignment(features, torch.where(labelled, best, 0), torch.where(labelled, own, 0))


@torch.no_grad()
def rendered_labels(
    cloud: GaussianCloud, labels: Tensor, count: int, camera: Camera, behind: int = 0, backend: str = "auto"
) -> np.ndarray:
    """(H, W) uint16: the label, of `count`, that most of each pixel shows; `behind` is what no Gaussian covers."""
    shares = torch.nn.functional.one_hot(labels, count + 1).to(cloud.means)
    viewmat, intrinsics = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
    best = cloud.means.new_full((camera.height, camera.width), -1.0)
    found = torch.zeros_like(best, dtype=torch.int64)
    for start in range(0, count + 1, AT_ONCE):
        some = shares[:, start : start + AT_ONCE].contiguous()
        drawn = rasterize(
            cloud.means, cloud.quats, cloud.scales, cloud.opacities, some, viewmat, intrinsics, camera.width,
            camera.height, cloud.means.new_zeros(some.shape[1]), backend,
        )  # fmt: skip
        shown = drawn.channels.clone()
        if start <= behind < start + AT_ONCE:
            shown[..., behind - start] += 1 - drawn.alpha
        most, place = shown.max(-1)
        found = torch.where(most > best, place + start, found)
        best = torch.maximum(best, most)
    return found.cpu().numpy().astype(np.uint16)


def _vote_again(
    votes: Tensor, shares: Tensor, cloud: GaussianCloud, camera: Camera, labels: np.ndarray, behind: int, backend: str
) -> None:
    """Add to votes (N, L + 1) what each Gaussian gets of one photograph's labels (H, W) by its shares (N, L + 1).

    behind: the label of what no Gaussian covers, 0 for none.
    """
    camera = camera.resized(labels.shape[1])
    drawn_labels = torch.from_numpy(labels.astype(np.int64)).to(votes.device)
    here = torch.unique(drawn_labels[drawn_labels > 0])
    viewmat, intrinsics = (torch.from_numpy(array).to(cloud.means) for array in (camera.world_to_camera, camera.K))
    said = cloud.means.new_zeros(labels.shape)
    for some in here.split(AT_ONCE):
        drawn = rasterize(
            cloud.means, cloud.quats, cloud.scales, cloud.opacities, shares[:, some].to(cloud.means).contiguous(),
            viewmat, intrinsics, camera.width, camera.height, cloud.means.new_zeros(len(some)), backend,
        )  # fmt: skip
        said += (drawn.channels * (drawn_labels[..., None] == some)).sum(-1)
        if behind in some:
            said += torch.where(drawn_labels == behind, 1 - drawn.alpha, 0)
    for some in here.split(AT_ONCE):
        pictures = (drawn_labels[..., None] == some) / said.clamp(min=LEAST_SAID)[..., None]
        votes[:, some] += contribution_sums(cloud, camera, pictures, backend).float() * shares[:, some]


def _surest(here: Tensor, weights: Tensor, total: Tensor) -> Tensor:
    if not len(here):
        return torch.zeros_like(total, dtype=torch.int64)
    most, best = weights.max(1)
    sure = (most >= MIN_WEIGHT) & (most >= MIN_SHARE * total)
    return torch.where(sure, here[best], 0)


def _features(regions: SceneRegions, name: str, labels: Tensor) -> Tensor:
    """(N, 32) float32: the embeddings of the photograph's regions of these labels (N,), 0 for label 0."""
    table = torch.zeros(len(regions.labels) + 1, DIMENSIONS)
    for label, feature in regions.features[name].items():
        table[label] = torch.from_numpy(feature)
    return table.to(labels.device)[labels]
