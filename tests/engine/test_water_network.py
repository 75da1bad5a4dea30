"""The water as a network: what it computes, its gradients, extremes, and the range it implies."""

import json

import numpy as np
import pytest
import torch

from swag_engine.water.network import WaterNetwork, encoded

UNIT = 2.5


def make(n=30, dtype=torch.float64, seed=0):
    """Colors (n, 3), offsets (n, 3) and a network far from its start, so that nothing is nearly linear."""
    random = torch.Generator().manual_seed(seed)
    colors = torch.rand(n, 3, generator=random, dtype=torch.float64).to(dtype)
    offsets = (2 * torch.randn(n, 3, generator=random, dtype=torch.float64)).to(dtype)
    network = WaterNetwork.starting(UNIT, seed)
    weights, attenuation, backscatter = (t.to(dtype) for t in network.parameters().values())
    weights = weights + 0.05 * torch.randn(len(weights), generator=random).to(dtype)
    return colors, offsets, WaterNetwork(weights, attenuation, backscatter, UNIT)


def test_the_layers_are_those_of_the_paper():
    sizes = [70, 128, 64, 32, 16, 8]
    layers = sum(a * b + b + 1 for a, b in zip(sizes[:-1], sizes[1:], strict=True)) + 2 * (8 * 3 + 3)
    assert WaterNetwork.starting(UNIT, 0).weights.shape == (layers,)
    direction, range_ = torch.tensor([[0.6, 0.0, 0.8]]), torch.tensor([[1.5]])
    assert encoded(direction, 10).shape == (1, 63) and encoded(range_, 3).shape == (1, 7)
    expected = [1.5, *np.sin(np.pi * 1.5 * np.array([1, 2, 4])), *np.cos(np.pi * 1.5 * np.array([1, 2, 4]))]
    np.testing.assert_allclose(encoded(range_, 3)[0], expected, atol=1e-5)


def test_it_equals_the_same_network_in_torch_modules():
    """The one long tensor of weights is cut as the docstring says."""
    colors, offsets, network = make()
    modules: list[torch.nn.Module] = []
    start = 0
    for inputs, outputs in [(70, 128), (128, 64), (64, 32), (32, 16), (16, 8), (8, 6)]:
        linear = torch.nn.Linear(inputs, outputs).double()
        for parameter in (linear.weight, linear.bias):
            parameter.data = network.weights[start : start + parameter.numel()].view_as(parameter)
            start += parameter.numel()
        modules.append(linear)
        if outputs != 6:
            prelu = torch.nn.PReLU().double()
            prelu.weight.data = network.weights[start : start + 1]
            start += 1
            modules.append(prelu)
    assert start == len(network.weights)
    ranges = offsets.norm(dim=1, keepdim=True)
    heads = torch.nn.Sequential(*modules)(torch.cat([encoded(offsets / ranges, 10), encoded(ranges / UNIT, 3)], 1))
    T, B = heads.sigmoid().split(3, 1)
    torch.testing.assert_close(network.through(colors, offsets), colors * T + B)
    torch.testing.assert_close(network.through(colors, offsets, 0.3), colors * T**0.3 + 0.3 * B)
    torch.testing.assert_close(network.through(colors, offsets, 0.0), colors)
    torch.testing.assert_close(network.transmission(offsets), T)
    by_loss, by_gain = -T.log() / network.beta_D - ranges, -(1 - B).log() / network.beta_B - ranges
    expected = (by_loss.abs().mean() + by_gain.abs().mean()) / UNIT
    torch.testing.assert_close(network.range_consistency(offsets), expected)


def test_it_starts_as_a_little_water_and_seeded():
    colors, offsets, _ = make(200, torch.float32)
    first, again, other = (WaterNetwork.starting(UNIT, seed) for seed in (3, 3, 4))
    assert torch.equal(first.weights, again.weights) and not torch.equal(first.weights, other.weights)
    for seed in range(5):
        network = WaterNetwork.starting(UNIT, seed)
        T, B = network.logits(offsets).sigmoid().split(3, dim=1)
        assert (T.mean() - 0.9).abs() < 0.05 and (B.mean() - 0.05).abs() < 0.05
    torch.testing.assert_close(first.beta_D * UNIT, torch.tensor([0.5, 0.25, 0.2]))
    torch.testing.assert_close(first.beta_B * UNIT, torch.full((3,), 0.3))


@pytest.mark.parametrize("amount", [1.0, 0.4])
def test_gradients_by_finite_differences(amount):
    colors, offsets, network = make(3)
    directions, ranges = torch.nn.functional.normalize(offsets, dim=1), offsets.norm(dim=1, keepdim=True)
    # All weights at once would be thousands of differences: along random directions instead.
    random = torch.Generator().manual_seed(1)
    ways = torch.randn(len(network.weights), 6, generator=random, dtype=torch.float64) / 30

    def function(colors, ranges, along, attenuation, backscatter):
        water = WaterNetwork(network.weights + ways @ along, attenuation, backscatter, UNIT)
        places = directions * ranges
        return torch.cat([water.through(colors, places, amount).reshape(-1), water.range_consistency(places)[None]])

    inputs = [colors, ranges, torch.zeros(6, dtype=torch.float64), network.attenuation, network.backscatter]
    assert torch.autograd.gradcheck(function, [t.clone().requires_grad_() for t in inputs], eps=1e-7, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("raw", [0.0, 1e3, -1e3])
def test_finite_at_any_range_and_when_saturated(dtype, raw):
    colors, offsets, network = make(6, dtype)
    scale = torch.tensor([0, 1e-12, 1e-3, 1, 100, 1e4], dtype=dtype)[:, None]
    offsets = torch.nn.functional.normalize(offsets, dim=1) * scale * UNIT
    network.weights[-6:] += raw
    leaves = [t.requires_grad_() for t in (colors, offsets, *network.parameters().values())]
    for amount in (0.0, 0.5, 1.0):
        seen, consistency = network.through(colors, offsets, amount), network.range_consistency(offsets)
        assert seen.isfinite().all() and consistency.isfinite()
        assert (seen >= 0).all() and (seen <= colors + 1).all()
        for gradient in torch.autograd.grad(seen.sum() + consistency, leaves):
            assert gradient.isfinite().all()


def test_it_learns_the_range_that_its_transmission_implies():
    """With T = exp(-beta_D r) as the truth, L_ca falls, and T with it, to what the coefficients say."""
    _, offsets, network = make(400, torch.float32)
    network = WaterNetwork.starting(UNIT, 0)
    first = network.range_consistency(offsets).item()
    leaves = [t.requires_grad_() for t in network.parameters().values()]
    optimizer = torch.optim.Adam(leaves, lr=2e-3)
    for _ in range(150):
        optimizer.zero_grad()
        network.range_consistency(offsets).backward()
        optimizer.step()
    assert network.range_consistency(offsets).item() < 0.4 * first
    near, far = (network.transmission(offsets * s).mean() for s in (0.2, 1.0))
    assert near > far + 0.1


def test_json_has_what_a_compositor_needs():
    network = make(dtype=torch.float32)[2]
    told = json.loads(json.dumps(network.to_json()))
    assert told["light"] == "srgb" and told["per"] == "unit"
    np.testing.assert_allclose(told["beta_D"], network.beta_D, atol=1e-6)
    assert len(told["ranges"]) == len(told["transmission"]) == len(told["backscatter"])
    assert told["ranges"][0] == 0 and told["ranges"][-1] == 3 * UNIT
    metric = network.to_json(2.0)
    assert metric["per"] == "metre" and metric["ranges"][-1] == 6 * UNIT
    np.testing.assert_allclose(metric["beta_D"], network.beta_D / 2, atol=1e-6)
    values = np.array([told["transmission"], told["backscatter"]])
    assert values.shape[2] == 3 and (values > 0).all() and (values < 1).all()
