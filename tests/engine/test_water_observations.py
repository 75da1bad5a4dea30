"""The linear light of sparse points in images."""

import numpy as np
import pytest

from swag_engine.base.transfer import linear_of_bytes
from swag_engine.evidence.observations import FAR_WINDOW, observe
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import Points
from swag_engine.scene.images import TrainingImage

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0


def make_image(name, depth, seed):
    """Noise, seen by a camera that looks along z from `depth` before the plane of the points."""
    pixels = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    pose = np.eye(4)
    pose[2, 3] = depth
    camera = Camera(name, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)
    return TrainingImage(camera, pixels, np.ones((HEIGHT, WIDTH), bool))


def covered(low, high, size):
    """Fraction of each of `size` pixels between low and high."""
    edges = np.arange(size)
    return (np.minimum(edges + 1, high) - np.maximum(edges, low)).clip(0)


@pytest.fixture
def seen():
    places = np.array([[0.013, -0.04, 0], [0.21, 0.17, 0], [-0.55, 0.3, 0]])
    points = Points(places, np.zeros((3, 3), np.uint8), np.full(3, 2), np.zeros(3))
    return [make_image("far.png", 6.0, 0), make_image("near.png", 2.0, 1)], points


def test_all_views_average_the_same_part_of_the_world_to_a_fraction_of_a_pixel(seen):
    images, points = seen
    observations = observe(images, [np.arange(3)] * 2, points)
    assert len(observations) == 6
    for number, image in enumerate(images):
        light = linear_of_bytes()[image.pixels].astype(np.float64)
        for k in range(3):
            place = points.positions[k] + image.camera.world_to_camera[:3, 3]
            x, y = FOCAL * place[:2] / place[2] + (WIDTH / 2, HEIGHT / 2)
            other = points.positions[k] + images[0].camera.world_to_camera[:3, 3]
            half = FAR_WINDOW * np.linalg.norm(other) / np.linalg.norm(place)
            weights = np.outer(covered(y - half, y + half, HEIGHT), covered(x - half, x + half, WIDTH))
            expected = (weights[..., None] * light).sum((0, 1)) / (2 * half) ** 2
            got = observations.light[(observations.image == number) & (observations.track == k)]
            np.testing.assert_allclose(got, expected[None], rtol=1e-5)


def test_patches_that_an_image_does_not_show_whole_are_left_out(seen):
    images, points = seen
    images[1].valid[HEIGHT // 2 - 2, WIDTH // 2] = False  # within the near patch of the first point
    points.positions[2, 0] = -1.05  # half beyond the near image
    observations = observe(images, [np.arange(3)] * 2, points)
    assert set(observations.track) == {1}
