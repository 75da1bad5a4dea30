"""Water and light for tests: a camera, a random medium, and gains with their gradients."""

import numpy as np
import torch

from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.kernels.reference.harmonics import C0
from swag_engine.water.light import apply_gain
from swag_engine.water.medium import Medium

CAMERA = torch.eye(4, dtype=torch.float64), torch.tensor([[20.0, 0, 11], [0, 21, 8], [0, 0, 1]], dtype=torch.float64)


def make_water(n=40, light="linear", seed=0, dtype=torch.float64):
    """Colors (n, 3), offsets (n, 3) and a medium whose background light changes with direction."""
    generator = torch.Generator().manual_seed(seed)
    colors = torch.rand(n, 3, generator=generator, dtype=torch.float64)
    offsets = torch.randn(n, 3, generator=generator, dtype=torch.float64) * 2
    attenuation, backscatter, background_sh = (
        torch.randn(size, generator=generator).double() for size in ((3,), (3,), (9, 3))
    )
    medium = Medium(attenuation, backscatter, background_sh, 2.5, light)
    medium.background_sh *= 0.5
    parameters = {name: t.to(dtype) for name, t in medium.parameters().items()}
    return colors.to(dtype), offsets.to(dtype), Medium(**parameters, unit_range=2.5, light=light)


def gain_and_gradients(shape, backend, dtype, device="cpu"):
    """Apply gains to colors around the toe of the sRGB curve and beyond 1; return the colors and the gradients."""
    generator = torch.Generator().manual_seed(1)
    display = torch.rand(45, 17, 3, generator=generator, dtype=torch.float64) ** 4 * 1.3
    log_gain = torch.randn(shape, generator=generator, dtype=torch.float64)
    leaves = [t.to(device, dtype, copy=True).requires_grad_() for t in (display, log_gain)]
    shown = apply_gain(leaves[0], leaves[1], backend)
    weights = torch.randn(shown.shape, generator=generator, dtype=torch.float64).to(shown)
    return [t.detach().double().cpu() for t in (shown, *torch.autograd.grad((shown * weights).sum(), leaves))]


def wall_cloud(display, spacing, z):
    """A flat, opaque wall at a depth z, centred at the axis, with a Gaussian for each of the colors (H, W, 3)."""
    height, width = display.shape[:2]
    y, x = ((np.mgrid[:height, :width] - np.array([height - 1, width - 1])[:, None, None] / 2) * spacing).reshape(2, -1)
    return GaussianCloud(
        means=torch.from_numpy(np.stack([x, y, np.full(len(x), z)], 1)).float(),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(len(x), 1),
        log_scales=torch.tensor([spacing, spacing, 0.01]).log().repeat(len(x), 1),
        opacity_logits=torch.full((len(x),), 4.0),
        sh0=((torch.from_numpy(display.reshape(-1, 3)).float() - 0.5) / C0)[:, None],
        shN=torch.zeros(len(x), 3, 3),
        background=torch.zeros(3),
    )
