"""Water: the formula, its gradients, the interval form it equals, kernels, extremes."""

import math

import pytest
import torch

from swag_engine.kernels.reference.transfer import to_display, to_light
from swag_engine.water.medium import Medium, open_water, through_water, without_water
from tests.engine.water_scenes import CAMERA, gain_and_gradients, make_water


def test_srgb_curves_are_inverse_and_known():
    values = torch.linspace(0, 1.2, 500, dtype=torch.float64)
    torch.testing.assert_close(to_light(to_display(values)), values)
    assert to_light(torch.tensor(0.5).double()).item() == pytest.approx(0.214041, abs=1e-6)


@pytest.mark.parametrize("shape", [(), (1,), (3,), (45, 17, 1), (45, 17, 3)])
def test_kernels_apply_gains_as_torch_does(shape):
    truth = gain_and_gradients(shape, "torch", torch.float64)
    for value, expected in zip(gain_and_gradients(shape, "cpu", torch.float32), truth, strict=True):
        torch.testing.assert_close(value, expected, atol=1e-5, rtol=1e-5)


def test_a_medium_starts_from_its_coefficients():
    beta_D, B = torch.tensor([0.3, 0.1, 0.06]), torch.tensor([0.03, 0.16, 0.22])
    medium = Medium.starting(4.0, beta_D=beta_D, beta_B=beta_D, B=B)
    torch.testing.assert_close(medium.beta_D, beta_D)
    torch.testing.assert_close(medium.beta_B, beta_D)
    for degree in (0, 2):
        water = open_water(medium, CAMERA[0].float(), CAMERA[1].float(), 22, 16, degree)
        torch.testing.assert_close(to_light(water), B.expand(16, 22, 3), atol=1e-5, rtol=0)
    default = Medium.starting(4.0)
    torch.testing.assert_close(default.beta_D * 4, torch.tensor([0.5, 0.25, 0.2]))


@pytest.mark.parametrize("light", ["linear", "srgb"])
def test_no_water_changes_nothing_and_far_colors_become_background_light(light):
    colors, offsets, medium = make_water(light=light)
    torch.testing.assert_close(through_water(colors, offsets, medium, amount=0.0), colors)
    viewmat, K = CAMERA
    middle = torch.tensor([[0.0, 0.0, 1e4]], dtype=torch.float64)
    K = torch.tensor([[20.0, 0, 0.5], [0, 20, 0.5], [0, 0, 1]], dtype=torch.float64)
    far = through_water(colors[:1], middle, medium)
    torch.testing.assert_close(far, open_water(medium, viewmat, K, 1, 1)[0])
    half = through_water(colors[:1], middle, medium, amount=0.5)
    expected = 0.5 * (to_light(far) if light == "linear" else far)
    torch.testing.assert_close(to_light(half) if light == "linear" else half, expected)


@pytest.mark.parametrize("light", ["linear", "srgb"])
def test_without_water_is_the_inverse(light):
    colors, offsets, medium = make_water(light=light)
    medium.background_sh[1:] = 0
    seen = through_water(colors, offsets, medium, 0)
    restored = without_water(seen, offsets.norm(dim=1), medium)
    torch.testing.assert_close(restored, colors)
    drowned = without_water(seen * 0 + 1, offsets.norm(dim=1) * 1e4, medium)
    assert drowned.isfinite().all() and (drowned <= 1.2).all()


@pytest.mark.parametrize("seed", range(5))
def test_it_equals_the_water_between_the_gaussians(seed):
    """WaterSplatting's form: between two Gaussians the water adds T B (exp(-beta_B s) - exp(-beta_B s'))."""
    generator = torch.Generator().manual_seed(seed)
    n, medium = 12, make_water(seed=seed, light="srgb")[2]
    s = torch.rand(n, generator=generator, dtype=torch.float64).cumsum(0)
    alpha = torch.rand(n, generator=generator, dtype=torch.float64) * 0.6
    colors = torch.rand(n, 3, generator=generator, dtype=torch.float64)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    T = torch.cat([torch.ones(1), torch.cumprod(1 - alpha, 0)]).double()
    K = torch.tensor([[20.0, 0, 0.5], [0, 20, 0.5], [0, 0, 1]], dtype=torch.float64)
    B = open_water(medium, CAMERA[0], K, 1, 1)[0, 0]
    ours = ((T[:-1] * alpha)[:, None] * through_water(colors, s[:, None] * axis, medium)).sum(0) + T[-1] * B
    ends = torch.cat([torch.zeros(1), s, torch.full((1,), math.inf)]).double()
    remains = torch.exp(-medium.beta_B * ends[:, None])
    objects = ((T[:-1] * alpha)[:, None] * colors * torch.exp(-medium.beta_D * s[:, None])).sum(0)
    between = (T[:, None] * B * (remains[:-1] - remains[1:])).sum(0)
    torch.testing.assert_close(ours, objects + between)


@pytest.mark.parametrize("light", ["linear", "srgb"])
@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("through_range", [True, False])
def test_gradients_by_finite_differences(light, degree, through_range):
    colors, offsets, medium = make_water(5, light)
    directions = torch.nn.functional.normalize(offsets, dim=1)
    ranges = offsets.norm(dim=1, keepdim=True)

    def function(colors, ranges, attenuation, backscatter, background_sh):
        places = directions * (ranges if through_range else ranges.detach())
        water = Medium(attenuation, backscatter, background_sh, medium.unit_range, light)
        seen = through_water(colors, places, water, degree)
        return torch.cat([seen.reshape(-1), open_water(water, *CAMERA, 3, 2, degree).reshape(-1)])

    inputs = [t.clone().requires_grad_() for t in (colors, ranges, *medium.parameters().values())]
    if through_range:
        assert torch.autograd.gradcheck(function, inputs, eps=1e-7, atol=1e-6)
    else:
        gradient = torch.autograd.grad(function(*inputs).sum(), inputs[1], allow_unused=True)[0]
        assert gradient is None or (gradient == 0).all()
        stopped = [inputs[0], inputs[1].detach(), *inputs[2:]]
        assert torch.autograd.gradcheck(function, stopped, eps=1e-7, atol=1e-6)


def test_the_same_bits_for_any_number_of_threads():
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            colors, offsets, medium = make_water(3000, dtype=torch.float32)
            parameters = [t.requires_grad_() for t in medium.parameters().values()]
            seen = through_water(colors, offsets, medium, backend="cpu")
            results.append([seen, *torch.autograd.grad(seen.sum(), parameters)])
    finally:
        torch.set_num_threads(before)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("light", ["linear", "srgb"])
@pytest.mark.parametrize("raw", [-200.0, 0.0, 1e4])
@pytest.mark.parametrize("range_", [0.0, 1e-20, 1.0, 1e6])
def test_extremes_stay_finite(raw, range_, light, backend):
    colors = torch.tensor([[0.0, 0.5, 1.3]], requires_grad=True)
    offsets = torch.tensor([[0.0, 0.0, range_]], requires_grad=True)
    parameters = torch.full((3,), raw), torch.full((3,), raw), torch.zeros(9, 3)
    parameters[2][0] = torch.tensor([-300.0, 0.0, 300.0])  # B = 0 and B = 1 among them
    for parameter in parameters:
        parameter.requires_grad_()
    seen = through_water(colors, offsets, Medium(*parameters, 1.0, light), backend=backend)
    assert seen.isfinite().all()
    for gradient in torch.autograd.grad(seen.sum(), [colors, offsets, *parameters]):
        assert gradient.isfinite().all()
