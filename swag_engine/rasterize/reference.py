"""Blending of projected Gaussians in plain torch, for any dtype and device, by autograd: the truth for the kernels."""

import torch
from torch import Tensor

from .projection import MIN_ALPHA

MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
TILE = 16


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
    order = torch.argsort(depths.detach(), stable=True)
    order = order[radii[order] > 0]
    means2d, conics, opacities, channels = means2d[order], conics[order], opacities[order], channels[order]
    with torch.no_grad():
        reach = (radii[order] + 1)[:, None]
        low, high = means2d - reach, means2d + reach
    bands = []
    for top in range(0, height, TILE):
        bottom = min(top + TILE, height)
        in_band = (high[:, 1] > top) & (low[:, 1] < bottom)
        tiles = []
        for left in range(0, width, TILE):
            right = min(left + TILE, width)
            meets = torch.nonzero(in_band & (high[:, 0] > left) & (low[:, 0] < right))[:, 0]
            y, x = torch.meshgrid(
                torch.arange(top, bottom).to(means2d) + 0.5, torch.arange(left, right).to(means2d) + 0.5, indexing="ij"
            )
            pixels = torch.stack([x.reshape(-1), y.reshape(-1)], 1)
            weights, transmittance = _blend_weights(means2d[meets], conics[meets], opacities[meets], pixels)
            blended = weights.T @ channels[meets] + transmittance[:, None] * background
            tile = torch.cat([blended, 1 - transmittance[:, None]], 1)
            tiles.append(tile.reshape(bottom - top, right - left, -1))
        bands.append(torch.cat(tiles, 1))
    image = torch.cat(bands, 0)
    return image[..., :-1], image[..., -1]


def _blend_weights(means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """T_i alpha_i (n, P) of n Gaussians in depth order at P pixels (P, 2), and the transmittance (P,) behind them."""
    dx, dy = (means2d[:, None] - pixels).unbind(-1)
    a, b, c = conics[:, :, None].unbind(1)
    unclamped = opacities[:, None] * torch.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))
    with torch.no_grad():
        drawn = unclamped >= MIN_ALPHA
        left_behind = torch.cumprod(1 - torch.where(drawn, unclamped.clamp(max=MAX_ALPHA), 0), 0)
        drawn &= left_behind > MIN_TRANSMITTANCE
    alpha = torch.where(drawn, unclamped, 0).clamp(max=MAX_ALPHA)
    behind = torch.cumprod(
        torch.cat([torch.ones_like(alpha[:1]) if len(alpha) else pixels.new_ones(1, len(pixels)), 1 - alpha]), 0
    )
    return alpha * behind[:-1], behind[-1]
