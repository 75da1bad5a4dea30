"""The brightness of each photograph: exposure and white balance that a camera changes by itself.

A gain multiplies the linear light of a whole photograph, water included. Only ratios of gains mean anything, so the
mean of their logarithms is always 0; a photograph that none was learned for is shown with gain 1.
"""

from dataclasses import dataclass

from torch import Tensor

from ..water.medium import to_display, to_light


@dataclass
class Exposure:
    """raw (V, 1) log gains of V photographs, or (V, 3) where the white balance changes too."""

    raw: Tensor

    @classmethod
    def starting(cls, log_gains: Tensor, channels: int = 1) -> "Exposure":
        """From log gains (V,)."""
        return cls(log_gains.float()[:, None].repeat(1, channels))

    def parameters(self) -> dict[str, Tensor]:
        """Name -> tensor of what is learned."""
        return {"raw": self.raw}

    @property
    def log_gains(self) -> Tensor:
        """(V, 1 or 3), mean 0 over the photographs."""
        return self.raw - self.raw.mean(0)


def exposed(picture: Tensor, exposure: Exposure, view: int) -> Tensor:
    """A picture (H, W, 3) of display values as photograph number `view` shows it; differentiable."""
    return to_display(to_light(picture) * exposure.log_gains[view].exp())
