"""What cannot be restored: noise of images, confidence in colors without water, and what is shown where it is low."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
import torch

from swag_engine.base.transfer import linear_to_srgb, srgb_to_linear
from swag_engine.effects.lamp import Lamp
from swag_engine.evidence.noise import LEAST_OFFSET, LEAST_SLOPE, Noise, estimate_noise
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.gaussians.densify import PER_GAUSSIAN
from swag_engine.kernels.reference.harmonics import C0
from swag_engine.kernels.reference.transfer import to_light
from swag_engine.rendering.render import render
from swag_engine.rendering.restoration import (
    ATTENUATION_ERROR,
    BACKSCATTER_ERROR,
    LightSums,
    RestorationLimit,
    SceneColors,
    describe_restored,
    likely_light,
    render_confidence,
    restoration_limit,
    scene_colors,
)
from swag_engine.scene.cameras import Camera
from swag_engine.scene.images import TrainingImage
from swag_engine.water.medium import Medium

CAMERA = Camera("a.jpg", 96, 32, 48.0, 48.0, 48.0, 16.0, np.eye(4))
NOISE = Noise(np.full(3, LEAST_OFFSET), np.full(3, LEAST_SLOPE), np.zeros(3))
RANGES = np.array([1.0, 3.0, 10.0, 20.0, 40.0, 80.0])
BLUE = Medium.starting(
    5.0, "linear", *(torch.tensor(v) for v in ([0.3, 0.09, 0.06], [0.3, 0.1, 0.08], [0.02, 0.2, 0.3]))
)


# Noise ----------------------------------------------------------------------------------------------------------------


def noisy_image(offset, slope, seed):
    """An image with smooth parts of all brightnesses, edges and texture, and noise of a known variance in light."""
    random = np.random.default_rng(seed)
    light = cv2.GaussianBlur(random.random((180, 320, 3)), (0, 0), 15)
    light = 0.03 + 0.6 * (light - light.min()) / np.ptp(light)
    light[60:100, 50:120] *= 0.4
    light[120:160, 200:300] *= 1 + 0.4 * (np.indices((40, 100)).sum(0) % 2)[..., None]
    light = light + random.normal(size=light.shape) * np.sqrt(offset + slope * light)
    pixels = (linear_to_srgb(light.clip(0, 1)) * 255).round().astype(np.uint8)
    return TrainingImage(CAMERA, pixels, np.ones(light.shape[:2], bool))


@pytest.mark.parametrize(("offset", "slope"), [(1e-5, 2e-4), (0, 1e-3), (1e-4, 2e-4)])
def test_noise_is_estimated_beside_edges_and_texture(offset, slope):
    noise = estimate_noise([noisy_image(offset, slope, seed) for seed in range(3)], [])
    for light in (0.1, 0.2, 0.5):
        found, true = np.sqrt(noise.offset + noise.slope * light), np.sqrt(offset + slope * light)
        np.testing.assert_allclose(found, true, rtol=0.2)


def test_images_in_8_bits_have_the_noise_of_rounding():
    for images in (
        [noisy_image(0, 0, 0)],
        [],
        [TrainingImage(CAMERA, np.zeros((9, 9, 3), np.uint8), np.ones((9, 9), bool))],
    ):
        noise = estimate_noise(images, [])
        for light in (0.1, 0.3, 0.6):
            at = linear_to_srgb(np.array(light))
            rounding = (srgb_to_linear(at + 0.5 / 255) - srgb_to_linear(at - 0.5 / 255)) ** 2 / 12
            assert (noise.offset + noise.slope * light > 0.8 * rounding).all(), light
            assert (noise.offset + noise.slope * light < 2 * rounding).all(), light


def test_pixels_that_are_not_valid_do_not_count():
    image = noisy_image(0, 0, 0)
    image.pixels[:, :150] = np.random.default_rng(0).integers(60, 190, (180, 150, 3))
    image.valid[:, :150] = False
    assert estimate_noise([image], []).slope.max() < 2 * LEAST_SLOPE


def test_the_noise_of_compression_is_that_of_brightness_and_color():
    compression = np.array([1e-5, 4e-5, 9e-5])
    noise = Noise(np.full(3, LEAST_OFFSET), np.full(3, LEAST_SLOPE), compression)
    display = torch.tensor([0.02, 0.3, 0.6], dtype=torch.float64)
    light = to_light(display)
    with torch.enable_grad():
        change = torch.autograd.functional.jacobian(to_light, display).diagonal()
    # Y, Cb and Cr of display values, by the definition of ITU-R BT.601.
    red, green, blue = 0.299, 0.587, 0.114
    ycc = np.array([[red, green, blue], [-red / 1.772, -green / 1.772, 0.5], [0.5, -green / 1.402, -blue / 1.402]])
    rounded = np.diag(LEAST_OFFSET + LEAST_SLOPE * light.numpy())
    lost = np.linalg.inv(ycc) @ np.diag(compression) @ np.linalg.inv(ycc).T * np.outer(change, change)
    np.testing.assert_allclose(noise.covariance(light).numpy(), rounded + lost, rtol=1e-3)
    np.testing.assert_allclose(noise.variance(light), noise.covariance(light).diagonal())
    assert Noise.from_json(noise.to_json()).compression.tolist() == compression.tolist()


# Confidence -----------------------------------------------------------------------------------------------------------


def row_of_gaussians(colors=None, ranges=RANGES):
    """Gaussians beside one another in the image at rising ranges, all as large as seen from the camera."""
    n = len(ranges)
    directions = np.stack([np.linspace(-0.8, 0.8, n), np.zeros(n), np.ones(n)], 1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colors = np.full((n, 3), 0.5) if colors is None else colors
    return GaussianCloud(
        means=torch.from_numpy(directions * ranges[:, None]).float(),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        log_scales=torch.from_numpy(np.log(0.03 * ranges))[:, None].repeat(1, 3).float(),
        opacity_logits=torch.full((n,), 3.0),
        sh0=((torch.from_numpy(colors).float() - 0.5) / C0)[:, None],
        shN=0.1 * torch.ones(n, 3, 3),
        background=torch.zeros(3),
    )


def test_confidence_is_the_wiener_weight_of_the_least_squares_solution():
    random = np.random.default_rng(0)
    views, n = 5, 4
    J, weight = random.random((n, 3)), random.random((views, n, 1)) * 30
    T, back = random.random((views, n, 3)), 0.3 * random.random((views, n, 3))
    light = T * J + back
    variance = 1e-3 + 1e-2 * light
    sums = LightSums(*(torch.zeros(n, 3, dtype=torch.float64) for _ in fields(LightSums)))
    for view in range(views):
        seen = (torch.from_numpy(values[view]) for values in (weight, light, T, back, variance))
        sums.add(torch.arange(n), *seen)

    def solve(seen):
        return (weight * T * seen).sum(0) / (weight * T**2).sum(0)

    # An error of the light changes J by `solve` of it: noise in each image by itself, that of the water in all alike.
    by_image = [solve(np.where(np.arange(views)[:, None, None] == view, 1.0, 0.0)) for view in range(views)]
    noise = sum(by_image[view] ** 2 * variance[view] / weight[view] for view in range(views))
    backscatter = solve(BACKSCATTER_ERROR * back)
    information = (weight * T**2).sum(0)
    signal = (information * J**2).sum(0) / information.sum(0)
    depth = (weight * T**2 * -np.log(T)).sum(0) / information
    error = noise + backscatter**2 + signal * (ATTENUATION_ERROR * depth) ** 2
    found = sums.signal(torch.from_numpy(J))
    np.testing.assert_allclose(sums.confidence(found).numpy(), signal / (signal + error), rtol=1e-12)


def test_near_colors_stay_and_far_ones_are_limited_the_more_the_less_light_arrives():
    cloud = row_of_gaussians()
    limit, restored, _ = restoration_limit(cloud, [CAMERA], BLUE, NOISE)
    confidence = limit.confidence.numpy()
    assert (np.diff(confidence, axis=0) < 0).all()
    assert (np.diff(confidence[2:], axis=1) > 0).all()  # red is lost first, then green
    assert confidence[0].min() > 0.999 and confidence[4, 0] < 0.01 and confidence[-1].max() < 0.2
    limited = limit.apply(cloud)
    assert (limited.sh0[0] - cloud.sh0[0]).abs().max() * C0 < 1e-3
    assert torch.equal(limit.least_confidence, limit.confidence[:, 0])
    np.testing.assert_allclose(limited.shN[-1], limit.confidence[-1] * cloud.shN[-1])
    assert 0 < restored[0] < restored[2] < 1


def test_bright_blue_noise_far_away_becomes_a_usual_color_while_the_image_through_water_stays():
    colors = np.tile([0.4, 0.5, 0.4], (len(RANGES), 1))
    colors[-1] = (0.0, 0.2, 1.0)
    cloud = row_of_gaussians(colors)
    limit = restoration_limit(cloud, [CAMERA, CAMERA.resized(48)], BLUE, NOISE)[0]
    shown = 0.5 + C0 * limit.apply(cloud).sh0[-1, 0]
    np.testing.assert_allclose(shown, [0.4, 0.5, 0.4], atol=0.15)
    before, after = (render(of, CAMERA, 1, BLUE).color for of in (cloud, limit.apply(cloud)))
    assert (before - after).abs().max() < 0.01


@pytest.mark.parametrize("water", [0.0, 0.3, 0.9])
def test_through_less_water_the_errors_of_colors_count_less(water):
    colors = np.tile([0.4, 0.5, 0.4], (len(RANGES), 1))
    colors[-1] = (0.0, 0.2, 1.0)
    cloud = row_of_gaussians(colors)
    cloud.shN += 0.1
    limit = restoration_limit(cloud, [CAMERA], BLUE, NOISE)[0]
    seen = limit.apply(cloud, water)
    c = limit.confidence.double().numpy()
    ratio = (1 - c) / np.maximum(c, 1e-30) * (1 - water) ** 2  # variance of the error over that of colors
    np.testing.assert_allclose(
        seen.shN / cloud.shN, np.broadcast_to((1 / (1 + ratio))[:, None], cloud.shN.shape), atol=1e-6
    )
    J, likely = cloud.sh0[:, 0].double().numpy(), limit.apply(cloud).sh0[:, 0].double().numpy()
    # The estimate of each channel alone, m + s / (s + e) (J - m), with the m that gives the limited color.
    m = likely - (J - likely) * c / (1 - c)
    np.testing.assert_allclose(seen.sh0[:, 0], m + (J - m) / (1 + ratio), atol=1e-4)


def test_a_limit_has_no_graph_of_what_training_learns():
    cloud = row_of_gaussians()
    cloud.sh0.requires_grad_()
    limit = restoration_limit(cloud, [CAMERA], BLUE, NOISE)[0]
    assert not limit.color.requires_grad and not limit.confidence.requires_grad


def test_through_all_of_the_water_colors_are_as_trained():
    cloud = row_of_gaussians(np.random.default_rng(0).random((len(RANGES), 3)))
    limit = restoration_limit(cloud, [CAMERA], BLUE, NOISE)[0]
    assert torch.equal(limit.apply(cloud, 1).sh0, cloud.sh0) and torch.equal(limit.apply(cloud, 1).shN, cloud.shN)
    nearly = render(limit.apply(cloud, 0.999), CAMERA, 1, BLUE).color
    assert (nearly - render(cloud, CAMERA, 1, BLUE).color).abs().max() < 1e-3


def test_more_noise_and_a_lamp_that_does_not_reach_lower_the_confidence():
    cloud = row_of_gaussians()
    plain = restoration_limit(cloud, [CAMERA], BLUE, NOISE)[0].confidence
    more = Noise(100 * NOISE.offset, 100 * NOISE.slope, np.zeros(3))
    noisy = restoration_limit(cloud, [CAMERA], BLUE, more)[0].confidence
    lamp = restoration_limit(cloud, [CAMERA], BLUE, NOISE, Lamp.starting(5.0, 0.1))[0].confidence
    assert (noisy[:-1] < plain[:-1]).all() and (lamp[3:-1] < plain[3:-1]).all()


def test_water_without_backscatter_leaves_noise_and_attenuation_alone():
    medium = Medium(BLUE.attenuation, None, None, BLUE.unit_range)
    without = restoration_limit(row_of_gaussians(), [CAMERA], medium, NOISE)[0].confidence
    assert (without >= restoration_limit(row_of_gaussians(), [CAMERA], BLUE, NOISE)[0].confidence).all()
    assert without[-1, 0] < 1e-3 < without[-1, 2]


def test_gaussians_that_no_image_shows_keep_their_color():
    cloud = row_of_gaussians(np.random.default_rng(0).random((len(RANGES), 3)))
    cloud.means[2, 2] *= -1
    limit = restoration_limit(cloud, [CAMERA], BLUE, NOISE)[0]
    assert (limit.confidence[2] == 0).all()
    np.testing.assert_allclose(limit.apply(cloud).sh0[2], cloud.sh0[2], atol=1e-6)


def test_images_say_nothing_of_gaussians_that_they_do_not_show():
    around = np.diag([-1.0, 1, -1, 1])  # a camera at the same place that looks back
    ahead = row_of_gaussians(np.linspace(0.2, 0.8, 18).reshape(6, 3))
    behind = row_of_gaussians(np.linspace(0.9, 0.1, 18).reshape(6, 3))
    behind.means *= torch.tensor([-1.0, 1, -1])
    alone, _, colors = restoration_limit(ahead, [CAMERA], BLUE, NOISE)
    cameras = [replace(CAMERA, world_to_camera=around), CAMERA]
    both = restoration_limit(behind.followed_by(ahead), cameras, BLUE, NOISE, colors=colors)[0]
    torch.testing.assert_close(both.confidence[6:], alone.confidence)
    torch.testing.assert_close(both.color[6:], alone.color)


def likely(J, error, weight):
    J, error, weight = map(torch.from_numpy, (J, error, weight))
    return likely_light(J, error, scene_colors(J, error, weight, J.square().mean(0))).numpy()


def scene_of_known_colors(count=4000):
    """Light of a scene whose channels vary together, seen with errors that differ between channels and surfaces."""
    random = np.random.default_rng(0)
    mean, covariance = np.array([0.3, 0.25, 0.2]), 0.01 * np.array([[1, 0.9, 0.8], [0.9, 1, 0.9], [0.8, 0.9, 1]])
    J = random.multivariate_normal(mean, covariance, count)
    error = 10 ** random.uniform(-6, 2, (count, 1)) * np.array([1.0, 1e-2, 1e-3])
    return J, J + random.normal(size=J.shape) * np.sqrt(error), error, mean, covariance


def test_likely_light_is_the_best_linear_estimate_without_knowing_the_scene():
    J, seen, error, mean, covariance = scene_of_known_colors()
    found = likely(seen, error, np.ones(len(J)))
    gain = covariance @ np.linalg.inv(covariance + error[:, :, None] * np.eye(3))
    best = mean + np.einsum("nij,nj->ni", gain, seen - mean)
    each = mean + 0.01 / (0.01 + error) * (seen - mean)
    wrong, least, alone = (((of - J) ** 2).mean() for of in (found, best, each))
    assert wrong < 1.02 * least and wrong < 0.6 * alone


def test_a_channel_without_evidence_follows_the_others_and_a_surface_without_any_is_the_mean():
    _, seen, error, mean, covariance = scene_of_known_colors()
    seen[0], error[0] = (5.0, 0.45, 0.4), (100.0, 1e-8, 1e-8)
    seen[1], error[1] = (5.0, 0.0, 3.0), (1e5, 1e5, 1e5)
    seen[2], error[2] = (0.5, 0.1, 0.3), 1e-9
    weight = np.ones(len(seen))
    weight[3], seen[3] = 0, 1e3
    red, nothing, certain = likely(seen, error, weight)[:3]
    expected = mean[0] + covariance[0, 1:] @ np.linalg.inv(covariance[1:, 1:]) @ (red[1:] - mean[1:])
    assert red[0] == pytest.approx(expected, abs=0.01) and red[0] > mean[0] + 0.1
    np.testing.assert_allclose(nothing, mean, atol=0.01)
    np.testing.assert_allclose(certain, [0.5, 0.1, 0.3], atol=1e-4)


def test_light_that_no_image_shows_stays():
    J = np.random.default_rng(0).random((4, 3))
    np.testing.assert_allclose(likely(J, np.ones((4, 3)), np.zeros(4)), J, rtol=1e-5)


def test_parts_of_a_scene_are_limited_alike_by_the_colors_of_the_whole():
    whole = row_of_gaussians(np.random.default_rng(0).random((len(RANGES), 3)))
    limit, _, colors = restoration_limit(whole, [CAMERA], BLUE, NOISE)
    part = GaussianCloud(**{name: getattr(whole, name)[3:] for name in PER_GAUSSIAN}, background=whole.background)
    known = SceneColors.from_json(colors.to_json())
    alike, apart = (restoration_limit(part, [CAMERA], BLUE, NOISE, colors=of)[0] for of in (known, None))
    torch.testing.assert_close(alike.color, limit.color[3:], atol=1e-5, rtol=0)
    torch.testing.assert_close(alike.confidence, limit.confidence[3:])
    assert (apart.color - limit.color[3:]).abs().max() > 0.02


def test_a_limit_is_kept_in_a_checkpoint():
    cloud = row_of_gaussians()
    count = len(cloud)
    limit = RestorationLimit(torch.rand(count, 3), torch.rand(count, 3))
    stored = limit.tensors() | cloud.parameters()
    read = RestorationLimit.from_checkpoint(stored)
    assert torch.equal(read.confidence, limit.confidence) and torch.equal(read.color, limit.color)
    assert RestorationLimit.from_checkpoint(cloud.parameters()) is None


def test_the_map_shows_confidence_where_gaussians_are():
    cloud = row_of_gaussians(ranges=np.array([2.0, 2.0, 2.0]))
    shown = render_confidence(cloud, torch.tensor([0.2, 0.5, 1.0]), CAMERA)
    np.testing.assert_allclose([shown[16, x] for x in (10, 48, 86)], [0.2, 0.5, 1.0], atol=0.02)
    assert shown[0].isnan().all()


def test_the_user_is_told_what_cannot_be_restored():
    assert describe_restored(torch.tensor([0.827, 0.9934, 0.998])).startswith(
        "Too far away to be restored: red in 17%, green in 1% of what the photos show."
    )
    assert describe_restored(torch.tensor([0.996, 1.0, 1.0])) == ""
