"""Blending of projected Gaussians in plain torch, for any dtype and device, by autograd."""

from collections.abc import Iterator

import torch
from torch import Tensor

from ..protocol import Projection
from .projection import MIN_ALPHA

MAX_ALPHA = 0.99
"""Largest alpha: the backward pass divides by 1 - alpha. As in 3DGS."""
MIN_TRANSMITTANCE = 1e-4
"""Transmittance at which a pixel ends: less than a step of an 8-bit image is behind. As in 3DGS."""
TILE = 32
"""Width and height of a tile, pixels: limits the memory of one step."""


def blend(
    projected: Projection, opacities: Tensor, channels: Tensor, background: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Blend projected Gaussians front to back; `Kernels.blend` has the formula.

    Args:
        projected: The N Gaussians.
        opacities: (N,) in 0..1.
        channels: (N, C) values to blend.
        background: (C,) values behind all Gaussians.
        width: Width of the image, pixels.
        height: Height of the image, pixels.

    Returns:
        The image (height, width, C) and alpha (height, width).
    """
    tiles, rows = [], []
    for window, meets, pixels in tiles_of(projected, width, height):
        samples = Samples(projected.means2d[meets], projected.conics[meets], opacities[meets], pixels)
        blended = samples.weights.T @ channels[meets] + samples.behind[-1][:, None] * background
        tile = torch.cat([blended, 1 - samples.behind[-1][:, None]], 1)
        tiles.append(tile.reshape(window[0].stop - window[0].start, window[1].stop - window[1].start, -1))
        if window[1].stop == width:
            rows.append(torch.cat(tiles, 1))
            tiles = []
    image = torch.cat(rows, 0)
    return image[..., :-1], image[..., -1]


def contributions(
    projected: Projection,
    opacities: Tensor,
    channels: Tensor,
    background: Tensor,
    width: int,
    height: int,
    weights: Tensor,
    image_gradient: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Sum over all pixels what each Gaussian does to the image; `Kernels.contributions` has the formulas.

    Args:
        projected: The N Gaussians.
        opacities: (N,) in 0..1.
        channels: (N, C) values to blend.
        background: (C,) values behind all Gaussians.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        weights: (height, width, R) weight images.
        image_gradient: (height, width, C) gradient of a loss by the image.

    Returns:
        Weighted sums (N, R), importance (N,) and error (N,), without gradients.
    """
    weighted = channels.new_zeros(len(channels), weights.shape[2])
    importance, error = channels.new_zeros(len(channels)), channels.new_zeros(len(channels))
    for window, meets, pixels in tiles_of(projected, width, height):
        samples = Samples(projected.means2d[meets], projected.conics[meets], opacities[meets], pixels)
        weighted[meets] += samples.weights @ weights[window].reshape(len(pixels), -1)
        added = samples.weights[..., None] * channels[meets, None]  # (n, P, C)
        seen = torch.cat([added, (samples.behind[-1][:, None] * background)[None]]).flip(0).cumsum(0).flip(0)
        change = samples.behind[:-1, :, None] * channels[meets, None] - seen[1:] / (1 - samples.alpha[..., None])
        change = torch.where(samples.varies[..., None], opacities[meets, None, None] * change, 0)
        importance[meets] += change.square().sum((1, 2))
        along = (change * image_gradient[window].reshape(len(pixels), -1)).sum(2)
        error[meets] += along.square().sum(1)
    return weighted, importance, error


def tiles_of(projected: Projection, width: int, height: int) -> Iterator[tuple[tuple[slice, slice], Tensor, Tensor]]:
    """Go through the tiles of an image, row by row.

    Args:
        projected: The N Gaussians.
        width: Width of the image, pixels.
        height: Height of the image, pixels.

    Yields:
        Rows and columns of the tile, the Gaussians that it may meet, by depth, and its pixel centres (P, 2).
    """
    means2d, depths, radii = projected.means2d, projected.depths, projected.radii
    with torch.no_grad():
        order = torch.nonzero(radii > 0)[:, 0]
        order = order[torch.argsort(depths[order], stable=True)]
        reach = radii[order, None] + 1
        low, high = means2d[order] - reach, means2d[order] + reach
    for top in range(0, height, TILE):
        bottom = min(top + TILE, height)
        in_band = torch.nonzero((high[:, 1] > top) & (low[:, 1] < bottom))[:, 0]
        first, last = low[in_band, 0], high[in_band, 0]
        for left in range(0, width, TILE):
            right = min(left + TILE, width)
            meets = order[in_band[(last > left) & (first < right)]]
            y, x = torch.meshgrid(
                torch.arange(top, bottom).to(means2d) + 0.5, torch.arange(left, right).to(means2d) + 0.5, indexing="ij"
            )
            yield (slice(top, bottom), slice(left, right)), meets, torch.stack([x.reshape(-1), y.reshape(-1)], 1)


class Samples:
    """Alpha and transmittance of n Gaussians, in depth order, at P pixels.

    Args:
        means2d: (n, 2) centres, pixels.
        conics: (n, 3) inverse covariances, 1 / pixel^2.
        opacities: (n,) in 0..1.
        pixels: (P, 2) pixel centres.

    Attributes:
        alpha: (n, P), 0 where a Gaussian is not drawn.
        weights: (n, P) = T alpha.
        behind: (n + 1, P) transmittance before each Gaussian and after the last.
        varies: (n, P) whether a Gaussian is drawn and its alpha is not clamped.
    """

    def __init__(self, means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor) -> None:
        dx, dy = (means2d[:, None] - pixels).unbind(-1)
        a, b, c = conics[:, :, None].unbind(1)
        unclamped = opacities[:, None] * torch.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))
        with torch.no_grad():
            drawn = unclamped >= MIN_ALPHA
            left_behind = torch.cumprod(1 - torch.where(drawn, unclamped.clamp(max=MAX_ALPHA), 0), 0)
            drawn &= left_behind > MIN_TRANSMITTANCE
        self.varies = drawn & (unclamped < MAX_ALPHA)
        self.alpha = torch.where(drawn, unclamped, 0).clamp(max=MAX_ALPHA)
        self.behind = torch.cumprod(torch.cat([torch.ones_like(pixels[None, :, 0]), 1 - self.alpha]), 0)
        self.weights = self.alpha * self.behind[:-1]
