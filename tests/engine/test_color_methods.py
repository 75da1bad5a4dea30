"""Methods that restored colors are compared with, on images whose true colors are known."""

import json

import cv2
import numpy as np
import pytest

from benchmarks import common, restored_colors
from benchmarks.color_methods import best_gain, clahe, grey_world, hue_error, local_average, sea_thru, true_water
from benchmarks.restored_colors import seen_points, world_points
from swag_engine.base.transfer import linear_to_srgb, srgb_to_linear
from swag_engine.evaluation.metrics import restored_error
from swag_engine.scene.cameras import Camera

SHAPE = (60, 80)
ALL = np.ones(SHAPE, bool)
WATER = {"beta_D": [0.4, 0.12, 0.08], "beta_B": [0.3, 0.15, 0.12], "B_inf": [0.03, 0.15, 0.25]}


def patches(seed: int = 0) -> np.ndarray:
    """Make an image of patches of 4 pixels: colors of mean grey, some nearly black."""
    random = np.random.default_rng(seed)
    light = random.uniform(0.02, 0.9, (SHAPE[0] // 4, SHAPE[1] // 4, 3))
    light[random.random(light.shape[:2]) < 0.1] = 0.001
    return linear_to_srgb(light.repeat(4, 0).repeat(4, 1))


def ramp_of_ranges() -> np.ndarray:
    return np.broadcast_to(np.linspace(1.0, 8.0, SHAPE[1]), SHAPE).copy()


def in_water(image: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    beta_D, beta_B, B_inf = (np.array(values) for values in WATER.values())
    z = ranges[..., None]
    light = srgb_to_linear(image) * np.exp(-beta_D * z) + B_inf * (1 - np.exp(-beta_B * z))
    return linear_to_srgb(light)


def test_the_grey_world_removes_a_cast():
    image = patches() * 0.8
    image *= image.mean() / image.mean(axis=(0, 1))
    cast = image * [0.4, 1.0, 0.9]
    balanced = grey_world(cast)
    np.testing.assert_allclose(balanced, image * (cast.mean() / image.mean()), atol=1e-9)
    assert np.ptp(balanced.mean(axis=(0, 1))) < 1e-9


def test_the_grey_world_of_a_missing_channel_is_finite():
    image = patches() * [0.0, 1.0, 1.0]
    assert np.isfinite(grey_world(image)).all()


def test_clahe_raises_local_contrast_and_keeps_hue():
    image = 0.4 + 0.1 * patches()
    even = clahe(image)
    assert even.std() > 1.5 * image.std()
    assert hue_error(even, image, ALL) < 5 or np.isnan(hue_error(even, image, ALL))


def test_the_best_gain_recovers_gains_of_linear_light():
    truth = patches()
    seen = linear_to_srgb(srgb_to_linear(truth) * [0.05, 0.4, 0.7])
    assert restored_error(best_gain(seen, truth, ALL), truth, ALL)[1] < 0.02


def test_the_best_gain_uses_only_valid_pixels():
    truth, valid = patches(), ALL.copy()
    valid[:, 40:] = False
    seen = linear_to_srgb(srgb_to_linear(truth) * [0.3, 0.5, 0.9])
    seen[:, 40:] = 0.5
    assert restored_error(best_gain(seen, truth, valid), truth, valid)[1] < 0.02


def test_the_best_gain_is_never_worse_than_the_photo_in_water():
    truth = patches()
    seen = in_water(truth, ramp_of_ranges())
    assert restored_error(best_gain(seen, truth, ALL), truth, ALL)[1] < restored_error(seen, truth, ALL)[1]


def test_the_true_water_gives_the_true_image():
    truth, ranges = patches(), ramp_of_ranges()
    np.testing.assert_allclose(true_water(in_water(truth, ranges), ranges, WATER), truth, atol=1e-9)


def test_sea_thru_brings_an_image_in_known_water_near_to_the_truth():
    truth, ranges = patches(), ramp_of_ranges()
    seen = in_water(truth, ranges)
    restored = sea_thru(seen, ranges)
    errors = {name: restored_error(of, truth, ALL)[1] for name, of in (("seen", seen), ("restored", restored))}
    assert errors["restored"] < 4 < errors["seen"], errors
    # The far half is restored as the near half is, which no gain of the whole image does.
    far = ALL.copy()
    far[:, :40] = False
    gained = restored_error(best_gain(seen, truth, ALL), truth, far)[1]
    assert restored_error(restored, truth, far)[1] < gained


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_sea_thru_keeps_what_has_no_range(nothing):
    image, ranges = in_water(patches(), ramp_of_ranges()), ramp_of_ranges()
    ranges[:10] = nothing
    restored = sea_thru(image, ranges)
    np.testing.assert_array_equal(restored[:10], image[:10])
    assert np.isfinite(restored).all()
    np.testing.assert_array_equal(sea_thru(image, np.full(SHAPE, nothing)), image)


def test_the_local_average_does_not_cross_a_step_of_range():
    direct, z = np.zeros((*SHAPE, 3)), np.full(SHAPE, 2.0)
    direct[:, 40:], z[:, 40:] = 1.0, 9.0
    average = local_average(direct, z, ALL)
    np.testing.assert_allclose(average[:, :40], 0, atol=1e-12)
    np.testing.assert_allclose(average[:, 40:], 1, atol=1e-12)


def test_hue_error_is_the_angle_between_hues():
    red, green, grey = (np.full((*SHAPE, 3), color, float) for color in ([0.8, 0.1, 0.1], [0.1, 0.8, 0.1], 0.5))
    assert hue_error(red, red, ALL) == 0
    assert 80 < hue_error(green, red, ALL) < 130
    assert np.isnan(hue_error(red, grey, ALL))


def test_points_are_seen_unless_hidden_or_outside():
    camera = Camera("a.jpg", 40, 30, 30.0, 30.0, 20.0, 15.0, np.eye(4))
    ranges = np.full((30, 40), 5.0)
    points = world_points(camera, ranges).reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 5.0)
    assert seen_points(points, camera, ranges).all()
    assert not seen_points(1.2 * points, camera, ranges).any()
    assert seen_points(1.2 * points, camera, np.zeros((30, 40))).all()
    assert not seen_points(-points, camera, ranges).any()
    beside = points + [100.0, 0, 0]
    assert not seen_points(beside, camera, ranges).any()


def test_rows_of_other_scenes_and_seeds_stay(tmp_path, monkeypatch):
    monkeypatch.setattr(restored_colors, "RESULTS", tmp_path)
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    for name, seed, value in (("reef, coast", 21, 1), ("demo", 0, 2), ("reef, coast", 11, 3), ("demo", 0, 4)):
        restored_colors.keep_row(name, seed, {"seen": value})
    kept = json.loads((tmp_path / "restored_colors.json").read_text("utf-8"))["scenes"]
    assert kept == {"demo": {"0": {"seen": 4}}, "reef, coast": {"11": {"seen": 3}, "21": {"seen": 1}}}
    assert [*kept] == ["demo", "reef, coast"] and [*kept["reef, coast"]] == ["11", "21"]


def test_the_next_best_method_does_not_know_the_truth():
    row = {name: {"delta_e": 10.0 + number} for number, name in enumerate(restored_colors.METHODS)}
    row["best gain"]["delta_e"] = row["true water"]["delta_e"] = row["restored photo"]["delta_e"] = 1.0
    row["CLAHE"]["delta_e"] = 2.0
    assert restored_colors.next_best(row) == "CLAHE"


def test_the_picture_has_a_row_for_every_kind_of_water_and_stays_small(tmp_path, monkeypatch):
    monkeypatch.setattr(restored_colors, "PICTURES", tmp_path)
    noise = np.random.default_rng(0).integers(0, 255, (60, 640, 3), np.uint8)  # packs badly: quality must give way
    scenes = ("demo", *restored_colors.PICTURED)
    for name in scenes[1:]:
        cv2.imwrite(str(tmp_path / f"picture {name} 11.png"), noise)
    restored_colors.write_picture(tmp_path)
    assert not (tmp_path / "restored_colors.webp").exists(), "one scene is missing"
    cv2.imwrite(str(tmp_path / "picture demo 0.png"), noise)
    monkeypatch.setattr(restored_colors, "MOST_BYTES", 200_000)
    restored_colors.write_picture(tmp_path)
    packed = tmp_path / "restored_colors.webp"
    height, width = (round(size * restored_colors.PICTURE_SCALE) for size in (60 * len(scenes), 640))
    assert cv2.imread(str(packed)).shape == (height, width, 3) and packed.stat().st_size <= 200_000
