"""Spherical harmonics: the basis of 3DGS files, orthonormal, differentiable."""

import numpy as np
import pytest
import torch
from scipy import special

from swag_engine.gaussians.sh import evaluate_sh
from swag_engine.kernels.reference.harmonics import sh_basis


def colors_of(sh, directions, degree):
    return evaluate_sh(sh[:, :1], sh[:, 1:], directions, degree)


def directions(count, seed=0):
    vectors = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(vectors, dim=1)


def test_basis_is_the_real_harmonics_with_condon_shortley_phase():
    unit = directions(50)
    x, y, z = unit.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            legendre = special.lpmv(abs(order), degree, np.cos(polar))  # with the phase (-1)^m
            norm = np.sqrt((2 * degree + 1) / (4 * np.pi))
            norm *= np.sqrt(special.factorial(degree - abs(order)) / special.factorial(degree + abs(order)))
            turn = {-1: np.sqrt(2) * np.sin(-order * azimuth), 0: 1, 1: np.sqrt(2) * np.cos(order * azimuth)}
            columns.append(norm * legendre * turn[np.sign(order)])
    np.testing.assert_allclose(sh_basis(unit, 3).numpy(), np.stack(columns, 1), atol=1e-14)


def test_basis_is_orthonormal_over_the_sphere():
    heights, weights = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * 2 * np.pi / 16
    z, phi = np.meshgrid(heights, azimuth, indexing="ij")
    flat = np.sqrt(1 - z**2)
    unit = torch.from_numpy(np.stack([flat * np.cos(phi), flat * np.sin(phi), z], -1).reshape(-1, 3))
    basis = sh_basis(unit, 3).numpy()
    area = np.repeat(weights, 16) * 2 * np.pi / 16
    np.testing.assert_allclose(basis.T @ (area[:, None] * basis), np.eye(16), atol=1e-14)


def test_color_is_one_half_plus_the_sum_and_never_negative():
    sh = torch.zeros(3, 4, 3, dtype=torch.float64)
    sh[0, 0] = torch.tensor([1.0, 0.0, -1.0])
    sh[1, 2] = 1.0
    sh[2, 0] = -5.0
    straight = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(3, 3)
    first, second, third = colors_of(sh, straight, 1)
    half = 0.5 / np.sqrt(np.pi)
    torch.testing.assert_close(first, torch.tensor([0.5 + half, 0.5, 0.5 - half], dtype=torch.float64))
    torch.testing.assert_close(second, torch.full((3,), 0.5 + np.sqrt(0.75 / np.pi), dtype=torch.float64))
    assert (third == 0).all()


def test_lower_degree_ignores_higher_coefficients():
    sh = torch.randn(5, 16, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    unit = directions(5)
    for degree in range(4):
        torch.testing.assert_close(colors_of(sh, unit, degree), colors_of(sh[:, : (degree + 1) ** 2], unit, degree))


def test_gradients():
    sh = torch.randn(4, 16, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) * 0.2
    inputs = sh.requires_grad_(), directions(4).requires_grad_()
    assert torch.autograd.gradcheck(lambda s, d: colors_of(s, d, 3), inputs)


@pytest.mark.parametrize("degree", range(4))
def test_kernel_agrees_with_float64(degree):
    generator = torch.Generator().manual_seed(3)
    sh = torch.randn(300, 16, 3, dtype=torch.float64, generator=generator)
    weights = torch.randn(300, 3, dtype=torch.float64, generator=generator)
    results = []
    for dtype in (torch.float64, torch.float32):
        values = sh.to(dtype, copy=True).requires_grad_()
        colors = colors_of(values, directions(300).to(dtype), degree)
        (colors * weights.to(dtype)).sum().backward()
        results.append((colors.detach().double(), values.grad.double()))
    (colors, gradient), (kernel_colors, kernel_gradient) = results
    assert (colors == 0).any() and (colors > 0).any()
    torch.testing.assert_close(kernel_colors, colors, atol=3e-6, rtol=0)
    torch.testing.assert_close(kernel_gradient, gradient, atol=3e-6, rtol=0)
    assert (kernel_gradient[:, (degree + 1) ** 2 :] == 0).all()


def test_too_few_coefficients_are_refused():
    with pytest.raises(ValueError, match="degree 2 of 0 to 3 needs 9"):
        colors_of(torch.zeros(2, 4, 3), torch.zeros(2, 3), 2)
