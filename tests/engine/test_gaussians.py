"""Initial Gaussians, their moments through densification, and the range at which they are rendered."""

import numpy as np
import pytest
import torch

from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.gaussians.init import gaussians_from_points
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import Points
from swag_engine.training.optimizer import Optimizer
from tests.engine.water_scenes import make_water
from tests.scenes.clouds import make_cloud


def points_at(positions, colors=None):
    n = len(positions)
    colors = np.full((n, 3), 128, np.uint8) if colors is None else colors
    return Points(np.asarray(positions, float), colors, np.zeros(n, np.float32), np.full(n, 3, np.int32))


def test_initial_width_is_the_distance_of_the_neighbours():
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 3)
    cloud = gaussians_from_points(points_at(grid), 1000, 3, 0, np.array([0.1, 0.2, 0.3]))
    torch.testing.assert_close(cloud.scales, torch.ones(125, 3))
    torch.testing.assert_close(cloud.background.sigmoid(), torch.tensor([0.1, 0.2, 0.3]))
    assert cloud.shN.shape == (125, 15, 3)


def test_initial_colors_are_those_of_the_points():
    colors = np.array([[0, 128, 255], [10, 20, 30]], np.uint8)
    cloud = gaussians_from_points(points_at([[0, 0, 1], [1, 0, 1]], colors), 10, 0, 0, np.full(3, 0.5))
    seen = cloud.colors(torch.zeros(3), 0) * 255
    torch.testing.assert_close(seen, torch.tensor(colors).float(), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    "positions",
    [[[0, 0, 1]], [[0, 0, 1], [0, 0, 1]], [[0, 0, 1]] * 50, [[0, 0, 1], [1, 0, 1], [np.nan, 0, 0], [1e9, 0, 1]]],
    ids=["one point", "two equal points", "many equal points", "not a number, and far away"],
)
def test_degenerate_points_give_finite_gaussians(positions):
    cloud = gaussians_from_points(points_at(positions), 1000, 1, 0, np.zeros(3))
    assert len(cloud) == np.isfinite(positions).all(axis=1).sum()
    for name, tensor in cloud.parameters().items():
        assert torch.isfinite(tensor).all(), name


def test_the_largest_number_holds_at_the_start_and_the_subset_is_seeded():
    points = points_at(np.random.default_rng(0).normal(size=(500, 3)))
    first, again = (gaussians_from_points(points, 100, 0, 3, np.zeros(3)) for _ in range(2))
    assert len(first) == 100 and torch.equal(first.means, again.means)


def test_moments_follow_their_gaussians_and_are_zero_for_new_ones():
    optimizer = Optimizer(make_cloud(6, dtype=torch.float32), SceneEffects())
    optimizer.cloud.means.sum().backward()
    optimizer.step({"means": 1e-3})
    moments = optimizer.state_tensors()["adam.means.exp_avg"]
    moments += torch.arange(6)[:, None]  # different for each
    source = torch.tensor([4, 0, -1])
    optimizer.replace(make_cloud(3, dtype=torch.float32), source)
    after = optimizer.state_tensors()["adam.means.exp_avg"]
    torch.testing.assert_close(after, torch.stack([moments[4], moments[0], torch.zeros(3)]))


def test_range_is_euclidean_and_normalised_by_alpha():
    """45 degrees off the axis the range is 41 % more than the depth; transparency does not change it."""
    cloud = make_cloud(2)
    cloud.means[:] = torch.tensor([[3.0, 0.0, 3.0], [0.0, 0.0, 3.0]])
    cloud.log_scales[:] = -2.5
    cloud.opacity_logits[:] = 0.0
    camera = Camera("a", 64, 16, 24.0, 24.0, 32.0, 8.0, np.eye(4))
    picture = render(cloud, camera, with_range=True)
    assert picture.alpha[8, 56] < 0.6
    torch.testing.assert_close(picture.range[8, 56], torch.tensor(18.0).sqrt().double())
    torch.testing.assert_close(picture.range[8, 32], torch.tensor(3.0).double())
    assert picture.range[0, 0] == 0 and picture.alpha[0, 0] == 0


def test_range_has_finite_gradients_where_there_is_no_gaussian():
    cloud = make_cloud(3)
    cloud.means.requires_grad_()
    camera = Camera("a", 32, 16, 24.0, 24.0, 16.0, 8.0, np.eye(4))
    render(cloud, camera, with_range=True).range.sum().backward()
    assert torch.isfinite(cloud.means.grad).all() and cloud.means.grad.abs().sum() > 0


def test_orthographic_rays_are_parallel():
    """Two equal Gaussians side by side, one deeper, have one color and one size, and their range is the depth."""
    cloud = make_cloud(2)
    cloud.means[:] = torch.tensor([[-1.0, 0.0, 3.0], [1.0, 0.0, 5.0]])
    for tensor in (cloud.quats, cloud.log_scales, cloud.opacity_logits, cloud.sh0, cloud.shN):
        tensor[1] = tensor[0]
    cloud.log_scales[:] = -2.0
    camera = Camera("a", 64, 16, 20.0, 20.0, 32.0, 8.0, np.eye(4), "orthographic")
    picture = render(cloud, camera, with_range=True)
    assert picture.alpha[8, 12] > 0.1
    torch.testing.assert_close(picture.color[:, 4:20], picture.color[:, 44:60])
    torch.testing.assert_close(picture.range[8, [12, 52]], torch.tensor([3.0, 5.0]).double())


def test_orthographic_views_through_water_count_range_from_the_plane_of_the_camera():
    cloud = make_cloud(2)
    cloud.means[:] = torch.tensor([[0.0, 0.0, 3.0], [6.0, 0.0, 3.0]])
    for tensor in (cloud.quats, cloud.log_scales, cloud.opacity_logits, cloud.sh0, cloud.shN):
        tensor[1] = tensor[0]
    medium = make_water()[2]
    camera = Camera("a", 200, 40, 20.0, 20.0, 40.0, 20.0, np.eye(4), "orthographic")
    color = render(cloud, camera, medium=medium).color
    torch.testing.assert_close(color[:, 20:60], color[:, 140:180], atol=1e-5, rtol=0)
    behind = color[0, 0]
    torch.testing.assert_close(color[0], behind.expand_as(color[0]), atol=1e-4, rtol=0)  # water of one direction
