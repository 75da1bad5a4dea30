"""Dropout of Gaussians where a run overfits its training images.

After DropGaussian (Park et al. 2025, arXiv 2504.00773): the remaining Gaussians are as visible on average, so that no
Gaussian can settle where a single image alone needs it behind others. Dropout costs detail where nothing overfits, so
its rate follows how much better the training images are reproduced than the validation images.
"""

import math

import torch
from torch import Tensor

GAP_DB = 3.0
"""PSNR by which training images may be better than validation images without dropout, dB: 2 to 3 in dense scenes."""
FULL_GAP_DB = 5.0
"""PSNR gap from which the rate is at its maximum, dB."""
SCORED_IMAGES = 5
"""Training images that are scored to measure the gap."""


def dropout_rate(training_psnr: float, validation_psnr: float, most: float) -> float:
    """Choose the fraction of Gaussians to drop in each iteration.

    Args:
        training_psnr: PSNR of training images, dB; NaN where it is not known.
        validation_psnr: PSNR of the validation images, dB; NaN where it is not known.
        most: Largest fraction, 0..1.

    Returns:
        Fraction, 0..most; 0 where a PSNR is not known.
    """
    gap = (training_psnr - validation_psnr - GAP_DB) / (FULL_GAP_DB - GAP_DB)
    return 0.0 if math.isnan(gap) else most * min(max(gap, 0.0), 1.0)


def dropout_note(rate: float, training_psnr: float | None, validation_psnr: float | None) -> str:
    """Return a sentence for the user on the dropout at the end of a run, empty where there was none."""
    if not rate or training_psnr is None or validation_psnr is None:
        return ""
    return (
        f"The run overfitted (training images {training_psnr:.1f} dB, validation images {validation_psnr:.1f} dB), so "
        f"{100 * rate:.0f} % of the Gaussians were dropped at random in each iteration."
    )


def opacity_factors(count: int, rate: float, random: torch.Generator) -> Tensor:
    """Draw the factors of opacity of one iteration.

    Args:
        count: Number of Gaussians.
        rate: Fraction to drop, 0..1.
        random: Random numbers of the iteration; the result is on its device.

    Returns:
        (count,) float32: 0 for Gaussians that are dropped, 1 / (1 - rate) for the others.
    """
    return (torch.rand(count, generator=random, device=random.device) >= rate).float() / (1 - rate)
