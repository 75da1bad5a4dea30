"""Adam: the torch path against torch.optim, the kernel against it in float64."""

import pytest
import torch

from swag_engine.training.optimizer import adam_step


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
