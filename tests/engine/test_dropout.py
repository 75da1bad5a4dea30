"""Dropout: Gaussians are dropped at random where a run overfits its images, and nowhere else."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from swag_engine.experiments.report import write_report
from swag_engine.gaussians.densify import random_of
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.dropout import FULL_GAP_DB, GAP_DB, dropout_rate, opacity_factors
from swag_engine.training.trainer import train
from tests.scenes.clouds import make_cloud
from tests.scenes.runs import train_with
from tests.scenes.tiny import make_tiny_scene

SETTINGS = TrainSettings(iterations=600, width=64, max_gaussians=3000)


@pytest.fixture(scope="module")
def contradictory(tmp_path_factory):
    """A scene whose images each have random blotches, which can be overfitted and show nothing of the place."""
    scene = make_tiny_scene(tmp_path_factory.mktemp("contradictory") / "scene")
    random = np.random.default_rng(0)
    for path in sorted((scene / "images").iterdir()):
        blotches = cv2.GaussianBlur(random.normal(0, 1, (48, 64, 3)), (0, 0), 3)
        pixels = cv2.imread(str(path)) + 30 * blotches / blotches.std()
        cv2.imwrite(str(path), pixels.clip(0, 255).astype(np.uint8))
    return scene


def test_overfitting_is_found_and_reduced(contradictory, tmp_path):
    trained = {
        effects: train(contradictory, tmp_path / effects, TrainSettings(**vars(SETTINGS) | {"effects": effects}))
        for effects in ("dropout=on", "dropout=off")
    }
    lines = [json.loads(line) for line in (tmp_path / "dropout=on" / "metrics.jsonl").read_text().splitlines()]
    assert lines[-2]["training_psnr"] > lines[-2]["psnr"] + GAP_DB
    assert trained["dropout=on"]["metrics"]["psnr"] > trained["dropout=off"]["metrics"]["psnr"]
    sentence = trained["dropout=on"]["metrics"]["overfitting"]
    assert "at random" in sentence and trained["dropout=off"]["metrics"]["overfitting"] == ""
    # It explains a figure, and is nothing to act on: the report alone has it.
    assert sentence in write_report(tmp_path / "dropout=on").read_text()
    assert sentence not in trained["dropout=on"]["metrics"]["notes"]


def test_nothing_is_dropped_in_a_scene_that_does_not_overfit(tiny_scene, tmp_path):
    rates = []

    def watch(trainer):
        step = trainer.step
        trainer.step = lambda state, *rest: (rates.append(state.dropout), step(state, *rest))[1]

    settings = TrainSettings(iterations=150, width=64, max_gaussians=500)
    metrics = train_with(tiny_scene, tmp_path / "run", settings, watch)["metrics"]
    assert len(rates) >= 150 and not any(rates)
    assert metrics["overfitting"] == ""


def test_a_run_with_dropout_resumes_bit_equal(tiny_scene, tmp_path):
    def drop(trainer):
        trainer.state.dropout = 0.1
        trainer.inputs = replace(trainer.inputs, validation=[])  # they would set the rate

    short = TrainSettings(iterations=60, width=64, max_gaussians=500, effects="lamp=off,exposure=off,caustics=off")
    train_with(tiny_scene, tmp_path / "whole", short, drop)
    asked = iter(range(10**9))
    train_with(tiny_scene, tmp_path / "parts", short, drop, should_stop=lambda: next(asked) >= 33)
    train_with(tiny_scene, tmp_path / "parts", short, drop, resume=True)
    expected, state = load_checkpoint(tmp_path / "whole")
    got, _ = load_checkpoint(tmp_path / "parts")
    assert state["dropout"] == 0.1
    assert all(torch.equal(tensor, got[name]) for name, tensor in expected.items())


def test_the_rate_rises_with_the_gap():
    assert dropout_rate(30.0, 30.0 - GAP_DB, 0.2) == 0
    assert dropout_rate(30.0, 30.0 - (GAP_DB + FULL_GAP_DB) / 2, 0.2) == pytest.approx(0.1)
    assert dropout_rate(40.0, 20.0, 0.2) == pytest.approx(0.2)
    assert dropout_rate(float("nan"), 20.0, 0.2) == dropout_rate(30.0, float("nan"), 0.2) == 0


def test_the_image_is_the_same_on_average():
    """For faint Gaussians behind one another: the remaining ones are as much more visible as others are dropped."""
    cloud = make_cloud(300, dtype=torch.float32)
    cloud.opacity_logits[:] = -3.0
    camera = Camera("front", 32, 32, 30.0, 30.0, 16.0, 16.0, np.eye(4))
    whole = render(cloud, camera).color
    factors = [opacity_factors(len(cloud), 0.2, random_of(0, i)) for i in range(300)]
    assert {round(value, 6) for value in factors[0].tolist()} == {0.0, 1.25}
    mean = torch.stack([render(cloud, camera, kept=factor).color for factor in factors]).mean(0)
    assert (mean - whole).abs().max() < 0.02 < (render(cloud, camera, kept=factors[0]).color - whole).abs().max()
