"""Blending of projected Gaussians in plain torch, for any dtype and device, by autograd: the truth for the kernels."""

from collections.abc import Iterator

import torch
from torch import Tensor

from .projection import MIN_ALPHA

MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
TILE = 32


def blend(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    channels: Tensor,
    background: Tensor,
    depths: Tensor,
    radii: Tensor,
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """Blend front to back; returns channels (H, W, C) and alpha (H, W).

    Each pixel centre p sees alpha_i = min(.99, o_i exp(-(p - mean_i)^T conic_i (p - mean_i) / 2)) of the Gaussians by
    depth (equal depths by index); those with alpha < 1/255 are skipped, and the pixel ends before the Gaussian that
    would take the transmittance T to 1e-4 or less. out = sum_i T_i alpha_i channel_i + T_end background.
    The choices (order, skipping, end) and the clamp at .99 have no gradient.
    """
    tiles, rows = [], []
    for window, meets, pixels in _tiles(means2d, depths, radii, width, height):
        samples = _Samples(means2d[meets], conics[meets], opacities[meets], pixels)
        blended = samples.weights.T @ channels[meets] + samples.behind[-1][:, None] * background
        tile = torch.cat([blended, 1 - samples.behind[-1][:, None]], 1)
        tiles.append(tile.reshape(window[0].stop - window[0].start, window[1].stop - window[1].start, -1))
        if window[1].stop == width:
            rows.append(torch.cat(tiles, 1))
            tiles = []
    image = torch.cat(rows, 0)
    return image[..., :-1], image[..., -1]


def contributions(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    channels: Tensor,
    background: Tensor,
    depths: Tensor,
    radii: Tensor,
    width: int,
    height: int,
    weights: Tensor,
    image_gradient: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """weighted (N, R), importance (N,) and error (N,) of api.Contributions; no gradient.

    weights (H, W, R), image_gradient (H, W, C).
    """
    weighted = channels.new_zeros(len(channels), weights.shape[2])
    importance, error = channels.new_zeros(len(channels)), channels.new_zeros(len(channels))
    for window, meets, pixels in _tiles(means2d, depths, radii, width, height):
        samples = _Samples(means2d[meets], conics[meets], opacities[meets], pixels)
        weighted[meets] += samples.weights @ weights[window].reshape(len(pixels), -1)
        added = samples.weights[..., None] * channels[meets, None]  # (n, P, C)
        seen = torch.cat([added, (samples.behind[-1][:, None] * background)[None]]).flip(0).cumsum(0).flip(0)
        change = samples.behind[:-1, :, None] * channels[meets, None] - seen[1:] / (1 - samples.alpha[..., None])
        change = torch.where(samples.varies[..., None], opacities[meets, None, None] * change, 0)
        importance[meets] += change.square().sum((1, 2))
        along = (change * image_gradient[window].reshape(len(pixels), -1)).sum(2)
        error[meets] += along.square().sum(1)
    return weighted, importance, error


def _tiles(
    means2d: Tensor, depths: Tensor, radii: Tensor, width: int, height: int
) -> Iterator[tuple[tuple[slice, slice], Tensor, Tensor]]:
    """Of each tile, row by row: its window (rows, columns), the Gaussians that it may see, by depth, and its pixel
    centres (P, 2)."""
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


class _Samples:
    """n Gaussians in depth order at P pixels (P, 2): alpha (n, P), 0 where not drawn; weights (n, P) = T alpha; behind
    (n + 1, P), the transmittance before each and after the last; varies (n, P), drawn and not clamped."""

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
