"""Photos without water: what is added to a render from the photo, and colors of Gaussians that are fitted to photos."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from swag_engine.base.transfer import linear_to_srgb, srgb_to_linear
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.evidence.noise import LEAST_OFFSET, LEAST_SLOPE, MAD_TO_SD, YCC_TO_RGB, Noise
from swag_engine.kernels.reference.harmonics import C0
from swag_engine.rendering.model import SceneModel
from swag_engine.rendering.photo_terms import uniform_image
from swag_engine.rendering.render import render
from swag_engine.rendering.restoration import RestorationLimit
from swag_engine.rendering.restored_photo import (
    blurred,
    fit_to_photos,
    likely_detail,
    photos_to_fit,
    restored_photo,
    water_deviation,
    water_terms,
)
from swag_engine.scene.cameras import Camera
from swag_engine.scene.images import TrainingImage
from swag_engine.water.medium import Medium
from tests.engine.water_scenes import wall_cloud

COVARIANCE = 0.02 * np.array([[1.0, 0.8, 0.6], [0.8, 1.0, 0.8], [0.6, 0.8, 1.0]])


def seen(gain: tuple[float, float, float], noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Details of a surface (64, 80, 3), the difference that a photo with noise shows, and gain."""
    random = np.random.default_rng(0)
    detail = random.multivariate_normal(np.zeros(3), COVARIANCE, (64, 80))
    gains = np.broadcast_to(np.array(gain), detail.shape)
    difference = gains * detail + noise * random.standard_normal(detail.shape)
    return detail, difference, gains


def error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Root mean square error (3,) of red, green and blue."""
    return np.sqrt(((estimate - truth) ** 2).mean((0, 1)))


def found(
    difference: np.ndarray, gain: np.ndarray, deviation: float, compression=(0, 0, 0), window=4.0, water=(0, 0, 0)
) -> np.ndarray:
    """The details that are found with noise of a standard deviation of linear light, in a photo of middle grey."""
    noise = Noise(np.full(3, deviation**2), np.zeros(3), np.array(compression))
    light, water_error = np.full(difference.shape, 0.2), np.broadcast_to(np.array(water, float), difference.shape)
    return likely_detail(difference, gain, light, noise, water_error, COVARIANCE, window)


def test_near_details_are_those_of_the_photo():
    detail, difference, gain = seen((0.9, 0.9, 0.9), 1e-4)
    assert error(found(difference, gain, 1e-4), detail).max() < 1e-3


def test_details_are_nearer_to_the_truth_than_the_render_and_than_the_photo_without_water():
    detail, difference, gain = seen((0.05, 0.4, 0.5), 0.02)
    estimate = error(found(difference, gain, 0.02), detail)
    rendered, inverted = error(np.zeros_like(detail), detail), error(difference / gain, detail)
    assert (estimate < 0.65 * rendered).all() and (estimate < inverted).all()


def test_red_that_no_light_reaches_follows_green_and_blue_as_in_the_scene():
    detail, difference, gain = seen((1e-4, 0.5, 0.5), 0.005)
    estimate = found(difference, gain, 0.005)
    assert np.corrcoef(estimate[..., 0].ravel(), detail[..., 0].ravel())[0, 1] > 0.75


def test_what_is_not_more_than_noise_is_left_out():
    detail, difference, gain = seen((0.5, 0.5, 0.5), 0.05)
    only_noise = difference - gain * detail
    assert np.abs(found(only_noise, gain, 0.05, window=8.0)).mean() < 0.02 * np.abs(only_noise / gain).mean()


def test_of_compressed_photos_brightness_is_kept_and_color_follows_the_scene():
    detail, difference, gain = seen((0.8, 0.8, 0.8), 1e-3)
    change = 0.53  # of linear light at .2 by display values
    lost = np.random.default_rng(1).normal(size=(64, 80, 2)) * 0.1
    difference = difference + gain * change / 0.8 * (lost @ YCC_TO_RGB[:, 1:].T)
    compression = (0.0, 0.1**2, 0.1**2)
    known, ignored = (error(found(difference, gain, 1e-3, each), detail) for each in (compression, (0, 0, 0)))
    assert (known < 0.75 * ignored).all()


@pytest.mark.parametrize("only_error", [False, True])
def test_what_the_water_is_wrong_by_is_not_taken_for_details(only_error):
    detail, difference, gain = seen((0.5, 0.5, 0.5), 1e-3)
    water = (0.2, 0.02, 0.02)
    wrong = np.random.default_rng(1).normal(size=detail.shape) * water
    truth, difference = (0 * detail, wrong) if only_error else (detail, difference + wrong)
    known, ignored = (error(found(difference, gain, 1e-3, water=each), truth) for each in (water, (0, 0, 0)))
    assert (known < (0.05 if only_error else 0.8) * ignored)[:1].all() and (known < ignored).all()


def test_blocks_of_compression_in_open_water_do_not_become_colors():
    difference = np.zeros((64, 80, 3))
    difference[:, ::8] = 0.02
    assert np.abs(found(difference, np.full(difference.shape, 1e-4), 3e-3)).max() < 0.1


CAMERA = Camera("a.jpg", 400, 300, 200.0, 200.0, 200.0, 150.0, np.eye(4))
NOISE = Noise(np.full(3, LEAST_OFFSET), np.full(3, LEAST_SLOPE), np.zeros(3))
WATER = Medium.starting(
    3.0, "linear", *(torch.tensor(v) for v in ([0.3, 0.09, 0.06], [0.3, 0.1, 0.08], [0.02, 0.2, 0.3]))
)


@pytest.fixture
def wall() -> tuple[SceneModel, TrainingImage, RestorationLimit]:
    """A wall of patches three metres away, its photo through water, and colors that are wrong by the same for all."""
    patches = np.random.default_rng(0).uniform(0.2, 0.6, (5, 7, 3))
    display = np.repeat(np.repeat(patches, 5, 0), 5, 1)[:25, :33]
    cloud = wall_cloud(display, 0.25, 3.0)
    model = SceneModel(cloud, SceneEffects({"medium": WATER}))
    pixels = (255 * render(cloud, CAMERA, 0, WATER).color).round().clamp(0, 255).byte().numpy()
    wrong = torch.from_numpy(display.reshape(-1, 3)).float() + torch.tensor([0.2, 0.1, -0.15])
    limit = RestorationLimit(torch.ones(len(cloud), 3), wrong)
    return model, TrainingImage(CAMERA, pixels, np.ones(pixels.shape[:2], bool)), limit


def test_a_photo_corrects_colors_that_are_limited_wrongly(wall):
    model, image, limit = wall
    true = render(model.cloud, CAMERA, 0, WATER, amount=0).color.numpy()
    rendered = render(limit.apply(model.cloud), CAMERA, 0, WATER, amount=0).color.numpy()
    found = linear_to_srgb(restored_photo(model, limit, image, NOISE, 0))
    assert np.abs(found - true).mean() < 0.05 * np.abs(rendered - true).mean()


def test_colors_are_fitted_to_restored_photos(wall):
    model, image, limit = wall
    fitted = fit_to_photos(model, limit, [image], NOISE, 0)
    true = 0.5 + C0 * model.cloud.sh0[:, 0]
    before, after = ((of.color - true).abs().mean() for of in (limit, fitted))
    assert after < 0.2 * before
    assert torch.equal(fitted.confidence, limit.confidence)


def test_colors_are_fitted_to_some_of_many_photos_and_to_all_of_few(wall):
    _, image, _ = wall
    assert [len(photos_to_fit([image] * count)) for count in (1, 5, 6, 12, 18, 300)] == [1, 5, 6, 6, 6, 100]


@pytest.mark.parametrize("deviation", [1.0, 9.0, 25.0])
def test_wide_blurs_on_reduced_images_are_those_of_the_image(deviation):
    values = cv2.GaussianBlur(np.random.default_rng(0).random((330, 401, 3)).astype(np.float32), (0, 0), 2.0)
    values[:, 200:] = values[:, 200:] + 1
    wide = blurred(values, deviation)
    assert wide.shape == values.shape
    assert np.abs(wide - cv2.GaussianBlur(values, (0, 0), deviation))[40:-40, 40:-40].max() < 0.02


def test_pixels_that_are_not_valid_change_no_color(wall):
    model, image, limit = wall
    left = np.zeros_like(image.valid)
    left[:, :200] = True
    damaged = np.where(left[..., None], image.pixels, np.uint8(255))
    fitted = fit_to_photos(model, limit, [replace(image, pixels=damaged, valid=left)], NOISE, 0)
    whole = fit_to_photos(model, limit, [image], NOISE, 0)
    x = model.cloud.means[:, 0]
    assert torch.equal(fitted.color[x > 1], limit.color[x > 1])
    torch.testing.assert_close(fitted.color[x < -1], whole.color[x < -1], atol=0.02, rtol=0)


@pytest.fixture
def half_far(wall) -> SceneModel:
    """The wall, with its right half fifteen metres away."""
    model, _, _ = wall
    cloud = model.cloud
    times = torch.where(cloud.means[:, :1] > 0, 5.0, 1.0)
    return SceneModel(
        replace(cloud, means=cloud.means * times, log_scales=cloud.log_scales + times.log()), model.effects
    )


def brighter_water(model: SceneModel, factors: tuple[float, float, float]) -> TrainingImage:
    """The photo with other light of the water."""
    light = srgb_to_linear(render(model.cloud, CAMERA, 0, WATER).color.numpy())
    water = srgb_to_linear(uniform_image(model.cloud, model.effects, CAMERA, 0.0))
    pixels = 255 * linear_to_srgb(light + (np.array(factors) - 1) * water)
    return TrainingImage(CAMERA, pixels.round().clip(0, 255).astype(np.uint8), np.ones(pixels.shape[:2], bool))


def test_the_error_of_the_water_is_measured_where_a_photo_shows_hardly_more(half_far):
    factors, grey = (1.2, 1.1, 0.95), np.full(3, 0.05)
    terms = water_terms(half_far, CAMERA)
    found = water_deviation(half_far, brighter_water(half_far, factors), *terms, grey, 0)
    np.testing.assert_allclose(found, MAD_TO_SD * np.abs(np.array(factors) - 1), rtol=0.15)
    assert water_deviation(half_far, brighter_water(half_far, (1, 1, 1)), *terms, grey, 0).max() < 0.02
    image = brighter_water(half_far, factors)
    assert not water_deviation(half_far, image, *terms, np.full(3, 100.0), 0).any()
    assert not water_deviation(half_far, replace(image, valid=~image.valid), *terms, grey, 0).any()


def test_far_places_do_not_take_the_color_of_water_that_differs_in_one_photo(wall, half_far):
    colors = 0.5 + C0 * half_far.cloud.sh0[:, 0]
    limit = replace(wall[2], color=colors)
    rendered = srgb_to_linear(render(half_far.cloud, CAMERA, 0, WATER, amount=0).color.numpy())
    same, other = (
        restored_photo(half_far, limit, brighter_water(half_far, (factor,) * 3), NOISE, 0) - rendered
        for factor in (1.0, 1.1)
    )
    assert np.abs(same[:, 240:]).mean() < 0.01
    inverted = 0.1 * np.array([0.02, 0.2, 0.3]) / np.exp(-15 * np.array([0.3, 0.09, 0.06]))
    assert (np.abs(other[:, 240:]).mean((0, 1)) < 0.25 * inverted).all()


@pytest.mark.parametrize("alpha", [0.7, 0.95])
def test_open_water_behind_a_surface_that_is_not_quite_opaque_is_not_taken_for_its_water(wall, alpha):
    model, _, _ = wall
    one = replace(
        model.cloud.rows(slice(0, 1)),
        means=torch.tensor([[0.0, 0.0, 3.0]]),
        log_scales=torch.tensor([[50.0, 50.0, 0.01]]).log(),
        opacity_logits=torch.logit(torch.tensor([alpha])),
    )
    middle = 150, 200
    opaque = srgb_to_linear(uniform_image(model.cloud, model.effects, CAMERA, 0.0))[middle]
    found = srgb_to_linear(uniform_image(one, model.effects, CAMERA, 0.0))[middle]
    open_water = srgb_to_linear(render(one.rows(slice(0, 0)), CAMERA, 0, WATER).color.numpy())[middle]
    assert (np.abs(found - opaque) < 0.7 * (1 - alpha) * np.abs(open_water - opaque) + 5e-4).all()
    assert (opaque < 0.7 * open_water).all()


def test_where_nothing_is_a_photo_shows_open_water(wall):
    model, _, _ = wall
    empty = uniform_image(model.cloud.rows(slice(0, 0)), model.effects, CAMERA, 1.0)
    np.testing.assert_allclose(empty, render(model.cloud.rows(slice(0, 0)), CAMERA, 0, WATER).color.numpy(), atol=1e-5)
