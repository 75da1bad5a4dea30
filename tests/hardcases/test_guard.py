"""Runs that a number threatens to poison end with a usable result, and say what happened."""

import shutil
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from clouds import make_cloud

from swag_engine.effects.scene_effects import Simulated
from swag_engine.formats.ply import read_ply
from swag_engine.settings.settings import TrainSettings
from swag_engine.training import step as iteration
from swag_engine.training import trainer as loop
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.guard import SKIPS, Guard
from swag_engine.training.optimizer import Optimizer
from swag_engine.training.schedule import LearningRates
from swag_engine.training.targets import Target

SETTINGS = TrainSettings(iterations=100, width=64, max_gaussians=500, sh_degree=1)


def finite(run: Path) -> bool:
    splats = read_ply(run / "result.ply")
    arrays = [value for value in vars(splats).values() if isinstance(value, np.ndarray)]
    return len(splats.positions) > 0 and len(arrays) >= 5 and all(np.isfinite(array).all() for array in arrays)


def poison(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """The photographs of these names have a pixel that is not a number; all have for no name."""
    clean = Target.color.fget

    def color(target: Target) -> torch.Tensor:
        pixels = clean(target)
        if not names or target.camera.name in names:
            pixels[0, 0, 0] = float("nan")
        return pixels

    monkeypatch.setattr(Target, "color", property(color))


def fast(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    rates = LearningRates(**{name: factor * rate for name, rate in asdict(LearningRates()).items()})
    monkeypatch.setattr(iteration, "LearningRates", lambda: rates)


def test_a_poisoned_photograph_is_skipped_and_named(tiny_scene, tmp_path, monkeypatch):
    poison(monkeypatch, "view_03.png")
    metrics = loop.train(tiny_scene, tmp_path / "run", SETTINGS)["metrics"]
    assert metrics["iteration"] == SETTINGS.iterations
    assert metrics["test_psnr"] > metrics["control_psnr"] + 3 and finite(tmp_path / "run")
    (note,) = metrics["notes"]
    assert "view_03.png" in note and "the loss" in note and "put back 0 times" in note


def test_learning_rates_a_hundred_times_too_high_are_eased(tiny_scene, tmp_path, monkeypatch):
    fast(monkeypatch, 100)
    metrics = loop.train(tiny_scene, tmp_path / "run", SETTINGS)["metrics"]
    assert metrics["test_psnr"] > metrics["control_psnr"] + 2 and finite(tmp_path / "run")
    (note,) = metrics["notes"]
    assert "the loss rose from" in note and "Training went on" in note


@pytest.mark.parametrize("damage", ["noise", "black", "another photograph"])
def test_a_damaged_photograph_that_can_still_be_read(tiny_scene, tmp_path, damage):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    path = scene / "images" / "view_03.png"
    pixels = cv2.imread(str(path))
    if damage == "noise":
        cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, pixels.shape, np.uint8))
    elif damage == "black":
        cv2.imwrite(str(path), np.zeros_like(pixels))
    else:
        shutil.copy(scene / "images" / "view_07.png", path)
    metrics = loop.train(scene, tmp_path / "run", SETTINGS)["metrics"]
    assert metrics["test_psnr"] > metrics["control_psnr"] + 1 and finite(tmp_path / "run")


def test_a_run_that_cannot_go_on_stops_with_the_last_good_state(tiny_scene, tmp_path, monkeypatch):
    """All photographs turn bad on the way."""
    good = {}
    step = loop.Trainer.step

    def watched(trainer: loop.Trainer) -> float:
        if trainer.iteration == 20:
            good.update(trainer.guard.good)
            poison(monkeypatch)
        return step(trainer)

    monkeypatch.setattr(loop.Trainer, "step", watched)
    result = loop.train(tiny_scene, tmp_path / "run", SETTINGS)
    metrics = result["metrics"]
    assert 20 < metrics["iteration"] < SETTINGS.iterations and not result["interrupted"]
    (note,) = metrics["notes"]
    assert f"Training stopped at iteration {metrics['iteration']}" in note and "the loss is not finite" in note
    assert metrics["test_psnr"] > metrics["control_psnr"] and finite(tmp_path / "run")
    tensors, _ = load_checkpoint(tmp_path / "run")
    assert all(torch.equal(tensors[f"cloud.{name}"], good[name]) for name in ("means", "quats", "sh0"))


def test_a_run_that_was_put_back_resumes_bit_equal(tiny_scene, tmp_path, monkeypatch):
    """Stopped before and after states are put back: the last good state and the easing are in the checkpoint."""
    fast(monkeypatch, 100)
    short = replace(SETTINGS, iterations=80)
    whole = loop.train(tiny_scene, tmp_path / "whole", short)
    assert "put back" in whole["metrics"]["notes"][0]
    for resume, iterations in ((False, 3), (True, 17), (True, 21)):
        stops = iter([False] * iterations)
        loop.train(tiny_scene, tmp_path / "run", short, resume, should_stop=lambda stops=stops: next(stops, True))
    loop.train(tiny_scene, tmp_path / "run", short, resume=True)
    (expected, _), (got, _) = load_checkpoint(tmp_path / "whole"), load_checkpoint(tmp_path / "run")
    assert expected.keys() == got.keys()
    assert all(torch.equal(tensor, got[name]) for name, tensor in expected.items())


@pytest.fixture
def optimizer():
    cloud = make_cloud(20, dtype=torch.float32)
    made = Optimizer(cloud, Simulated())
    for parameter in made.parameters().values():
        parameter.grad = torch.ones_like(parameter)
    return made


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "opacity_logits", "sh0", "background"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_is_named_with_its_gaussians(optimizer, name, value):
    guard = Guard(optimizer, 100)
    gradient = optimizer.parameters()[name].grad
    gradient[[2]] = value
    if name != "background":
        gradient[7:17] = value
    assert not guard.admits(torch.tensor(0.5), optimizer, "reef.jpg", "a")
    where = f"{name} of 11 Gaussians (number 2, 7, 8, 9, 10, ...)" if name != "background" else "background"
    assert guard.watch.finding == f"the gradient of {where} is not finite at the photograph reef.jpg"


def test_gradients_whose_sum_alone_overflows_are_admitted(optimizer):
    optimizer.cloud.means.grad[:] = 3e38
    assert Guard(optimizer, 100).admits(torch.tensor(0.5), optimizer, "a", "a")


@pytest.mark.parametrize("where", ["parameter", "moment"])
def test_a_state_that_is_not_finite_is_put_back(optimizer, where):
    guard = Guard(optimizer, 100)
    before = {name: parameter.detach().clone() for name, parameter in optimizer.parameters().items()}
    optimizer.step(dict.fromkeys(before, 0.1))
    with torch.no_grad():
        (optimizer.cloud.shN if where == "parameter" else optimizer.moments["shN"][1])[4, 1, 0] = float("inf")
    assert not guard.puts_back(optimizer, guard.every + 1)  # between two checks
    assert guard.puts_back(optimizer, guard.every)
    assert "shN" in guard.watch.finding and "of 1 Gaussians (number 4)" in guard.watch.finding and guard.ease == 0.25
    assert all(torch.equal(parameter, before[name]) for name, parameter in optimizer.parameters().items())
    assert all(parameter.requires_grad for parameter in optimizer.parameters().values())
    assert optimizer.steps == 0 and not any(moment.any() for pair in optimizer.moments.values() for moment in pair)


def test_many_skipped_steps_in_a_row_put_the_state_back(optimizer):
    guard = Guard(optimizer, 10_000)
    with torch.no_grad():
        optimizer.cloud.means += 1
    for step in range(1, SKIPS + 1):
        assert not guard.admits(torch.tensor(float("nan")), optimizer, "a", "a")
        assert guard.puts_back(optimizer, step) == (step == SKIPS)
    assert not guard.gives_up


def test_a_loss_that_another_phase_makes_larger_is_no_failure(optimizer):
    guard = Guard(optimizer, 100)
    losses = [(0.3, "a"), (0.01, "a"), (0.2, "b"), (0.9, "b")]
    for window, (loss, phase) in enumerate(losses, 1):
        for _ in range(3):
            assert guard.admits(torch.tensor(loss), optimizer, "a", phase)
        assert guard.puts_back(optimizer, window * guard.every) == (loss == 0.9)
    assert "the loss rose from 0.2 to 0.9" in guard.watch.finding


@pytest.mark.parametrize("weak_phase", ["", "first"])
def test_a_first_photograph_that_costs_little_sets_no_mark(optimizer, weak_phase):
    """An easy one, or an interpolated frame, which counts for a tenth and is not compared."""
    guard = Guard(optimizer, 250)
    for step in range(1, 11):
        weak = step % 5 == 1
        assert guard.admits(torch.tensor(0.01 if weak else 0.2), optimizer, "a", weak_phase if weak else "first")
        assert not guard.puts_back(optimizer, step), guard.watch.finding


def test_a_state_from_before_an_effect_was_dropped_can_be_put_back(optimizer):
    optimizer.restart(Guard(optimizer, 100).good | {"lamp.fall_off": torch.zeros(3)})
    assert optimizer.moments.keys() == optimizer.parameters().keys()
