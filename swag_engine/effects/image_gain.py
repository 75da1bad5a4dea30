"""Gains that image effects put on a rendered image."""

from collections.abc import Iterable

from torch import Tensor

from ..water.light import apply_gain


def apply_log_gains(image: Tensor, log_gains: Iterable[Tensor | None], amount: float = 1.0) -> Tensor:
    """Multiply the linear light of an image by the gains of all image effects.

    Args:
        image: (H, W, 3) display values.
        log_gains: Log gain of each effect, broadcastable to the image; None for none.
        amount: 0 (the image as rendered) to 1, the exponent of the gains.

    Returns:
        (H, W, 3) display values; differentiable in image and gains.
    """
    total: Tensor | None = None
    for log_gain in log_gains:
        if log_gain is not None:
            total = log_gain if total is None else total + log_gain
    return image if total is None or amount == 0 else apply_gain(image, amount * total)
