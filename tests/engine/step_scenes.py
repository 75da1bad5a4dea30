"""Trainers in the middle of a run, and what their steps give."""

import time
from copy import deepcopy
from dataclasses import replace
from functools import cache
from typing import Any

import torch

from swag_engine.formats.run_folder import RunFolder
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.native_step import NativeStep
from swag_engine.training.step import AutogradStep
from swag_engine.training.targets import Target
from swag_engine.training.trainer import make_trainer

NONE = "water=off,lamp=off,beam=off,exposure=off,vignetting=off,caustics=off,moving_objects=off,depth_prior=off"
WATER = NONE.replace("water=off", "attenuation=on,backscatter=on,separate_backscatter=on")
ALL = WATER.replace("lamp=off,beam=off,exposure=off,vignetting=off", "lamp=on,beam=on,exposure=on,vignetting=on")
NO_BACKSCATTER = NONE.replace("water=off", "attenuation=on").replace("lamp=off", "lamp=on")


def trainers(tiny_scene, tmp_path_factory, backend="cpu"):
    """Return what makes a trainer of a recipe and effects; effects and Gaussians have left their initial values.

    On fibres, which are slow, only the steps are made by the backend "cuda".
    """

    @cache
    def start(recipe, effects):
        settings = TrainSettings(iterations=400, width=64, max_gaussians=600, recipe=recipe, effects=effects)
        settings = replace(settings, backend="auto" if backend == "cuda" else backend)
        run = RunFolder(tmp_path_factory.mktemp("run"))
        trainer = make_trainer(run, tiny_scene, settings, False, lambda event: None, None, time.monotonic())
        trainer.inputs = trainer.selection.inputs = replace(trainer.inputs, settings=replace(settings, backend=backend))
        trainer.selection.to_try = []
        random = torch.Generator().manual_seed(3)
        with torch.no_grad():
            for parameter in trainer.state.optimizer.parameters().values():
                parameter += 0.1 * torch.randn(parameter.shape, generator=random).to(parameter)
        return trainer, trainer.state

    def copied(recipe="swag", effects=ALL):
        trainer, state = start(recipe, effects)
        trainer.state = trainer._copied(state)
        return trainer

    return copied


class Refusing(AutogradStep):
    def __call__(self, state: Any, target: Any, config: Any) -> Any:
        raise NotImplementedError


def native(trainer):
    """Return the step, which fails where it is left to autograd."""
    return NativeStep(trainer.inputs, trainer.selection, Refusing(trainer.inputs, trainer.selection, None))


def autograd(trainer):
    return AutogradStep(trainer.inputs, trainer.selection, None)


def inputs_of_step(trainer, **changes):
    """Return a target, part of which is not valid, and what the schedule says in the middle of the run."""
    target = deepcopy(trainer.targets.at(trainer.state, 0.6)[0])
    target.valid[:9, :13] = False
    config = replace(trainer.step_config(), fraction=0.6, sh_degree=2, water_degree=2, with_water=True)
    return target, replace(config, **changes)


def gradients(step, state, target, config):
    """Return the result of a step without its update, and the gradients by parameter name."""
    found = {}

    def keep(rates, epsilon):
        found.update({name: p.grad.clone() for name, p in state.optimizer.parameters().items() if p.grad is not None})
        state.optimizer.clear_gradients()

    state.optimizer.step = keep
    result = step(state, target, config)
    del state.optimizer.step
    assert not result.problem
    return result, found | {"means2d": result.means2d_gradient.clone(), "radii": result.radii.clone()}


def assert_close(got, expected, tolerance):
    assert got.keys() == expected.keys()
    for name, value in expected.items():
        error = float((got[name] - value).norm() / value.norm().clamp(min=1e-12))
        assert error < tolerance, (name, error)


class DoubleTarget(Target):
    @property
    def color(self):
        return super().color.double()


def exact_gradients(trainer, monkeypatch, target, config):
    """Return what `gradients` does of a step in float64 with the backend torch, which the trainer has from then on."""
    for owner in (trainer.state.cloud, *trainer.state.effects.models.values()):
        for name, value in owner.parameters().items():
            setattr(owner, name, value.detach().double().requires_grad_())
    reference = replace(trainer.inputs, settings=replace(trainer.inputs.settings, backend="torch"))
    monkeypatch.setattr(trainer, "inputs", reference)
    monkeypatch.setattr(trainer.selection, "inputs", reference)
    exact = DoubleTarget(target.camera, target.pixels, target.valid, surface=target.surface)
    return gradients(autograd(trainer), trainer.state, exact, config)
