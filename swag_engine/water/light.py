"""Linear light and display values: which is used where, and the curve between them (sRGB, IEC 61966-2-1).

| what | works on | because |
|---|---|---|
| attenuation, backscatter, lamp, exposure, caustics, and the fit of all of them | linear light | physics |
| recipes that follow methods with water on pixel values (`Recipe.light` "srgb") | display values | they have it so |
| colors of Gaussians, blending, losses, PSNR, SSIM, LPIPS, depth and frame networks | display values | made for them |
| delta E | CIE L*a*b* of linear light | its definition |

An effect takes display values to light, does its work, and brings them back: everything else sees display values only.
"""

from torch import Tensor

from ..kernels.backends import kernels_for


def apply_gain(display: Tensor, log_gain: Tensor, backend: str = "auto") -> Tensor:
    """Multiply the linear light of display values by exp(log_gain).

    Args:
        display: Display values; kernels compute where the shape is (..., 3).
        log_gain: Natural logarithm of the factor; broadcasts with `display`.
        backend: What computes, as in `kernels_for`.

    Returns:
        Display values, differentiable in both.
    """
    return kernels_for(backend, display, log_gain).apply_gain(display, log_gain)
