"""The widening of Gaussians in renders that sample them more finely than the training images did."""

from functools import partial

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.kernels.reference.projection import project
from swag_engine.rendering.render import render
from swag_engine.rendering.trained_detail import MOST_SAMPLES, TrainedDetail, render_as_trained
from swag_engine.scene.cameras import Camera

NEAREST, FARTHEST = 2.0, 5.0


def front(depth, width=80, kind="perspective", x=0.0):
    """A camera on the axis of the Gaussian at the origin, `depth` before it; its focal length is its width."""
    pose = np.eye(4)
    pose[:3, 3] = x, 0, depth
    return Camera("a", width, width, float(width), float(width), width / 2, width / 2, pose, kind)


def two():
    """A small Gaussian at the origin, and one behind all cameras, float64."""
    means = torch.tensor([[0.0, 0, 0], [0, 0, -100]], dtype=torch.float64)
    sizes = torch.tensor([[0.01, 0.02, 0.005], [0.01, 0.01, 0.01]], dtype=torch.float64)
    shapes = {"opacity_logits": (2,), "sh0": (2, 1, 3), "shN": (2, 15, 3), "background": (3,)}
    zeros = {name: torch.zeros(shape, dtype=torch.float64) for name, shape in shapes.items()}
    return GaussianCloud(means, torch.tensor([[1.0, 0, 0, 0]] * 2).double(), sizes.log(), **zeros)


@pytest.fixture
def detail():
    return TrainedDetail.of_training(two().means, [front(NEAREST), front(3.0), front(FARTHEST)])


def spread(cloud, camera):
    """Covariance (2, 2) of the first Gaussian in an image, pixels squared."""
    view, K = torch.from_numpy(camera.world_to_camera), torch.from_numpy(camera.K)
    opacities, channels = cloud.opacities, torch.zeros(2, 3).double()
    found = project(
        cloud.means, cloud.quats, cloud.scales, opacities, channels, view, K, camera.width, camera.height, camera.kind
    )
    a, b, c = found.conics[0].tolist()
    return torch.linalg.inv(torch.tensor([[a, b], [b, c]], dtype=torch.float64))


@pytest.mark.parametrize("depth", [NEAREST, 3.7, FARTHEST])
def test_an_image_of_greater_width_shows_what_a_training_image_of_that_distance_does(detail, depth):
    small, wide = front(depth), front(depth, 80 * 5)
    assert_close(spread(detail.widened(two(), wide), wide), 25 * spread(two(), small), rtol=1e-9, atol=0)
    assert (spread(two(), wide) < 0.9 * 25 * spread(two(), small)).diagonal().all(), "without it, thinner"


def test_nearer_views_show_what_the_nearest_training_image_does(detail):
    near = front(NEAREST / 4)
    assert_close(spread(detail.widened(two(), near), near), 16 * spread(two(), front(NEAREST)), rtol=1e-9, atol=0)


def test_farther_views_keep_the_detail_of_the_farthest_training_image(detail):
    far = front(2 * FARTHEST, 80 * 5)
    # Five times as wide and twice as far: 2.5 times the size that the farthest training image shows.
    expected = 2.5**2 * spread(two(), front(FARTHEST))
    assert_close(spread(detail.widened(two(), far), far), expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("camera", [front(NEAREST), front(4.0), front(9.0), front(3.0, 60), front(30.0, 200)])
def test_nothing_changes_where_the_image_is_no_finer_than_the_training_images(detail, camera):
    assert_close(detail.widened(two(), camera).scales, two().scales, rtol=1e-12, atol=0)


def test_a_gaussian_that_no_training_image_sees_stays_as_it_is(detail):
    assert detail.finest[1] == detail.coarsest[1] == 0
    assert_close(detail.widened(two(), front(1.0, 800)).scales[1], two().scales[1], rtol=1e-12, atol=0)


def test_an_orthographic_image_shows_the_finest_detail(detail):
    fine = front(NEAREST, 400, "orthographic")  # 400 pixels per unit; the finest training image has 40
    expected = 100 * spread(two(), front(NEAREST))
    assert_close(spread(detail.widened(two(), fine), fine), expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize(
    ("camera", "samples"),
    [
        (front(3.0), 1),
        (front(3.0, 71), 1),
        (front(3.0, 60), 2),
        (front(3.0, 40), 2),
        (front(3.0, 8), MOST_SAMPLES),
        (front(2 * FARTHEST), 2),
        (front(3 * FARTHEST, 240), 1),
        (front(3.0, 40, x=5.0), 1),  # shows no Gaussian
    ],
)
def test_an_image_that_samples_gaussians_more_coarsely_gets_more_pixels(detail, camera, samples):
    assert detail.samples(two().means, camera) == samples


def test_the_largest_images_get_fewer_pixels_than_they_would(detail, monkeypatch):
    monkeypatch.setattr("swag_engine.rendering.trained_detail.MOST_PIXELS", 20 * 20 * 4)
    assert detail.samples(two().means, front(3.0, 20)) == 2
    assert detail.samples(two().means, front(3.0, 41)) == 1


def test_a_smaller_image_is_the_mean_of_the_pixels_that_a_training_image_has(detail):
    small = render_as_trained(two(), front(3.0, 20), detail, with_range=True)
    large = render(two(), front(3.0, 80), with_range=True)
    pooled = partial(torch.nn.functional.avg_pool2d, kernel_size=4)
    assert_close(small.color, pooled(large.color.permute(2, 0, 1)).permute(1, 2, 0), rtol=1e-9, atol=1e-12)
    assert_close(small.alpha, pooled(large.alpha[None])[0], rtol=1e-9, atol=1e-12)
    assert_close(small.range * small.alpha, pooled((large.range * large.alpha)[None])[0], rtol=1e-9, atol=1e-12)
    assert small.alpha.max() > 0.01
