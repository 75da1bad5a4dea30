"""From labelled photographs to labelled Gaussians."""

import numpy as np
import pytest
import torch

from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.semantics import assign as assign_module
from swag_engine.semantics.assign import (
    assign,
    label_weights,
    labels_in_view,
    render_labels,
    semantic_loss,
    targets_in_view,
)
from swag_engine.semantics.label_gains import MAX_GAIN, label_coverage, label_gains, matching_gains
from swag_engine.semantics.regions import ImageRegions, SceneRegions, common_labels

SIZE = 40
BACKENDS = ["cpu", "torch"]


def cloud_of(means: list[tuple[float, float, float]], scale: float = 0.1, opacity: float = 0.9) -> GaussianCloud:
    """Balls that a camera at the origin, looking along z, sees."""
    n = len(means)
    return GaussianCloud(
        torch.tensor(means, dtype=torch.float32),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), float(np.log(scale))),
        torch.full((n,), float(np.log(opacity / (1 - opacity)))),
        torch.zeros(n, 1, 3),
        torch.zeros(n, 0, 3),
        torch.zeros(3),
    )


def camera_at(x: float, name: str = "a") -> Camera:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(name, SIZE, SIZE, 40.0, 40.0, SIZE / 2, SIZE / 2, pose)


def halves(left: int, right: int) -> np.ndarray:
    labels = np.full((SIZE, SIZE), left, np.uint16)
    labels[:, SIZE // 2 :] = right
    return labels


def scene(maps: dict[str, np.ndarray], names: tuple[str, ...] = ("one", "two")) -> SceneRegions:
    """Regions that are the labels of the maps; each has an embedding of its own in each photograph."""
    random = np.random.default_rng(0)
    found = {}
    for name, labels in maps.items():
        here = np.unique(labels[labels > 0])
        index = np.searchsorted(here, labels) + 1
        embeddings = np.eye(64)[here] + 0.02 * random.normal(size=(len(here), 64))
        titles = tuple(names[label - 1] for label in here)
        found[name] = ImageRegions(
            np.where(labels > 0, index, 0).astype(np.uint16), titles, embeddings.astype(np.float32)
        )
    return common_labels(found, names)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_hidden_gaussian_takes_no_label_from_what_hides_it(backend: str) -> None:
    # The third lies behind the first, as seen by the camera, and is seen by nobody.
    cloud = cloud_of([(-0.5, 0, 2), (0.5, 0, 2), (-1.0, 0, 4)], opacity=0.99)
    cloud.log_scales[0] = np.log(0.3)
    here, weights, total = label_weights(cloud, camera_at(0), halves(1, 2), backend)
    assert here.tolist() == [1, 2]
    assert torch.allclose(weights.sum(1), total, rtol=1e-4) and total[2] < 0.2 * total[1]
    assert labels_in_view(cloud, camera_at(0), halves(1, 2), backend).tolist() == [1, 2, 0]


@pytest.mark.parametrize("backend", BACKENDS)
def test_weights_are_the_pixels_of_the_picture(backend: str) -> None:
    """Summed over Gaussians, weights are the picture's alpha over each label."""
    random = np.random.default_rng(4)
    cloud = cloud_of([(*random.uniform(-0.8, 0.8, 2), random.uniform(2, 4)) for _ in range(60)], opacity=0.6)
    labels = random.integers(0, 40, (SIZE, SIZE)).astype(np.uint16)  # more than one pass takes
    here, weights, total = label_weights(cloud, camera_at(0), labels, backend)
    alpha = render(cloud, camera_at(0), backend=backend).alpha.detach().numpy()
    sums = [alpha[labels == label].sum() for label in here.tolist()]
    assert np.allclose(weights.sum(0).numpy(), sums, rtol=1e-3) and here.tolist() == list(range(1, 40))
    assert float(total.sum()) == pytest.approx(alpha.sum(), rel=1e-4)


def test_too_little_or_too_shared_is_no_label() -> None:
    cloud = cloud_of([(-0.5, 0, 2), (0, 0, 2), (0.5, 0, 2)])
    thirds = np.zeros((SIZE, SIZE), np.uint16)
    thirds[:, 19:20], thirds[:, 20:21] = 1, 2  # the middle ball is wider: neither has half of it
    assert labels_in_view(cloud, camera_at(0), thirds)[1] == 0
    faint = cloud_of([(-0.5, 0, 2)], scale=0.005, opacity=0.1)
    assert labels_in_view(faint, camera_at(0), halves(1, 1)).tolist() == [0]  # less than half a pixel
    assert labels_in_view(cloud, camera_at(0), halves(0, 0)).tolist() == [0, 0, 0]


def test_a_map_of_another_size_is_of_the_same_view() -> None:
    cloud = cloud_of([(-0.5, 0, 2), (0.5, 0, 2)])
    large = np.repeat(np.repeat(halves(1, 2), 3, 0), 3, 1)
    assert labels_in_view(cloud, camera_at(0), large).tolist() == [1, 2]


def test_most_votes_win_and_features_are_the_regions_mean() -> None:
    cloud = cloud_of([(-0.5, 0, 2), (0.5, 0, 2), (0, 0, -5)])
    maps = {"a": halves(1, 2), "b": halves(1, 2), "c": halves(2, 2)}  # c is wrong about the left one
    regions = scene(maps)
    cameras = {name: camera_at(0, name) for name in maps}
    made = assign(cloud, regions, cameras)
    assert made.labels.tolist() == [1, 2, 0]
    assert made.agreement[0] == pytest.approx(2 / 3, abs=1e-3) and made.agreement[1] == pytest.approx(1)
    assert made.agreement[2] == 0 and not made.features[2].any()
    mean = sum(regions.features[name][label] for name, label in (("a", 1), ("b", 1), ("c", 2)))
    assert np.allclose(made.features[0].numpy(), mean / np.linalg.norm(mean), atol=1e-5)
    cosines = made.features[:2].numpy() @ regions.prototypes.T
    assert cosines[0, 0] > cosines[0, 1] and cosines[1, 1] > 0.9


def test_the_loss_is_the_mean_over_assigned_gaussians() -> None:
    cloud = cloud_of([(-0.5, 0, 2), (0.5, 0, 2), (0, 0, -5)])
    regions = scene({"a": halves(1, 2)})
    targets, assigned = targets_in_view(cloud, camera_at(0), regions)
    assert assigned.tolist() == [True, True, False]
    assert np.allclose(targets[1].numpy(), regions.features["a"][2])
    features = torch.zeros(3, 32, requires_grad=True)
    loss = semantic_loss(features, targets, assigned)
    assert float(loss.detach()) == pytest.approx(1, abs=1e-5)  # targets have length 1
    loss.backward()
    assert torch.allclose(features.grad, torch.where(assigned[:, None], -targets, 0.0), atol=1e-6)
    assert semantic_loss(features, targets, torch.zeros(3, dtype=torch.bool)).item() == 0


def test_the_loss_pulls_features_to_their_targets_and_moves_nothing_else() -> None:
    cloud = cloud_of([(-0.5, 0, 2), (0.5, 0, 2)])
    for parameter in cloud.parameters().values():
        parameter.requires_grad_()
    regions = scene({"a": halves(1, 2)})
    features = torch.nn.Parameter(torch.randn(2, 32, generator=torch.Generator().manual_seed(0)))
    optimizer = torch.optim.Adam([features], 0.05)
    targets, assigned = targets_in_view(cloud, camera_at(0), regions)
    for _ in range(300):
        optimizer.zero_grad()
        semantic_loss(features, targets, assigned).backward()
        optimizer.step()
    assert float((features - targets).abs().max()) < 1e-3
    assert all(parameter.grad is None for parameter in cloud.parameters().values())


def test_labels_are_rendered_where_their_gaussians_are_seen() -> None:
    cloud = cloud_of([(-0.5, 0, 2), (0.5, 0, 2), (0.5, 0, 3)], scale=0.25, opacity=0.99)
    labels = torch.tensor([40, 7, 3])
    shown = render_labels(cloud, labels, 40, camera_at(0), behind=5)
    assert shown.dtype == np.uint16 and shown.shape == (SIZE, SIZE)
    assert shown[20, 10] == 40 and shown[20, 30] == 7 and shown[0, 0] == 5
    assert 3 not in shown[18:22, 28:32]
    assert render_labels(cloud, labels, 40, camera_at(0))[0, 0] == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_votes_cast_again_fit_the_photographs_better(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(3)
    cloud = cloud_of([(*random.uniform(-0.8, 0.8, 2), random.uniform(2, 3)) for _ in range(150)], 0.12, 0.5)
    truth = (
        1 + (2 * cloud.means[:, 0]).floor().add((2 * cloud.means[:, 1]).floor()).long() % 2
    )  # fields of a chessboard
    maps = {name: render_labels(cloud, truth, 2, camera_at(x), backend=backend)
            for name, x in (("a", -0.3), ("b", 0.0), ("c", 0.3))}  # fmt: skip
    cameras = {name: camera_at(x, name) for name, x in (("a", -0.3), ("b", 0.0), ("c", 0.3))}
    right = []
    for rounds in (0, assign_module.ROUNDS):
        monkeypatch.setattr(assign_module, "ROUNDS", rounds)
        labels = assign(cloud, scene(maps), cameras, backend).labels
        right.append(float((labels == truth).float().mean()))
    assert right[1] > right[0] + 0.03, right


@pytest.mark.parametrize("backend", BACKENDS)
def test_gains_move_a_border_that_transparent_gaussians_displace(backend: str) -> None:
    """Left of the plane x = 0 Gaussians are twice as opaque as right of it; two images see it at other places."""
    random = np.random.default_rng(0)
    places = [(x, y, 2.0) for x, y in random.uniform(-1.2, 1.2, (1500, 2))]
    cloud = cloud_of(places, 0.08, 0.15)
    transparent = cloud.means[:, 0] > 0
    cloud.opacity_logits[transparent] = -2.5
    maps = {"a": halves(1, 2), "b": np.roll(halves(1, 2), -4, axis=1)}
    maps["b"][:, -4:] = 2
    cameras = {"a": camera_at(0, "a"), "b": camera_at(0.2, "b")}
    labels = torch.where(transparent, 2, 1)
    found = label_gains(cloud, labels, scene(maps), cameras, backend=backend)
    every = np.arange(SIZE * SIZE)
    coverage = np.concatenate([label_coverage(cloud, labels, 2, cameras[a], every, 0, backend) for a in maps])
    wanted = sum(int((image == 1).sum()) for image in maps.values())
    counts = [int(((gains * coverage).argmax(1) == 1).sum()) for gains in (np.ones(3), found)]
    assert counts[0] > 1.04 * wanted and abs(counts[1] - wanted) <= 2, (counts, wanted)


def test_gains_match_the_areas_of_all_labels_and_have_bounds() -> None:
    """Coverages of four labels with errors of known factors; label 3 is nowhere, and too much is wanted of label 4."""
    random = np.random.default_rng(1)
    fair = random.dirichlet([3, 2, 1], 20_000).astype(np.float32)
    coverage = np.zeros((len(fair), 5), np.float32)
    coverage[:, [1, 2, 4]] = fair * [1, 0.5, 1.8]
    wanted = np.bincount(np.array([1, 2, 4])[fair.argmax(1)], minlength=5)
    gains = matching_gains(coverage, wanted)
    assert gains[[0, 1, 3]].tolist() == [1, 1, 1]
    np.testing.assert_allclose(gains[[2, 4]], [2, 1 / 1.8], rtol=0.02)
    np.testing.assert_allclose(np.bincount((gains * coverage).argmax(1), minlength=5), wanted, atol=3)
    assert matching_gains(coverage, np.array([0, 0, 0, 0, len(fair)]))[4] == MAX_GAIN
    assert matching_gains(coverage[:0], wanted).tolist() == [1] * 5
