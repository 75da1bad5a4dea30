import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import pytest
import torch
from scipy.ndimage import gaussian_filter

from swag_engine.base.errors import InputError
from swag_engine.effects.depth_prior import depth_loss
from swag_engine.priors.depth import (
    Alignment,
    InverseDepth,
    align,
    aligned_inverse_range,
    depth_priors,
    reject_outlying_slopes,
    sparse_points,
)
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import TrainingImage

flsea = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "flsea_rgbd" / "depth"
needs_data = pytest.mark.skipif(not flsea.is_dir(), reason="the shared example scenes are not here")

# Inverse depth is the red channel, as the network gets it.
RED = "(float[1,3,{0}] image) => (float[1,1,{0}] depth) <int64[1] red = {{0}}> {{ depth = Gather<axis=1>(image, red) }}"


def write_network(path: Path, graph: str) -> Path:
    onnx.save(onnx.parser.parse_model(f'<ir_version: 8, opset_import: ["": 17]> net {graph}'), path)
    return path


# The network ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", ["H,W", "28,42"])
def test_a_network_gets_normalised_rgb_and_its_answer_comes_back_at_the_size_of_the_image(
    tmp_path: Path, size: str
) -> None:
    network = InverseDepth(write_network(tmp_path / "red.onnx", RED.format(size)))
    rows, columns = np.mgrid[:90, :130]
    image = np.stack([rows + columns, 0 * rows, 255 + 0 * rows], axis=-1).astype(np.uint8)
    made = network(image)
    assert made.shape == (90, 130) and made.dtype == np.float32
    assert np.abs(made - ((rows + columns) / 255 - 0.485) / 0.229)[5:-5, 5:-5].max() < 0.01


@pytest.mark.parametrize("shape", [(48, 64), (1, 1), (700, 300), (607, 968)])
def test_a_network_of_open_size_gets_multiples_of_14(tmp_path: Path, shape: tuple[int, int]) -> None:
    patches = "(float[1,3,H,W] image) => (float[1,h,w] depth) " + (
        "<int64[1] red = {0}, int64[1] axis = {1}> { blocks = SpaceToDepth<blocksize=14>(image) "
        "patches = Gather<axis=1>(blocks, red) depth = Squeeze(patches, axis) }"
    )
    made = InverseDepth(write_network(tmp_path / "patches.onnx", patches))(np.full((*shape, 3), 255, np.uint8))
    assert made.shape == shape and np.allclose(made, (1 - 0.485) / 0.229)


@pytest.mark.parametrize(
    "graph",
    [
        "(float[1,3,H,W] image) => (float[1,3,H,W] out) { out = Identity(image) }",
        "(float[1,3,H,W] image) => (float[1,K] out) { out = Flatten(image) }",
        "(float[1,3,H,W] a, float[1,3,H,W] b) => (float[1,3,H,W] out) { out = Add(a, b) }",
    ],
)
def test_a_network_that_makes_no_depth_is_refused(tmp_path: Path, graph: str) -> None:
    with pytest.raises(InputError, match="other.onnx is not an inverse depth network"):
        InverseDepth(write_network(tmp_path / "other.onnx", graph))


# Alignment ------------------------------------------------------------------------------------------------------------


def wavy_range(random: np.random.Generator) -> np.ndarray:
    """Ranges (120, 160) of a made-up sea floor, 2 to 8 units away."""
    waves = gaussian_filter(random.normal(size=(120, 160)), 6)
    return 5 - np.mgrid[:120, :160][0] / 40 + waves / np.abs(waves).max()


def sample(depth: np.ndarray, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Pixel centres and 1 / depth at `count` pixels that have a depth."""
    rows, columns = np.nonzero(depth > 0)
    picked = random.choice(len(rows), count, replace=False)
    return np.column_stack([columns, rows])[picked] + 0.5, 1 / depth[rows, columns][picked]


def distorted(depth: np.ndarray, a: float, b: float, noise: float, random: np.random.Generator) -> np.ndarray:
    """What a network might say: scaled, shifted, and wrong by smooth noise of `noise` standard deviations."""
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-3), 0)
    blotches = gaussian_filter(random.normal(size=depth.shape), 8)
    return ((inverse - b + noise * inverse[depth > 0].std() * blotches / blotches.std()) / a).astype(np.float32)


def with_outliers(inverse_range: np.ndarray, share: float, random: np.random.Generator) -> np.ndarray:
    wrong = random.random(len(inverse_range)) < share
    low, high = inverse_range.min(), inverse_range.max()
    return np.where(wrong, random.uniform(low, 2 * high, len(inverse_range)), inverse_range)


@needs_data
@pytest.mark.parametrize("outliers", [0.0, 0.2])
@pytest.mark.parametrize("frame", ["0000", "0002", "0004", "0005", "0007", "0010"])
def test_distorted_depth_of_real_scenes_is_brought_back(frame: str, outliers: float) -> None:
    random = np.random.default_rng(int(frame))
    with np.load(flsea / f"{frame}_depth.npz") as arrays:
        depth = arrays[arrays.files[0]].astype(np.float64)
    points_uv, inverse_range = sample(depth, 600, random)
    prediction = distorted(depth, 0.14, -0.2, 0.1, random)
    found = align(prediction, points_uv, with_outliers(inverse_range, outliers, random))
    assert found.accepted and found.reason == "" and found.count == 600
    assert found.a == pytest.approx(0.14, rel=0.05) and found.spearman > 0.9
    q, seen = aligned_inverse_range(prediction, found), depth > 0
    assert q.dtype == np.float32 and q.min() >= 0
    spread = inverse_range.std()
    assert np.median(np.abs(q - 1 / np.maximum(depth, 1e-3))[seen]) < 0.1 * spread
    # A plain line through the same points is pulled away by the outliers.
    if outliers:
        wrong = with_outliers(inverse_range, outliers, np.random.default_rng(int(frame)))
        columns, rows = (points_uv - 0.5).astype(int).T
        plain = np.polyfit(prediction[rows, columns], wrong, 1)
        assert abs(plain[0] / 0.14 - 1) > 0.05


def test_a_line_is_found_among_outliers_and_without_any_noise() -> None:
    random = np.random.default_rng(1)
    depth = wavy_range(random)
    points_uv, inverse_range = sample(depth, 100, random)
    exact = align(distorted(depth, 2.0, 0.1, 0.0, random), points_uv, inverse_range)
    assert exact.accepted and (exact.a, exact.b) == pytest.approx((2.0, 0.1), abs=1e-5)
    found = align(distorted(depth, 2.0, 0.1, 0.05, random), points_uv, with_outliers(inverse_range, 0.2, random))
    assert found.accepted and (found.a, found.b) == pytest.approx((2.0, 0.1), rel=0.05, abs=0.01)


def test_a_prediction_that_does_not_fit_is_refused_with_the_reason() -> None:
    random = np.random.default_rng(2)
    depth = wavy_range(random)
    inverse = (1 / depth).astype(np.float32)
    points_uv, inverse_range = sample(depth, 200, random)
    half = np.where(np.arange(160) < 88, inverse, 1 / wavy_range(random)[::-1])
    for prediction, reason in (
        (gaussian_filter(random.normal(size=depth.shape), 5), "does not follow the sparse points: rank correlation"),
        (depth, "near and far are exchanged"),
        (half, r"agrees with only \d\d% of the sparse points"),
        (np.ones_like(inverse), "all the same"),
        (np.full_like(inverse, np.nan), "Only 0 sparse points"),
    ):
        refused = align(prediction.astype(np.float32), points_uv, inverse_range)
        assert not refused.accepted and re.search(reason, refused.reason), refused
    assert "Only 29 sparse points" in align(inverse, points_uv[:29], inverse_range[:29]).reason
    assert align(inverse, points_uv[:30], inverse_range[:30]).accepted
    beside = np.concatenate([points_uv[:29], [[-3, 5], [165, 5], [5, -2], [5, 130]]])
    assert align(inverse, beside, inverse_range[:33]).count == 29


def test_an_image_whose_scale_is_unlike_the_others_is_refused() -> None:
    def alignment(a: float, accepted: bool = True) -> Alignment:
        return Alignment(a, 0.0, 100, 0.9, accepted, "" if accepted else "Only 3 points.")

    found = {"a": alignment(1.0), "b": alignment(1.2), "c": alignment(0.19), "d": alignment(0.9), "e": alignment(6.0)}
    found |= {f"refused {i}": alignment(100.0, accepted=False) for i in range(9)}  # these do not shift the median
    gated = reject_outlying_slopes(found)
    assert [name for name in gated if gated[name].accepted] == ["a", "b", "d"]
    assert "0.19 times the median" in gated["c"].reason and "6 times the median" in gated["e"].reason
    assert all(gated[name] == found[name] for name in found if name not in "ce")
    assert reject_outlying_slopes({}) == {}


def test_ranges_are_euclidean_and_points_behind_the_camera_do_not_count() -> None:
    camera = Camera("view", 100, 100, 50.0, 50.0, 50.0, 50.0, np.eye(4))
    points_uv, inverse_range = sparse_points(camera, np.array([[2.0, 0, 2], [0, 0, 4], [1, 1, -3]]))
    assert points_uv.tolist() == [[100, 50], [50, 50]]
    assert inverse_range == pytest.approx([1 / 8**0.5, 0.25])


def test_a_scene_gets_priors_for_the_images_that_the_network_understands(tiny_scene: Path, tmp_path: Path) -> None:
    scene = load_scene(tiny_scene)
    flat = scene.points.positions * (1, 1, 0)  # a wall at z = 0, so that every pixel's range is known
    scene = replace(scene, points=replace(scene.points, positions=flat))
    # The tiny scene's model has no tracks: every image sees every point.
    views = [replace(view, point_indices=np.arange(len(flat))) for view in scene.views]
    scene = replace(scene, views=tuple(views))
    images, truth = [], {}
    for view in views:
        camera = view.camera
        rows, columns = np.indices((camera.height, camera.width)) + 0.5
        rays = np.linalg.inv(camera.K) @ np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)])
        world = camera.world_to_camera[:3, :3].T @ rays
        distance = (-camera.centre[2] / world[2]) * np.linalg.norm(rays, axis=0)
        inverse = truth[camera.name] = (1 / distance).reshape(rows.shape)
        red = np.round(255 * (inverse - 0.1) / 0.2).astype(np.uint8)
        pixels = np.stack([red, 0 * red, 0 * red], axis=-1)
        assert inverse.min() > 0.1 and inverse.max() < 0.3
        images.append(TrainingImage(camera, pixels, rows > 10))
    images[3].pixels[:] = 255 - images[3].pixels
    images[5].pixels[:] //= 7
    network = InverseDepth(write_network(tmp_path / "red.onnx", RED.format("H,W")))
    priors, alignments = depth_priors(lambda image: network(image.pixels), images, scene)
    accepted = [image for i, image in enumerate(images) if i not in (3, 5)]
    assert set(priors) == {image.camera.name for image in accepted} and len(alignments) == len(images)
    assert "exchanged" in alignments[images[3].camera.name].reason
    assert "times the median" in alignments[images[5].camera.name].reason
    for image in accepted:
        q = priors[image.camera.name]
        assert q.dtype == np.float32 and np.array_equal(np.isfinite(q), image.valid)
        assert np.abs(q / truth[image.camera.name] - 1)[image.valid].max() < 0.02


# The loss -------------------------------------------------------------------------------------------------------------


def test_the_loss_is_the_mean_difference_of_inverse_ranges_where_the_picture_is_opaque() -> None:
    ranges = torch.tensor([[2.0, 4.0, 5.0, 5.0, 0.0]])
    alpha = torch.tensor([[1.0, 0.6, 0.4, 1.0, 0.0]])
    q = torch.tensor([[0.25, 0.5, 9.0, torch.nan, 1.0]])
    assert depth_loss(ranges, alpha, q, 3.0) == pytest.approx(3 * (0.25 + 0.25) / 2)
    assert depth_loss(ranges, 0 * alpha, q, 3.0) == 0


@pytest.mark.parametrize("pearson", [False, True])
@pytest.mark.parametrize("opaque", [0, 1, 40])
def test_gradients_are_finite_where_nothing_was_rendered(pearson: bool, opaque: int) -> None:
    torch.manual_seed(0)
    alpha = torch.zeros(8, 10)
    alpha.flatten()[:opaque] = 0.9
    weighted = (alpha * torch.rand(8, 10)).requires_grad_()
    seen = weighted / torch.where(alpha > 0, alpha, 1)  # as the renderer normalises
    q = torch.rand(8, 10)
    loss = depth_loss(seen, alpha, q, 2.0, pearson)
    loss.backward()
    assert loss.isfinite() and weighted.grad is not None and weighted.grad.isfinite().all()
    assert not weighted.grad.flatten()[opaque:].any()
    if opaque == 0:
        assert loss == 0
    if opaque == 40:
        assert weighted.grad.flatten()[:opaque].all()


@pytest.mark.parametrize("pearson", [False, True])
def test_gradients_are_those_of_finite_differences(pearson: bool) -> None:
    torch.manual_seed(1)
    ranges = (1 + torch.rand(5, 6, dtype=torch.float64)).requires_grad_()
    alpha, q = torch.rand(5, 6, dtype=torch.float64), torch.rand(5, 6, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda d: depth_loss(d, alpha, q, 1.3, pearson), ranges)


def test_the_correlation_does_not_see_scale_and_shift_and_survives_flat_pictures() -> None:
    torch.manual_seed(2)
    ranges, alpha = 2 + torch.rand(20, 30), torch.ones(20, 30)
    assert depth_loss(ranges, alpha, 7 / ranges - 3, 2.5, pearson=True) == pytest.approx(0, abs=1e-3)
    assert depth_loss(ranges, alpha, 3 - 7 / ranges, 2.5, pearson=True) == pytest.approx(2, abs=1e-3)
    for flat in (torch.full((20, 30), 3.0, requires_grad=True), ranges.clone().requires_grad_()):
        q = 1 / ranges if flat.detach().std() == 0 else torch.ones(20, 30)
        loss = depth_loss(flat, alpha, q, 2.5, pearson=True)
        loss.backward()
        assert loss.item() == pytest.approx(1, abs=1e-3)
        assert flat.grad is not None and flat.grad.abs().max() < 100
