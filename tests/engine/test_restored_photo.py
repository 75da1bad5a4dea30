"""Photos without water: what is added to a render from the photo."""

import numpy as np

from swag_engine.rendering.restored_photo import likely_detail

COVARIANCE = 0.02 * np.array([[1.0, 0.8, 0.6], [0.8, 1.0, 0.8], [0.6, 0.8, 1.0]])


def seen(gain: tuple[float, float, float], noise: float, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Details of a surface (64, 80, 3), the difference that a photo shows, gain and noise."""
    random = np.random.default_rng(seed)
    detail = random.multivariate_normal(np.zeros(3), COVARIANCE, (64, 80))
    gains, variance = np.broadcast_to(np.array(gain), detail.shape), np.full(detail.shape, noise**2)
    difference = gains * detail + noise * random.standard_normal(detail.shape)
    return detail, difference, gains, variance


def error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Root mean square error (3,) of red, green and blue."""
    return np.sqrt(((estimate - truth) ** 2).mean((0, 1)))


def test_near_details_are_those_of_the_photo():
    detail, difference, gain, noise = seen((0.9, 0.9, 0.9), 1e-4)
    assert error(likely_detail(difference, gain, noise, COVARIANCE, 4.0), detail).max() < 1e-3


def test_details_are_nearer_to_the_truth_than_the_render_and_than_the_photo_without_water():
    detail, difference, gain, noise = seen((0.05, 0.4, 0.5), 0.02)
    found = error(likely_detail(difference, gain, noise, COVARIANCE, 4.0), detail)
    rendered, inverted = error(np.zeros_like(detail), detail), error(difference / gain, detail)
    assert (found < 0.65 * rendered).all() and (found < inverted).all()


def test_red_that_no_light_reaches_follows_green_and_blue_as_in_the_scene():
    detail, difference, gain, noise = seen((1e-4, 0.5, 0.5), 0.005)
    found = likely_detail(difference, gain, noise, COVARIANCE, 4.0)
    assert np.corrcoef(found[..., 0].ravel(), detail[..., 0].ravel())[0, 1] > 0.75


def test_what_is_not_more_than_noise_is_left_out():
    _, difference, gain, noise = seen((0.5, 0.5, 0.5), 0.05)
    only_noise = difference - gain * seen((0.5, 0.5, 0.5), 0.05)[0]
    found = likely_detail(only_noise, gain, noise, COVARIANCE, 8.0)
    assert np.abs(found).mean() < 0.02 * np.abs(only_noise / gain).mean()


def test_blocks_of_compression_in_open_water_do_not_become_colors():
    difference = np.zeros((64, 80, 3))
    difference[:, ::8] = 0.02
    gain, noise = np.full(difference.shape, 1e-4), np.full(difference.shape, 1e-5)
    assert np.abs(likely_detail(difference, gain, noise, COVARIANCE, 4.0)).max() < 0.1
