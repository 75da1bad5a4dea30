"""Runs with values that are not finite, or with a rising loss, end with a usable result and a note."""

import shutil
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.formats.ply import read_ply
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.guard import MOST_SKIPPED, Guard, GuardedState, step_problem
from swag_engine.training.optimizer import Optimizer
from swag_engine.training.schedule import LearningRates, Schedule
from swag_engine.training.trainer import Trainer, train
from tests.scenes.clouds import make_cloud
from tests.scenes.runs import train_with

SETTINGS = TrainSettings(iterations=100, width=64, max_gaussians=500, sh_degree=1)


def finite(run: Path) -> bool:
    splats = read_ply(run / "result.ply")
    arrays = [value for value in vars(splats).values() if isinstance(value, np.ndarray)]
    return len(splats.positions) > 0 and len(arrays) >= 5 and all(np.isfinite(array).all() for array in arrays)


def break_loss(trainer: Trainer, *names: str) -> None:
    """Give the targets of these images, or all targets without names, a loss that is NaN."""
    step = trainer.step

    def broken(state, target, config):
        if names and target.camera.name not in names:
            return step(state, target, config)
        weight = torch.ones(target.valid.shape)
        weight[0, 0] = float("nan")
        return step(state, replace(target, emphasis=weight), config)

    trainer.step = broken


def fast(factor: float) -> Schedule:
    """A schedule with learning rates larger by a factor."""
    rates = asdict(LearningRates())
    return Schedule(learning_rates=LearningRates(**{name: factor * rate for name, rate in rates.items()}))


def test_an_image_with_a_loss_that_is_not_a_number_is_skipped_and_named(tiny_scene, tmp_path):
    result = train_with(tiny_scene, tmp_path / "run", SETTINGS, lambda trainer: break_loss(trainer, "view_03.png"))
    metrics = result["metrics"]
    assert metrics["iteration"] == SETTINGS.iterations
    assert metrics["test_psnr"] > metrics["control_psnr"] + 3 and finite(tmp_path / "run")
    (note,) = metrics["notes"]
    assert "view_03.png" in note and "the loss" in note and "rolled back 0 times" in note


def test_learning_rates_a_hundred_times_too_high_are_reduced(tiny_scene, tmp_path):
    metrics = train_with(tiny_scene, tmp_path / "run", SETTINGS, schedule=fast(100))["metrics"]
    assert metrics["test_psnr"] > metrics["control_psnr"] + 2 and finite(tmp_path / "run")
    (note,) = metrics["notes"]
    assert "the loss rose from" in note and "Training continued" in note


@pytest.mark.parametrize("damage", ["noise", "black", "another image"])
def test_a_damaged_image_that_can_still_be_read(tiny_scene, tmp_path, damage):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    path = scene / "images" / "view_03.png"
    pixels = cv2.imread(str(path))
    if damage == "noise":
        cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, pixels.shape, np.uint8))
    elif damage == "black":
        cv2.imwrite(str(path), np.zeros_like(pixels))
    else:
        shutil.copy(scene / "images" / "view_07.png", path)
    metrics = train(scene, tmp_path / "run", SETTINGS)["metrics"]
    assert metrics["test_psnr"] > metrics["control_psnr"] + 1 and finite(tmp_path / "run")


def test_a_run_that_cannot_continue_stops_with_the_last_good_parameters(tiny_scene, tmp_path):
    """All images turn bad at iteration 20."""
    good: dict[str, torch.Tensor] = {}

    def turn_bad(trainer: Trainer) -> None:
        step = trainer.step

        def watched(state, target, config):
            if state.iteration == 20 and not good:
                good.update(state.guarded.last_good)
                trainer.step = step
                break_loss(trainer)
                return trainer.step(state, target, config)
            return step(state, target, config)

        trainer.step = watched

    result = train_with(tiny_scene, tmp_path / "run", SETTINGS, turn_bad)
    metrics = result["metrics"]
    assert 20 < metrics["iteration"] < SETTINGS.iterations and not result["interrupted"]
    (note,) = metrics["notes"]
    assert f"Training stopped at iteration {metrics['iteration']}" in note and "the loss is not finite" in note
    assert metrics["test_psnr"] > metrics["control_psnr"] and finite(tmp_path / "run")
    tensors, _ = load_checkpoint(tmp_path / "run")
    assert all(torch.equal(tensors[f"cloud.{name}"], good[name]) for name in ("means", "quats", "sh0"))


def test_a_run_that_was_rolled_back_resumes_bit_equal(tiny_scene, tmp_path):
    """Stopped before and after rollbacks: last good parameters and the rate factor are in the checkpoint."""
    schedule, short = fast(100), replace(SETTINGS, iterations=80)
    whole = train_with(tiny_scene, tmp_path / "whole", short, schedule=schedule)
    assert "rolled back" in whole["metrics"]["notes"][0]
    for resume, iterations in ((False, 3), (True, 17), (True, 21)):
        stops = iter([False] * iterations)
        train_with(
            tiny_scene, tmp_path / "run", short, resume=resume, schedule=schedule,
            should_stop=partial(next, stops, True),
        )  # fmt: skip
    train_with(tiny_scene, tmp_path / "run", short, resume=True, schedule=schedule)
    (expected, _), (got, _) = load_checkpoint(tmp_path / "whole"), load_checkpoint(tmp_path / "run")
    assert expected.keys() == got.keys()
    assert all(torch.equal(tensor, got[name]) for name, tensor in expected.items())


@pytest.fixture
def optimizer():
    cloud = make_cloud(20, dtype=torch.float32)
    made = Optimizer(cloud, SceneEffects())
    for parameter in made.parameters().values():
        parameter.grad = torch.ones_like(parameter)
    return made


@pytest.fixture
def guarded(optimizer):
    state = GuardedState()
    state.keep(optimizer)
    return state


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "opacity_logits", "sh0", "background"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_is_named_with_its_gaussians(optimizer, guarded, name, value):
    gradient = optimizer.parameters()[name].grad
    gradient[[2]] = value
    if name != "background":
        gradient[7:17] = value
    loss, problem = step_problem(torch.tensor(0.5), optimizer.parameters())
    guarded.record_step(loss, problem, "reef.jpg", "a")
    where = f"{name} of 11 Gaussians (number 2, 7, 8, 9, 10, ...)" if name != "background" else "background"
    assert guarded.record.finding == f"the gradient of {where} is not finite at the image reef.jpg"
    assert guarded.record.skipped == 1


def test_gradients_whose_sum_alone_overflows_are_accepted(optimizer):
    optimizer.cloud.means.grad[:] = 3e38
    assert step_problem(torch.tensor(0.5), optimizer.parameters()) == (0.5, "")


@pytest.mark.parametrize("where", ["parameter", "moment"])
def test_parameters_that_are_not_finite_are_rolled_back(optimizer, guarded, where):
    guard = Guard(100)
    before = {name: parameter.detach().clone() for name, parameter in optimizer.parameters().items()}
    optimizer.step(dict.fromkeys(before, 0.1))
    with torch.no_grad():
        (optimizer.cloud.shN if where == "parameter" else optimizer.moments["shN"][1])[4, 1, 0] = float("inf")
    assert not guard.roll_back_if_bad(guarded, optimizer, guard.interval + 1)  # between two checks
    assert guard.roll_back_if_bad(guarded, optimizer, guard.interval)
    record = guarded.record
    assert "shN" in record.finding and "of 1 Gaussians (number 4)" in record.finding and record.rate_factor == 0.25
    assert all(torch.equal(parameter, before[name]) for name, parameter in optimizer.parameters().items())
    assert all(parameter.requires_grad for parameter in optimizer.parameters().values())
    assert optimizer.steps == 0 and not any(moment.any() for pair in optimizer.moments.values() for moment in pair)


def test_many_skipped_steps_in_a_row_roll_the_parameters_back(optimizer, guarded):
    guard = Guard(10_000)
    with torch.no_grad():
        optimizer.cloud.means += 1
    for step in range(1, MOST_SKIPPED + 1):
        guarded.record_step(float("nan"), "the loss is not finite", "a", "a")
        assert guard.roll_back_if_bad(guarded, optimizer, step) == (step == MOST_SKIPPED)
    assert not guarded.training_failed


def test_a_loss_that_another_phase_makes_larger_is_no_failure(optimizer, guarded):
    guard = Guard(100)
    losses = [(0.3, "a"), (0.01, "a"), (0.2, "b"), (0.9, "b")]
    for window, (loss, phase) in enumerate(losses, 1):
        for _ in range(3):
            guarded.record_step(loss, "", "a", phase)
        assert guard.roll_back_if_bad(guarded, optimizer, window * guard.interval) == (loss == 0.9)
    assert "the loss rose from 0.2 to 0.9" in guarded.record.finding


@pytest.mark.parametrize("weak_phase", ["", "first"])
def test_a_first_image_of_small_loss_sets_no_limit(optimizer, guarded, weak_phase):
    """An easy image, or an interpolated frame, whose loss is weighted by a tenth and not compared."""
    guard = Guard(250)
    for step in range(1, 11):
        weak = step % 5 == 1
        guarded.record_step(0.01 if weak else 0.2, "", "a", weak_phase if weak else "first")
        assert not guard.roll_back_if_bad(guarded, optimizer, step), guarded.record.finding


def test_parameters_from_before_an_effect_was_dropped_can_be_rolled_back_to(optimizer, guarded):
    optimizer.restart(guarded.last_good | {"lamp.fall_off": torch.zeros(3)})
    assert optimizer.moments.keys() == optimizer.parameters().keys()
