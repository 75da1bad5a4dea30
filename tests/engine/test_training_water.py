"""Runs with water: coefficients, restored colors, renders with less water, and resuming."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swag_engine.base.errors import InputError
from swag_engine.experiments.evaluate_run import evaluate_run, render_run
from swag_engine.formats.ply import read_ply
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.trainer import train

REEF = Path(__file__).parents[1] / "scenes" / "reef_wreck"
SETTINGS = TrainSettings(iterations=120, width=160, max_gaussians=6000, sh_degree=1)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The same run with and without the water modelled."""
    folder = tmp_path_factory.mktemp("water")
    for recipe in ("swag", "3dgs"):
        train(REEF, folder / recipe, TrainSettings(**{**SETTINGS.to_json(), "recipe": recipe}))
    return folder


def test_the_water_is_found_and_written(runs):
    metrics = json.loads((runs / "swag" / "metrics.json").read_text())
    assert metrics["water"].startswith("Water is modelled: Red loses 7") and metrics["background"] == [0, 0, 0]
    water, truth = (json.loads(path.read_text()) for path in (runs / "swag" / "water.json", REEF / "truth.json"))
    truth = truth["water"]
    assert (water["light"], water["per"]) == ("linear", "unit")
    np.testing.assert_allclose(water["beta_D"], truth["beta_D"], rtol=0.2)
    np.testing.assert_allclose(water["B_inf"], truth["B_inf"], rtol=0.2)
    assert not (runs / "3dgs" / "water.json").exists()


def test_exported_gaussians_are_without_water(runs, tmp_path):
    restored, colors = (read_ply(runs / recipe / "result.ply") for recipe in ("swag", "3dgs"))
    # Water absorbs red most: without it the Gaussians have more red relative to green.
    redness = [np.median(s.sh[:, 0, 0] - s.sh[:, 0, 1]) for s in (restored, colors)]
    assert redness[0] > redness[1] + 0.1


def test_evaluation_repeats_the_figures_and_restored_colors_are_nearer_to_the_truth(runs):
    errors = {}
    for recipe in ("swag", "3dgs"):
        evaluation = evaluate_run(runs / recipe)
        metrics = json.loads((runs / recipe / "metrics.json").read_text())
        assert evaluation["test_psnr"] == metrics["test_psnr"]
        errors[recipe] = evaluation["restored"]["delta_e"]
    assert errors["swag"] < 0.7 * errors["3dgs"]


def test_the_amount_of_water_can_be_chosen(runs, tmp_path):
    means = []
    for amount in (0.0, 0.5, 1.0):
        (path,) = render_run(runs / "swag", tmp_path / str(amount), "reef_000.jpg", amount)
        means.append(cv2.imread(str(path)).mean((0, 1))[::-1])
    image = cv2.imread(str(REEF / "images" / "reef_000.jpg")).mean((0, 1))[::-1]
    assert np.abs(means[2] - image).max() < 12
    blueness = [mean[2] - mean[0] for mean in means]
    assert blueness[0] < blueness[1] < blueness[2]
    with pytest.raises(InputError, match="from 0 to 1, not 1.5"):
        render_run(runs / "swag", tmp_path, None, 1.5)


def test_a_resumed_run_keeps_its_water(runs, tmp_path):
    asked = iter(range(10**9))
    settings = TrainSettings(**{**SETTINGS.to_json(), "recipe": "swag"})
    (tmp_path / "run").mkdir()
    shutil.copy(runs / "swag" / "plan.json", tmp_path / "run")  # saves making it again
    train(REEF, tmp_path / "run", settings, should_stop=lambda: next(asked) >= 60)
    train(REEF, tmp_path / "run", settings, resume=True)
    expected, _ = load_checkpoint(runs / "swag")
    got, _ = load_checkpoint(tmp_path / "run")
    assert "medium.veil" in expected
    assert all(torch.equal(got[name], expected[name]) for name in expected)
