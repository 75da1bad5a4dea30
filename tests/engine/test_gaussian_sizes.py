"""Least size of Gaussians, by what the training images sample, and largest, by the distance from cameras."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from swag_engine.gaussians import sizes
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.gaussians.sizes import (
    CAMERAS_AT_ONCE,
    COVERING,
    LARGEST,
    LARGEST_HIDDEN,
    enforce_sizes,
    nearest_offsets,
    sampling,
    size_limits,
)
from swag_engine.rasterize.api import rasterize
from swag_engine.rendering.importance import visibility
from swag_engine.scene.cameras import Camera
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.splats import LEAST_VARIANCE
from tests.scenes.runs import train_with

FOCAL = 64.0
"""Focal length of the cameras, pixels, and width of their images."""


def enforce_in_air(cloud, cameras):
    """Enforce sizes where all light reaches the cameras and the median range is 8."""
    distances = nearest_offsets(cloud.means, cameras).norm(dim=1)
    limits = size_limits(*sampling(cloud.means, cameras, 8.0), distances, torch.ones(len(cloud)), 8.0)
    enforce_sizes(cloud, *limits)


def camera_at(z, kind="perspective"):
    """A camera at (0, 0, z) that looks along z."""
    pose = np.eye(4)
    pose[2, 3] = -z
    return Camera("", 64, 64, FOCAL, FOCAL, 32, 32, pose, kind)


def cloud_at(means, sigma):
    """White, nearly opaque Gaussians of one standard deviation."""
    count = len(means)
    return GaussianCloud(
        means=torch.as_tensor(means, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(sigma)),
        opacity_logits=torch.full((count,), 3.0),
        sh0=torch.ones(count, 1, 3),
        shN=torch.zeros(count, 0, 3),
        background=torch.zeros(3),
    )


def test_the_nearest_image_that_sees_a_gaussian_samples_it_most_finely():
    means = torch.tensor([[0.0, 0, 8], [0, 0, 3], [100, 0, 8], [0, 0, -5]])
    rates, _ = sampling(means, [camera_at(0), camera_at(4)], 8.0)
    # The second is behind the nearer camera, the third beside both images, the fourth behind both cameras.
    torch.testing.assert_close(rates, torch.tensor([FOCAL / 4, FOCAL / 3, 0, 0]))
    torch.testing.assert_close(sampling(means[:1], [camera_at(0, "orthographic")], 8.0)[0], torch.tensor([FOCAL]))


def test_only_axes_that_no_image_could_show_are_enlarged():
    cloud = cloud_at([[0.0, 0, 8], [100, 0, 8]], 1e-4)
    cloud.log_scales[:, 1] = math.log(0.2)
    enforce_in_air(cloud, [camera_at(0)])
    least = math.sqrt(LEAST_VARIANCE) * 8 / FOCAL
    torch.testing.assert_close(cloud.scales, torch.tensor([[least, 0.2, least], [1e-4, 0.2, 1e-4]]))


def test_axes_that_are_large_beside_the_distance_from_the_nearest_camera_are_reduced():
    cloud = cloud_at([[0.0, 0, 8], [0, 30, 0], [0, 0, 0], *[[0, 0, 7]] * 20_000], 50.0)
    cloud.log_scales[0, 1] = math.log(0.1)
    enforce_in_air(cloud, [camera_at(0), camera_at(4)])
    torch.testing.assert_close(cloud.scales[0], torch.tensor([LARGEST * 4, 0.1, LARGEST * 4]))
    torch.testing.assert_close(cloud.scales[1], torch.full((3,), LARGEST * 30))  # in no view
    assert 0 < cloud.scales[2, 0] < LARGEST, "the place of a camera"


def test_offsets_are_from_the_nearest_of_many_cameras():
    cameras = [camera_at(z) for z in range(3 * CAMERAS_AT_ONCE)]
    heights = torch.tensor([0.25, 1.25, CAMERAS_AT_ONCE + 3.25, 3 * CAMERAS_AT_ONCE - 0.75, -2.0])
    means = torch.stack([torch.full((5,), 1e3), torch.zeros(5), heights], 1)
    expected = torch.tensor([0.25, 0.25, 0.25, 0.25, -2])
    torch.testing.assert_close(nearest_offsets(means, cameras)[:, 2], expected, rtol=0, atol=0)


def test_few_gaussians_may_be_as_large_as_covering_an_image_takes():
    cloud = cloud_at([[0.0, 0, 8], [1, 0, 8], [0, 1, 8], [0, 0, 16]], 50.0)
    enforce_in_air(cloud, [camera_at(0)])  # a pixel is 8 / FOCAL wide at distance 8
    torch.testing.assert_close(cloud.scales[0], torch.full((3,), COVERING * 1.3 * 64 / 2 * 8 / FOCAL))


def test_gaussians_that_the_water_hides_may_be_larger():
    means = torch.tensor([[0.0, 0, 1], [0, 0, 5], [0, 0, 29]])
    distances = torch.tensor([1.0, 4, 20])
    visible = torch.exp(-0.5 * distances)
    spacings = sampling(means.repeat(9000, 1), [camera_at(0), camera_at(9)], 8.0)[1][:3]
    _, largest = size_limits(torch.ones(3), spacings, distances, visible, 8.0)
    fractions = largest / distances
    assert LARGEST < fractions[0] < fractions[1] < fractions[2] <= LARGEST_HIDDEN
    assert fractions[2] > 0.99 * LARGEST_HIDDEN


def least_alpha(cloud, zoom):
    """Least alpha in the middle of an image at `zoom` times the training width."""
    camera = camera_at(0).resized(round(64 * zoom))
    alpha = rasterize(
        cloud.means, cloud.quats, cloud.scales, cloud.opacities, torch.ones(len(cloud), 1), torch.eye(4),
        torch.from_numpy(camera.K).float(), camera.width, camera.height, torch.zeros(1), "torch",
    ).alpha  # fmt: skip
    rim = round(12 * zoom)
    return float(alpha[rim:-rim, rim:-rim].min())


def test_a_surface_that_is_closed_in_training_is_closed_from_nearer_and_farther():
    steps = (np.arange(-28, 28) + 0.5) * 8 / FOCAL  # one Gaussian per pixel, at distance 8
    grid = np.stack([*np.meshgrid(steps, steps), np.full((56, 56), 8.0)], -1).reshape(-1, 3)
    thin, kept = cloud_at(grid, 1e-4), cloud_at(grid, 1e-4)
    enforce_in_air(kept, [camera_at(0)])
    assert least_alpha(thin, 1) > 0.95 and least_alpha(thin, 2) < 0.5
    assert all(least_alpha(kept, zoom) > 0.75 for zoom in (0.5, 1, 2))


@pytest.mark.parametrize("water", ["on", "off", "found", "unknown"])
def test_no_gaussian_of_a_result_is_thinner_or_larger(tiny_scene, tmp_path, monkeypatch, water):
    """Without water, all light counts as seen only if the plan has found that there is none."""
    monkeypatch.setattr(sizes, "COVERING", 0.0)
    monkeypatch.setattr(sizes, "LARGEST", 0.01)
    monkeypatch.setattr(sizes, "LARGEST_HIDDEN", 0.02)  # some Gaussians of this run would be larger
    checked = []

    def keep(trainer):
        checked.append(trainer)
        decision = trainer.selection.plan.effects["attenuation"]
        found = {"found": {"state": "off", "overruled": False}, "unknown": {"state": "unknown", "overruled": False}}
        trainer.selection.plan.effects["attenuation"] = replace(decision, **found.get(water, {}))

    effects = "water=on" if water == "on" else "water=off"
    settings = TrainSettings(iterations=60, width=64, max_gaussians=300, effects=effects)
    train_with(tiny_scene, tmp_path / "run", settings, keep)
    state, inputs = checked[0].state, checked[0].inputs

    cameras = [image.camera for image in inputs.training]
    offsets = nearest_offsets(state.cloud.means, cameras)
    seen = torch.full((len(offsets),), float(water == "found"))
    if water == "on":
        seen = visibility(state.effects.medium, offsets)
    sampled = sampling(state.cloud.means, cameras, inputs.median_range)
    least, largest = size_limits(*sampled, offsets.norm(dim=1), seen, inputs.median_range)
    assert (state.cloud.scales.amin(1) > 0.999 * least).all() and (least > 0).any()
    assert 0.99 < (state.cloud.scales.amax(1) / largest).max() < 1.01
