"""Gaussians left out at random where a run learns its photographs by heart rather than the place.

After DropGaussian (Park et al. 2025, arXiv 2504.00773): what is left shows as much on average, so that no Gaussian can
settle where one photograph alone needs it behind others. It costs detail where nothing is learned by heart, so the rate
follows what a run finds: how much better its training photographs come out than its validation photographs.
"""

import math

import torch
from torch import Tensor

GAP_DB = 3.0
"""As much better they may be: in dense scenes they are by 2 to 3 dB."""
FULL_GAP_DB = 5.0
"""From here on the full rate."""
SCORED_IMAGES = 5
"""Training photographs that are scored."""


def dropout_rate(training_psnr: float, validation_psnr: float, most: float) -> float:
    """Share of the Gaussians to leave out of each iteration, 0 to `most`; 0 where a PSNR (dB) is not known."""
    share = (training_psnr - validation_psnr - GAP_DB) / (FULL_GAP_DB - GAP_DB)
    return 0.0 if math.isnan(share) else most * min(max(share, 0.0), 1.0)


def dropout_note(rate: float, training_psnr: float | None, validation_psnr: float | None) -> str:
    """What a report says of the share that the end of a run left out, nothing where that is none."""
    if not rate:
        return ""
    return (
        f"Photographs were learned by heart (at the end {training_psnr:.1f} dB, validation photographs "
        f"{validation_psnr:.1f} dB), so {100 * rate:.0f} % of the Gaussians were left out of each iteration at random."
    )


def opacity_factors(count: int, rate: float, random: torch.Generator, device: torch.device) -> Tensor:
    """(count,) factors of opacity: 0 for a share `rate` of them, drawn at random, 1 / (1 - rate) for the others."""
    return (torch.rand(count, generator=random) >= rate).float().to(device) / (1 - rate)
