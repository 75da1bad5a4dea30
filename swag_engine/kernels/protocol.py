"""What every backend of kernels offers, and the values that pass between them."""

from dataclasses import dataclass

from torch import Tensor

from ..base.errors import InputError

MAX_PAIRS = 2**27  # of a Gaussian and a tile it meets; about 6 GB


class TooManyPairs(InputError):
    """Gaussians meet more tiles than can be blended."""


def check_pairs(pairs: int) -> None:
    """Raises TooManyPairs where blending would take more memory than a machine has to spare."""
    if pairs > MAX_PAIRS:
        raise TooManyPairs(
            f"The Gaussians meet {pairs} tiles of the picture, more than the {MAX_PAIRS} that can be blended: "
            "they are too many or too large. Use fewer Gaussians or a smaller width."
        )


@dataclass
class Projection:
    """Of N Gaussians: means2d (N, 2) px, conics (N, 3) = (A, B, C) of [[A, B], [B, C]] in 1/px^2, depths (N,) along z.

    radii (N,): px from the centre to where alpha falls below 1/255, without gradient; 0 where nothing is to be drawn.
    What is then in the other fields is finite and without gradient.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    radii: Tensor
