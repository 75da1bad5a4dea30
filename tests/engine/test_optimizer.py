"""Adam: the torch path against torch.optim, the kernel against it in float64."""

import pytest
import torch

from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.training.optimizer import Optimizer, adam_step
from tests.scenes.clouds import make_cloud


def trajectory(dtype, backend, steps=5):
    generator = torch.Generator().manual_seed(0)
    parameter = torch.randn(40, 5, 3, generator=generator, dtype=torch.float64).to(dtype)
    mean, square = torch.zeros_like(parameter), torch.zeros_like(parameter)
    for step in range(1, steps + 1):
        gradient = torch.randn(40, 5, 3, generator=generator, dtype=torch.float64).to(dtype)
        adam_step(parameter, gradient, mean, square, 0.1, step, backend)
    return parameter, mean, square


def test_it_is_adam():
    generator = torch.Generator().manual_seed(0)
    parameter = torch.randn(40, 5, 3, generator=generator, dtype=torch.float64).requires_grad_()
    adam = torch.optim.Adam([parameter], lr=0.1, eps=1e-15)
    for _ in range(5):
        parameter.grad = torch.randn(40, 5, 3, generator=generator, dtype=torch.float64)
        adam.step()
    torch.testing.assert_close(trajectory(torch.float64, "torch")[0], parameter.detach())


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_a_step_of_an_empty_parameter_leaves_all_tensors_empty(backend):
    tensors = torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 3)
    adam_step(*tensors, 0.1, 1, backend)
    assert all(torch.equal(tensor, torch.zeros(0, 3)) for tensor in tensors)


def test_what_images_hardly_show_moves_less_and_everything_else_as_before():
    """Steps by gradients of a thousandth of epsilon, and of a thousand times it."""
    gradient = {"sh0": 1e-8, "means": 1e-11, "opacity_logits": 1e-5}
    cloud = make_cloud(4, dtype=torch.float32)
    before = {name: getattr(cloud, name).detach().clone() for name in gradient}
    optimizer = Optimizer(cloud, SceneEffects())
    for name, value in gradient.items():
        getattr(cloud, name).grad = torch.full_like(before[name], value)
    optimizer.step(dict.fromkeys(gradient, 0.1), epsilon=1e-5)
    moved = {name: (before[name] - getattr(cloud, name)).detach().abs().max().item() for name in gradient}
    assert moved["sh0"] < 1e-3 * 0.1
    assert moved["means"] == pytest.approx(0.1, rel=1e-3)
    assert moved["opacity_logits"] == pytest.approx(0.05, rel=1e-3)
