"""L1 and SSIM: the compiled path, the torch path, and a direct computation of the same thing."""

import numpy as np
import pytest
import torch

from swag_engine.rasterize import cpu
from swag_engine.training.losses import l1_ssim, ssim

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
def test_l1_ssim_weighs_both(dtype):
    image, target = images(20, 30)

    def expected_loss(x):
        return 0.7 * (x - target).abs().mean() + 0.3 * (1 - direct_ssim(x, target))

    expected, expected_gradient = value_and_gradient(expected_loss, image)
    value, gradient = value_and_gradient(lambda x: l1_ssim(x, target.to(dtype), None, 0.3), image.to(dtype))
    assert abs(value - expected) < 1e-6
    assert (gradient - expected_gradient).abs().max() < 1e-5 * expected_gradient.abs().max()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_invalid_pixels_change_nothing(dtype):
    image, target = (x.to(dtype) for x in images(20, 30))
    valid = torch.rand(20, 30, generator=torch.Generator().manual_seed(3)) > 0.3
    other = torch.where(valid[..., None], image, torch.full_like(image, float("nan")))
    first = value_and_gradient(lambda x: l1_ssim(x, target, valid), image)
    second = value_and_gradient(lambda x: l1_ssim(x, target, valid), other)
    assert first[0] == second[0]
    assert torch.equal(first[1], second[1])
    assert (first[1][~valid] == 0).all() and (first[1][valid] != 0).any()
    assert first[0] < l1_ssim(image, target, None).item()
    assert l1_ssim(image, target, torch.zeros_like(valid)).item() == pytest.approx(0, abs=1e-6)


def test_perfect_and_constant_images_are_finite():
    black = torch.zeros(16, 16, 3)
    for image in (black, black + 1):
        value, gradient = value_and_gradient(lambda x, target=image: l1_ssim(x, target, None), image)
        assert value == pytest.approx(0, abs=1e-6) and gradient.isfinite().all()


def test_same_bits_for_any_number_of_threads():
    image, target = (x.float() for x in images(45, 70))
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(value_and_gradient(lambda x: l1_ssim(x, target, None), image))
    finally:
        torch.set_num_threads(before)
    assert all(r[0] == results[0][0] and torch.equal(r[1], results[0][1]) for r in results)


def test_torch_path_agrees_when_there_are_no_kernels(monkeypatch):
    image, target = (x.float() for x in images(45, 70))
    expected = value_and_gradient(lambda x: l1_ssim(x, target, None), image)
    monkeypatch.setattr(cpu, "library", lambda: None)
    value, gradient = value_and_gradient(lambda x: l1_ssim(x, target, None), image)
    assert value == pytest.approx(expected[0], rel=1e-5)
    np.testing.assert_allclose(gradient, expected[1], atol=1e-5 * expected[1].abs().max().item())


def test_other_shapes_are_refused():
    with pytest.raises(ValueError, match="H, W, 3"):
        ssim(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))
    with pytest.raises(ValueError, match="H, W, 3"):
        ssim(torch.zeros(4, 4, 1), torch.zeros(4, 4, 1))
