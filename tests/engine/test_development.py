import json

"""Development of restored colors: the formula, its text and file, baking into splats, and finding it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.base.transfer import linear_to_srgb, srgb_to_linear
from swag_engine.experiments.develop_run import CLIPPED_VALUE, find_development
from swag_engine.formats.exr import write_light_exr
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.splats.develop_splats import bake_development
from swag_engine.splats.development import (
    GREY,
    NO_DEVELOPMENT,
    ColorView,
    Development,
    white_balance,
)
from swag_engine.splats.splats import Splats
from tests.engine.exr_files import read_exr

MIXED = Development(0.5, (1.2, 0.95, 0.8), 1.3, ((1.1, -0.1, 0.0), (0.0, 0.9, 0.1), (-0.05, 0.0, 1.05)), knee=0.7)


def colors(count=1000, brightest=1.5):
    return np.random.default_rng(0).uniform(0.0, brightest, (count, 3))


def test_no_development_changes_no_bit():
    values = colors()
    assert NO_DEVELOPMENT.apply(values) is values and NO_DEVELOPMENT.inverse(values) is values
    assert ColorView(restored=MIXED).at(1.0) == NO_DEVELOPMENT


def test_a_development_can_be_undone():
    np.testing.assert_allclose(MIXED.inverse(MIXED.apply(colors())), colors(), atol=1e-9)


def test_exposure_doubles_light_and_contrast_keeps_middle_grey():
    light = np.array([[0.1, 0.2, 0.3]])
    np.testing.assert_allclose(srgb_to_linear(Development(1.0).apply(linear_to_srgb(light))), 2 * light)
    grey = linear_to_srgb(np.full(3, GREY))
    np.testing.assert_allclose(Development(contrast=1.7).apply(grey), grey)
    dark, bright = (Development(contrast=1.7).apply(grey + change)[0] - grey[0] for change in (-0.1, 0.1))
    assert dark < -0.12 and bright > 0.12


def test_highlights_are_rolled_off_smoothly_and_keep_their_hue():
    light = np.linspace(0, 20, 4001)
    rolled = srgb_to_linear(Development(knee=0.8).apply(linear_to_srgb(np.stack([light] * 3, axis=1))))[:, 0]
    steps = np.diff(rolled) / np.diff(light)
    assert (steps > 0).all() and rolled.max() < 1 and np.abs(np.diff(steps)).max() < 0.06, "monotone and without a kink"
    np.testing.assert_allclose(rolled[light <= 0.8], light[light <= 0.8], atol=1e-12)
    orange = np.array([4.0, 1.6, 0.4])
    developed = srgb_to_linear(Development(0.3, knee=0.8).apply(linear_to_srgb(orange)))
    np.testing.assert_allclose(developed / developed.max(), orange / orange.max(), atol=1e-9)


def test_development_of_restored_colors_fades_as_water_is_shown_and_adjustments_stay():
    view = ColorView(MIXED, Development(1.0))
    assert view.at(1.0) == Development(1.0) and ColorView(MIXED).at(0.0) == MIXED
    brighter = Development(1.0, (1.2, 1.0, 1.1), 0.8, knee=0.8)
    none, half, whole = (ColorView(brighter).at(water).apply(colors(brightest=0.5)) for water in (1.0, 0.5, 0.0))
    assert ((none < half) & (half < whole)).all()
    both = ColorView(Development(0.5, (1.2, 1.0, 0.8)), Development(0.25, contrast=1.2)).at(0.0)
    wanted = Development(0.75, (1.2, 1.0, 0.8), 1.2)
    np.testing.assert_allclose(both.apply(colors()), wanted.apply(colors()))


def test_json_keeps_everything_and_damage_is_named():
    assert Development.from_json(MIXED.to_json() | {"note": "more"}) == MIXED
    assert ColorView.from_json(ColorView(MIXED).to_json()) == ColorView(MIXED)
    wrong = ({"exposure": None}, {"exposure": 1e9}, {"white": [1, 2]}, {"matrix": 1}, {"knee": 2}, {"contrast": 0})
    for change in wrong:
        with pytest.raises(InputError, match="damaged"):
            Development.from_json(MIXED.to_json() | change)
    with pytest.raises(InputError, match="damaged"):
        ColorView.from_json({"restored": MIXED.to_json()})


def test_values_of_the_command_line():
    given = Development.from_text("exposure=0.5, white=1.1/1/0.9,contrast=1.1")
    assert given == Development(0.5, (1.1, 1.0, 0.9), 1.1, knee=0.8)
    assert Development.from_text("knee=1") == NO_DEVELOPMENT
    for text in ("bright", "exposure", "exposure=", "exposure=nan", "exposure=99", "white=1/2", "contrast=0", "x=1"):
        with pytest.raises(InputError, match="The development"):
            Development.from_text(text)


def test_the_development_of_a_run_is_found_by_its_name(tmp_path):
    run = RunFolder(tmp_path)
    assert run.color_view("auto") == run.color_view("none") == ColorView()
    run.write_development(MIXED.to_json())
    run.chart.write_text(json.dumps(replace(MIXED, exposure=1.0).to_json() | {"photos": []}))
    assert run.color_view("auto") == ColorView(restored=MIXED)
    assert run.color_view("chart").restored.exposure == 1.0 and run.color_view("none") == ColorView()
    assert run.color_view("exposure=1").at(1.0) == Development(1.0, knee=0.8)
    run.chart.unlink()
    with pytest.raises(InputError, match="no color chart"):
        run.color_view("chart")
    run.development.write_text("7")
    with pytest.raises(InputError, match="development.json does not hold"):
        run.color_view("auto")


def test_white_balance_keeps_luminance():
    warm, magenta = np.array(white_balance(0.5, 0.0)), np.array(white_balance(0.0, 0.5))
    assert white_balance(0.0, 0.0) == (1.0, 1.0, 1.0)
    assert warm[0] > 1 > warm[2] and magenta[1] < 1 < magenta[0] == magenta[2]
    for gains in (warm, magenta):
        assert gains @ (0.2126, 0.7152, 0.0722) == pytest.approx(1)


def test_baked_splats_look_like_the_developed_picture():
    random = np.random.default_rng(1)
    count = 3000
    splats = Splats(
        random.uniform((-1, -0.8, 3), (1, 0.8, 4), (count, 3)).astype("f4"),
        random.normal(size=(count, 4)).astype("f4"),
        np.full((count, 3), 0.06, "f4"),
        random.uniform(0.3, 0.99, count).astype("f4"),
        random.normal(0, (1.0, 0.1, 0.1, 0.1), (3, count, 4)).transpose(1, 2, 0).astype("f4") * 0.6,
    )

    def picture(shown):
        cloud, camera = GaussianCloud.from_splats(shown, (0.0, 0.0, 0.0)), Camera("", 64, 48, 60, 60, 32, 24, np.eye(4))
        return render(cloud, camera).color.detach().numpy().astype(np.float64)

    assert bake_development(splats, NO_DEVELOPMENT) is splats
    plain = picture(splats)
    development = Development(0.5, (1.2, 1.0, 0.8), knee=0.8)
    wanted = replace(development, knee=1.0).apply(plain).clip(0, 1)
    found = picture(bake_development(splats, development)).clip(0, 1)
    errors = [-10 * np.log10(np.mean((image - wanted) ** 2)) for image in (found, plain.clip(0, 1))]
    assert errors[0] > 38 and errors[1] < 30, errors


def scene(cast, gain, neutral):
    """Restored colors of a reef: orange and green things, and a fraction that is grey, under a cast and a gain."""
    random = np.random.default_rng(2)
    hues = np.where(random.random((5000, 1)) < 0.5, (1.0, 0.45, 0.2), (0.3, 0.8, 0.35))
    hues[: int(5000 * neutral)] = 1.0
    return linear_to_srgb(hues * random.uniform(0.05, 0.9, (5000, 1)) * gain * cast)


def test_grey_parts_give_the_white_point_and_bright_ones_the_exposure():
    cast = 2.0 ** np.array([-0.2, 0.0, 0.25])
    development, neutral = find_development(scene(cast, 0.25, 0.2), np.ones(5000), 2.0)
    assert neutral > 0.05 and 0.5 < development.exposure < 1.5
    grey = srgb_to_linear(development.apply(linear_to_srgb(0.3 * cast)))
    np.testing.assert_allclose(grey / grey[1], cast**0.5, atol=0.03)  # they may have this color themselves
    without, neutral = find_development(scene(cast, 0.5, 0.0), np.ones(5000), 2.0)
    assert neutral < 0.02 and without.white == (1.0, 1.0, 1.0)


def test_exposure_makes_the_bright_parts_or_the_median_bright_enough():
    without_bright_parts = np.full((1000, 3), 0.06)
    with_few = without_bright_parts.copy()
    with_few[:50] = 0.4
    cases = (
        (without_bright_parts, 0.13 / 0.06),
        (with_few, 0.8 / 0.4),
        (without_bright_parts * 3, 1),
        (with_few * 20, 0.1),
    )
    for light, expected in cases:
        development, _ = find_development(linear_to_srgb(light), np.ones(1000), 2.0)
        assert 2**development.exposure == pytest.approx(expected, rel=0.01)
        dim, _ = find_development(linear_to_srgb(light), np.ones(1000), 0.5)
        assert 2**dim.exposure == pytest.approx(min(expected, 2**0.5), rel=0.01)


def test_at_most_one_percent_is_clipped_however_bright_the_colors_are():
    values = scene(np.ones(3), 8.0, 0.1)
    values[:400] = (2.0, 2.5, 4.0)  # far places whose blue noise was amplified
    weights = np.ones(5000)
    weights[:400] = 0.0
    assert (values >= CLIPPED_VALUE).mean(axis=0).max() > 0.3
    development, _ = find_development(values, weights, 2.0)
    assert (development.apply(values) >= CLIPPED_VALUE).mean(axis=0).max() <= 0.01
    assert find_development(values, np.zeros(5000), 2.0) == (NO_DEVELOPMENT, 0.0)


def test_an_image_of_light_is_read_back_from_half_floats(tmp_path):
    light = np.random.default_rng(0).uniform(0, 3, (37, 23, 4)).astype("f4")
    light[0, 0] = 1e9
    write_light_exr(tmp_path / "light.exr", light[..., :3])
    write_light_exr(tmp_path / "alpha.exr", light)
    opaque, both = (read_exr(tmp_path / name) for name in ("light.exr", "alpha.exr"))
    wanted = light.clip(max=65504).astype("f2").astype("f4")
    np.testing.assert_array_equal(cv2.cvtColor(opaque, cv2.COLOR_BGR2RGB), wanted[..., :3])
    np.testing.assert_array_equal(cv2.cvtColor(both, cv2.COLOR_BGRA2RGBA), wanted)
    assert b"\x01\x00\x00\x00" in (tmp_path / "light.exr").read_bytes()[:100], "half floats"
