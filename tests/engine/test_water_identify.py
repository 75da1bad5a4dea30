"""Finding the water of a scene in its sparse points."""

import json
from pathlib import Path

import numpy as np
import pytest

from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.water.identify import Observations, fit_water, observe

SHIPPED = Path(__file__).parents[1] / "scenes" / "reef_wreck"


def sightings(beta_D, beta_B, B, count=400, noise=0.0, spread=3.0, seed=0):
    """Points of random colours seen from four random ranges each through known water."""
    r = np.random.default_rng(seed)
    ranges = 2 * spread ** r.uniform(0, 1, (count, 4))
    J = r.uniform(0.05, 0.9, (count, 1, 3))
    light = J * np.exp(-beta_D * ranges[..., None]) + B * (1 - np.exp(-beta_B * ranges[..., None]))
    light = light * (1 + noise * r.standard_normal(light.shape))
    light = light.reshape(-1, 3)
    image, place = np.zeros(len(light), int), np.zeros((len(light), 2))
    return Observations(np.repeat(np.arange(count), 4), ranges.ravel(), light, image, place, light)


def test_exact_sightings_give_the_water_exactly():
    beta_D, beta_B, B = np.array([0.3, 0.1, 0.06]), np.array([0.25, 0.12, 0.1]), np.array([0.03, 0.16, 0.22])
    fit = fit_water(sightings(beta_D, beta_B, B))
    assert fit.found
    np.testing.assert_allclose(fit.beta_D, beta_D, rtol=0.01)
    np.testing.assert_allclose(fit.beta_B, beta_B, rtol=0.01)
    np.testing.assert_allclose(fit.B, B, rtol=0.01)


def test_wrong_matches_do_not_bend_the_water():
    beta_D, beta_B, B = np.array([0.3, 0.1, 0.06]), np.array([0.25, 0.12, 0.1]), np.array([0.03, 0.16, 0.22])
    seen = sightings(beta_D, beta_B, B, count=1500, noise=0.02)
    wrong = np.random.default_rng(1).choice(len(seen.track), len(seen.track) // 50, replace=False)
    seen.light[wrong] = np.random.default_rng(2).uniform(0, 0.8, (len(wrong), 3))
    np.testing.assert_allclose(fit_water(seen).beta_D, beta_D, rtol=0.15)


@pytest.mark.parametrize(
    "seen, reason",
    [
        (sightings(np.full(3, 0.2), np.full(3, 0.2), np.full(3, 0.2), count=10), "only 40 sightings"),
        (sightings(np.full(3, 0.2), np.full(3, 0.2), np.full(3, 0.2), spread=1.05), "ranges of ratio 1.0"),
        (sightings(np.zeros(3), np.ones(3), np.zeros(3), noise=0.05), "No water is modelled"),  # air
        (sightings(np.full(3, 0.3), np.ones(3), np.zeros(3), noise=0.05), "No water is modelled"),  # light falls off
    ],
)
def test_no_water_where_there_is_none_or_it_cannot_be_told(seen, reason):
    fit = fit_water(seen)
    assert not fit.found and reason in fit.reason


def test_the_demo_scene_gives_its_true_water():
    scene = load_scene(SHIPPED)
    views = [view for view in scene.views if view.camera.name not in ("reef_000.jpg", "reef_008.jpg", "reef_016.jpg")]
    images = load_images(scene, views, 640)
    fit = fit_water(observe(images, [view.point_indices for view in views], scene.points))
    truth = json.loads((SHIPPED / "truth.json").read_text())["water"]
    assert fit.found
    np.testing.assert_allclose(fit.beta_D, truth["beta_D"], rtol=0.1)
    np.testing.assert_allclose(fit.B, truth["B_inf"], rtol=0.1)
    np.testing.assert_allclose(fit.beta_B, truth["beta_B"], rtol=0.2)
