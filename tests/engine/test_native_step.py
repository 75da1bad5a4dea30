"""The step of native kernels does what the step by automatic differentiation does, and only where it can."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.optimizer import EPS
from swag_engine.training.step import AutogradStep
from swag_engine.training.trainer import train
from tests.engine.cuda_fibres import cuda_backend
from tests.engine.step_scenes import (
    ALL,
    NO_BACKSCATTER,
    NONE,
    WATER,
    assert_close,
    autograd,
    exact_gradients,
    gradients,
    inputs_of_step,
    native,
    trainers,
)


@pytest.fixture(scope="module")
def make(tiny_scene, tmp_path_factory):
    return trainers(tiny_scene, tmp_path_factory)


@pytest.fixture(scope="module")
def make_on_card(tiny_scene, tmp_path_factory, request):
    with cuda_backend(request.config.cache.mkdir("cuda_fibres")):
        yield trainers(tiny_scene, tmp_path_factory, "cuda")


@pytest.fixture(params=["make", "make_on_card"])
def make_on_each(request):
    return request.getfixturevalue(request.param)


CASES: dict[str, tuple[str, str, dict[str, Any], dict[str, Any]]] = {
    "3dgs": ("3dgs", "", {}, {}),
    "water": ("swag", WATER, {}, {}),
    "water on display values": ("swag", WATER, {}, {}),
    "before the water": ("swag", WATER, {}, {"with_water": False}),
    "all effects": ("swag", ALL, {}, {}),
    "no backscatter": ("swag", NO_BACKSCATTER, {}, {}),
    "stage two": ("swag", ALL, {}, {"stage_two": True, "fraction": 0.95}),
    "dropout": ("swag", ALL, {}, {}),
    "densification of UW-GS": ("swag", WATER, {"undimmed_densification": True}, {}),
    "3DGS-MCMC": ("3dgs", "", {"densification": "mcmc"}, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_gradients_are_those_of_autograd(make_on_each, case):
    recipe, effects, changes, config_changes = CASES[case]
    trainer = make_on_each(recipe, effects)
    state = trainer.state
    state.recipe = replace(state.recipe, **changes)
    if case == "dropout":
        state.dropout = 0.3
    if case == "water on display values":
        state.effects.medium.light = "srgb"
    step = inputs_of_step(trainer, **config_changes)
    got = gradients(native(trainer), state, *step)
    expected = gradients(autograd(trainer), state, *step)
    assert got[0].loss == pytest.approx(expected[0].loss, rel=1e-5)
    assert_close(got[1], expected[1], 2e-4)
    assert ("exposure.raw" in got[1]) == (effects == ALL)


def test_gradients_are_those_of_the_float64_reference(make_on_each, monkeypatch):
    trainer = make_on_each()
    target, config = inputs_of_step(trainer)
    got = gradients(native(trainer), trainer.state, target, config)
    expected = exact_gradients(trainer, monkeypatch, target, config)
    assert got[0].loss == pytest.approx(expected[0].loss, rel=1e-5)
    assert_close(got[1], expected[1], 5e-4)


def test_200_steps_follow_those_of_autograd(make):
    trainer = make()
    states = trainer.state, trainer._copied(trainer.state)
    losses = []
    for step, state in zip((native(trainer), autograd(trainer)), states, strict=True):
        # Undamped: with damping, which both share, differences grow to .0052 of the least loss in 100 steps here.
        config, targets = replace(inputs_of_step(trainer)[1], epsilon=EPS), trainer.targets.at(state, 0.6)
        losses.append([step(state, targets[i % len(targets)], config).loss for i in range(200)])
    got, expected = map(torch.tensor, losses)
    assert expected[-8:].mean() < 0.6 * expected[:8].mean()
    # The order of sums differs, and differences grow from step to step: to .018 of the least loss in 200.
    assert (got - expected)[:100].abs().max() < 0.005 * expected.min()
    assert (got - expected).abs().max() < 0.05 * expected.min()
    first, second = (state.optimizer.parameters() for state in states)
    # The log of the lamp is near 0; what it does to light is compared, at half and at twice the median range.
    lamps = [state.effects.lamp.light(state.effects.lamp.unit_range * torch.tensor([0.5, 2.0])) for state in states]
    assert ((lamps[0] - lamps[1]).abs() <= 0.01 * lamps[1]).all()
    for name in first.keys() - {"lamp.log_tau"}:
        assert (first[name] - second[name]).norm() <= 0.1 * second[name].norm().clamp(min=0.1), name


@pytest.mark.parametrize(("effects", "name"), [(NONE, "background"), (ALL, "opacity_logits"), (ALL, "exposure.raw")])
def test_a_step_that_is_not_finite_changes_nothing(make_on_each, effects, name):
    trainer = make_on_each(effects=effects)
    state = trainer.state
    with torch.no_grad():
        state.optimizer.parameters()[name][0] = torch.nan
    before = {name: p.detach().clone() for name, p in state.optimizer.parameters().items()}
    moments = {name: value.clone() for name, value in state.optimizer.state_tensors().items()}
    result = native(trainer)(state, *inputs_of_step(trainer))
    assert "not finite" in result.problem
    for name, parameter in state.optimizer.parameters().items():
        assert parameter.grad is None and torch.equal(parameter.nan_to_num(9), before[name].nan_to_num(9)), name
    assert all(torch.equal(value, moments[name]) for name, value in state.optimizer.state_tensors().items())


def test_steps_are_equal_to_the_bit_for_any_number_of_threads(make):
    trainer = make()
    step = native(trainer)
    target, config = inputs_of_step(trainer)
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 1, 2, 3):
            torch.set_num_threads(count)
            state = trainer._copied(trainer.state)
            for _ in range(3):
                result = step(state, target, config)
            parameters = [parameter.detach() for parameter in state.optimizer.parameters().values()]
            results.append([result.means2d_gradient.clone(), *parameters])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_a_run_that_was_stopped_resumes_bit_equal(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.delattr(AutogradStep, "__call__")  # all steps are native
    settings = TrainSettings(iterations=30, width=48, max_gaussians=400, sh_degree=1, effects=ALL)
    train(tiny_scene, tmp_path / "whole", settings)
    asked = iter(range(10**9))
    train(tiny_scene, tmp_path / "parts", settings, should_stop=lambda: next(asked) >= 17)
    train(tiny_scene, tmp_path / "parts", settings, resume=True)
    expected, got = (load_checkpoint(tmp_path / name)[0] for name in ("whole", "parts"))
    assert expected.keys() == got.keys() and all(torch.equal(expected[name], got[name]) for name in expected)


@pytest.mark.parametrize(
    ("recipe", "effects", "changes", "expected"),
    [
        ("3dgs", "", {}, True),
        ("swag", ALL, {}, True),
        ("swag", ALL.replace("caustics=off", "caustics=on"), {}, False),
        ("seasplat", "", {}, False),
        ("watersplatting", "", {}, False),
        ("swag", ALL, {"weight": 0.5}, False),
        ("swag", ALL, {"emphasis": torch.ones(48, 64)}, False),
    ],
)
def test_other_steps_are_left_to_autograd(make, recipe, effects, changes, expected):
    trainer = make(recipe, effects)
    target, config = inputs_of_step(trainer)
    target = replace(target, **changes)
    if expected:
        assert not native(trainer)(trainer.state, target, config).problem
        trainer.state.recipe = replace(trainer.state.recipe, open_water=0.1)
    with pytest.raises(NotImplementedError):
        native(trainer)(trainer.state, target, config)
