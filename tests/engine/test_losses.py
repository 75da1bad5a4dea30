"""Losses: the compiled path, the torch path, and a direct computation of the same."""

import numpy as np
import pytest
import torch

from swag_engine.base.timing import Ledger
from swag_engine.evaluation.ssim import ssim
from swag_engine.training.losses import (
    CLOSED,
    attenuation_order,
    grey_world,
    photometric,
    smoothness,
    uncovered_pixels,
    uncovered_surface,
)

SIZES = [(1, 1), (4, 7), (11, 11), (23, 41), (9, 330)]  # the last one is wider than a block of the kernel


def images(height, width, seed=0):
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    return (target + 0.2 * noise).float().double(), target.float().double()


def direct_ssim(image, target):
    """Mean SSIM from the definition: an 11 x 11 window moved over the zero-padded images."""
    offsets = torch.arange(11, dtype=torch.float64) - 5
    window = torch.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[None, None]

    def blur(x):
        return torch.nn.functional.conv2d(x.permute(2, 0, 1)[:, None], window, padding=5)

    mu_a, mu_b = blur(image), blur(target)
    var_a, var_b = blur(image * image) - mu_a**2, blur(target * target) - mu_b**2
    covariance = blur(image * target) - mu_a * mu_b
    top = (2 * mu_a * mu_b + 0.01**2) * (2 * covariance + 0.03**2)
    return (top / ((mu_a**2 + mu_b**2 + 0.01**2) * (var_a + var_b + 0.03**2))).mean()


def value_and_gradient(loss, image):
    image = image.clone().requires_grad_()
    value = loss(image)
    value.backward()
    return value.item(), image.grad.double()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("size", SIZES)
def test_ssim_equals_the_direct_computation(size, dtype):
    image, target = images(*size)
    expected, expected_gradient = value_and_gradient(lambda x: direct_ssim(x, target), image)
    value, gradient = value_and_gradient(lambda x: ssim(x, target.to(dtype)), image.to(dtype))
    tolerance = 1e-12 if dtype == torch.float64 else 3e-6
    assert abs(value - expected) < tolerance
    assert (gradient - expected_gradient).abs().max() < tolerance * expected_gradient.abs().max()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_l1_and_ssim_are_weighted(dtype):
    image, target = images(20, 30)

    def expected_loss(x):
        return 0.7 * (x - target).abs().mean() + 0.3 * (1 - direct_ssim(x, target))

    expected, expected_gradient = value_and_gradient(expected_loss, image)
    value, gradient = value_and_gradient(lambda x: photometric(x, target.to(dtype), None, 0.7, 0.3), image.to(dtype))
    assert abs(value - expected) < 1e-6
    assert (gradient - expected_gradient).abs().max() < 1e-5 * expected_gradient.abs().max()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_invalid_pixels_change_nothing(dtype):
    image, target = (x.to(dtype) for x in images(20, 30))
    valid = torch.rand(20, 30, generator=torch.Generator().manual_seed(3)) > 0.3
    other = torch.where(valid[..., None], image, torch.full_like(image, float("nan")))
    first = value_and_gradient(lambda x: photometric(x, target, valid), image)
    second = value_and_gradient(lambda x: photometric(x, target, valid), other)
    assert first[0] == second[0]
    assert torch.equal(first[1], second[1])
    assert (first[1][~valid] == 0).all() and (first[1][valid] != 0).any()
    assert first[0] < photometric(image, target, None).item()
    assert photometric(image, target, torch.zeros_like(valid)).item() == pytest.approx(0, abs=1e-6)


def test_perfect_and_constant_images_are_finite():
    black = torch.zeros(16, 16, 3)
    for image in (black, black + 1):
        value, gradient = value_and_gradient(lambda x, target=image: photometric(x, target, None), image)
        assert value == pytest.approx(0, abs=1e-6) and gradient.isfinite().all()


def test_same_bits_for_any_number_of_threads():
    image, target = (x.float() for x in images(45, 70))
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(value_and_gradient(lambda x: photometric(x, target, None), image))
    finally:
        torch.set_num_threads(before)
    assert all(r[0] == results[0][0] and torch.equal(r[1], results[0][1]) for r in results)


def test_torch_path_agrees_with_the_kernels():
    image, target = (x.float() for x in images(45, 70))
    expected = value_and_gradient(lambda x: photometric(x, target, None, backend="cpu"), image)
    value, gradient = value_and_gradient(lambda x: photometric(x, target, None, backend="torch"), image)
    assert value == pytest.approx(expected[0], rel=1e-5)
    np.testing.assert_allclose(gradient, expected[1], atol=1e-5 * expected[1].abs().max().item())


def test_other_shapes_are_refused():
    with pytest.raises(ValueError, match="H, W, 3"):
        ssim(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))
    with pytest.raises(ValueError, match="H, W, 3"):
        ssim(torch.zeros(4, 4, 1), torch.zeros(4, 4, 1))


# Weights and priors of underwater scenes -----------------------------------------------------------------------------


@pytest.mark.parametrize("relative", [False, True])
def test_square_error_and_relative_residuals_are_those_of_the_definition(relative):
    image, target = images(20, 30)
    image = image.clamp(min=0.01)

    def expected_loss(x):
        error = (x - target) / (image + 1e-3 if relative else 1)
        return 0.3 * error.abs().mean() + 0.1 * (1 - direct_ssim(x, target)) + 0.5 * error.square().mean()

    expected, expected_gradient = value_and_gradient(expected_loss, image)
    value, gradient = value_and_gradient(
        lambda x: photometric(x, target.float(), None, 0.3, 0.1, 0.5, relative), image.float()
    )
    assert value == pytest.approx(expected, rel=1e-5)
    assert (gradient - expected_gradient).abs().max() < 1e-5 * expected_gradient.abs().max()


def test_ssim_without_weight_is_not_computed():
    image, target = (x.float() for x in images(20, 30))
    expected = 0.05 * (image - target).abs().mean() + 0.9 * (image - target).square().mean()
    for weight, computed in ((0.0, False), (0.2, True)):
        ledger = Ledger()
        with ledger.iteration():
            value = photometric(image, target, None, 0.05, weight, 0.9).item()
        assert ("loss L1 and SSIM" in ledger.seconds) == computed
        assert computed or value == pytest.approx(expected.item(), rel=1e-6)


def test_grey_world_is_zero_for_grey_and_reduces_a_color_cast():
    alpha = torch.ones(6, 5, dtype=torch.float64)
    grey = torch.rand(6, 5, 1, dtype=torch.float64).expand(-1, -1, 3)
    assert grey_world(grey, alpha).item() == pytest.approx(0, abs=1e-12)
    cast = grey * torch.tensor([0.5, 1.0, 1.2], dtype=torch.float64)
    value, gradient = value_and_gradient(lambda x: grey_world(x, alpha), cast)
    means = cast.mean((0, 1))
    assert value == pytest.approx(((means / means.mean() - 1) ** 2).mean().item())
    assert (gradient[..., 0] < 0).all() and (gradient[..., 2] > 0).all()
    middle = grey_world(cast, alpha, "middle")
    assert middle.item() == pytest.approx(((means - 0.5) ** 2).sum().item())


def test_grey_world_counts_covered_pixels_only():
    picture = torch.rand(6, 5, 3, dtype=torch.float64)
    alpha = torch.zeros(6, 5, dtype=torch.float64)
    value, gradient = value_and_gradient(lambda x: grey_world(x, alpha), picture)
    assert value == 0 and (gradient == 0).all()
    alpha[2] = 0.9
    _, gradient = value_and_gradient(lambda x: grey_world(x, alpha), picture)
    assert (gradient[2] != 0).all() and (gradient[[0, 1, 3, 4, 5]] == 0).all()
    black = torch.zeros(6, 5, 3, dtype=torch.float64)
    value, gradient = value_and_gradient(lambda x: grey_world(x, alpha), black)
    assert np.isfinite(value) and gradient.isfinite().all()


def test_smoothness_is_weighted_down_at_edges_of_the_image():
    alpha = torch.ones(4, 6, dtype=torch.float64)
    step = torch.ones(4, 6, dtype=torch.float64)
    step[:, 3:] = 3
    flat, edge = torch.zeros(4, 6, 3, dtype=torch.float64), torch.zeros(4, 6, 3, dtype=torch.float64)
    edge[:, 3:] = 1
    pairs = 3 * 6 + 4 * 5
    assert smoothness(step, alpha, flat, 2.0).item() == pytest.approx(4 * 2 / 2.0 / pairs)
    assert smoothness(step, alpha, edge, 2.0).item() == pytest.approx(4 * 2 / 2.0 * np.exp(-5) / pairs)
    alpha[:, 3:] = 0.2
    assert smoothness(step, alpha, flat, 2.0).item() == 0
    x = step.clone().requires_grad_()
    guide = torch.rand(4, 6, 3, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda r: smoothness(r + 0.1 * torch.arange(24.0).view(4, 6), torch.ones_like(r), guide, 2.0), x
    )


def test_attenuation_out_of_order_is_penalised_by_channel():
    beta = torch.tensor([0.3, 0.1, 0.05])
    assert attenuation_order(beta, (0, 1, 2)).item() == 0
    assert attenuation_order(beta, (2, 1, 0)).item() == pytest.approx(0.2 + 0.05 + 2e-3)


def test_surfaces_are_pushed_to_be_opaque_and_open_water_is_not():
    behind = torch.tensor([0.1, 0.4, 0.5]).expand(1, 5, 3)
    target = behind.clone()
    target[0, 1, 0], target[0, 2, 1], target[0, 3:] = 0.14, 0.3, 0.9  # haze, half way, surfaces: open and closed
    valid = torch.ones(1, 5, dtype=torch.bool)
    value, gradient = value_and_gradient(
        lambda alpha: uncovered_surface(alpha, target, behind, valid), torch.tensor([[0.2, 0.2, 0.6, 0.5, 0.99]])
    )
    assert gradient[0].tolist() == pytest.approx([0, 0, -0.5 / 5, -1 / 5, 0], abs=1e-6)
    assert value == pytest.approx((0.5 * (0.4 - CLOSED) + 0.5 - CLOSED) / 5)
    valid[0, 3:] = False
    assert uncovered_surface(torch.zeros(1, 5), target, behind, valid) == pytest.approx(0.5 * (1 - CLOSED) / 5)


def test_pixels_of_surfaces_are_pushed_to_be_opaque_in_front_of_a_learned_color():
    surface = torch.tensor([[True, True, True, False]])
    alpha = torch.tensor([[0.2, 0.97, 0.99, 0.2]], requires_grad=True)
    loss = uncovered_pixels(alpha, surface)
    assert loss.item() == pytest.approx((0.78 + 0.01) / 4)
    loss.backward()
    assert alpha.grad.tolist() == [[-0.25, -0.25, 0, 0]]
