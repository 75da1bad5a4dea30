"""The effects that a run simulates, together: what is learned of each, and how they change a picture.

An effect that is None is not simulated, and nothing of it runs.
"""

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from ..water.light import relit
from ..water.medium import SETTINGS, Medium
from ..water.network import WaterNetwork
from .caustics import Illumination
from .exposure import Exposure
from .lamp import Lamp


@dataclass
class Simulated:
    """Water and lamp act on the Gaussians (rasterize/render.py); exposure and caustics on the whole picture."""

    medium: Medium | WaterNetwork | None = None
    lamp: Lamp | None = None
    exposure: Exposure | None = None
    caustics: Illumination | None = None

    def owners(self) -> dict[str, Any]:
        """Name -> effect, of those that are simulated."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: effect for name, effect in named.items() if effect is not None}

    def parameters(self) -> dict[str, Tensor]:
        """Name -> tensor of what is learned, as in "lamp.log_tau"."""
        return {
            f"{owner}.{name}": tensor
            for owner, effect in self.owners().items()
            for name, tensor in effect.parameters().items()
        }

    def to(self, device: torch.device) -> "Simulated":
        """Moves the tensors to a device, in place."""
        for effect in self.owners().values():
            for name, tensor in effect.parameters().items():
                setattr(effect, name, tensor.to(device))
        return self

    def developed(self, picture: Tensor, name: str, amount: float = 1.0) -> Tensor:
        """A picture (H, W, 3) of display values as the photograph of this name shows it; differentiable.

        amount: 0 (as it was rendered) to 1, the exponent of gain and light.
        """
        factor = None if self.exposure is None else self.exposure.of(name)
        field = None if self.caustics is None else self.caustics.of(name, *picture.shape[:2])
        if field is not None:
            factor = field if factor is None else factor + field
        return picture if factor is None or amount == 0 else relit(picture, amount * factor)

    # -- checkpoints --------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """What a checkpoint's JSON needs beside the tensors of `parameters`."""
        state: dict[str, Any] = {"medium": None}
        if self.medium is not None:
            state["medium"] = {name: getattr(self.medium, name, None) for name in SETTINGS}
        if self.lamp is not None:
            state["lamp"] = self.lamp.unit_range
        for name in ("exposure", "caustics"):
            if (effect := getattr(self, name)) is not None:
                state[name] = list(effect.names)
        return state

    @classmethod
    def from_checkpoint(cls, tensors: dict[str, Tensor], state: dict[str, Any]) -> "Simulated":
        """The effects of a checkpoint's tensors and state."""

        def found(owner: str) -> dict[str, Tensor]:
            prefix = f"{owner}."
            return {name[len(prefix) :]: t.clone() for name, t in tensors.items() if name.startswith(prefix)}

        simulated = cls()
        if medium := found("medium"):
            settings = state["medium"]
            if "weights" in medium:
                simulated.medium = WaterNetwork(**medium, unit_range=settings["unit_range"])
            else:
                known = (medium.get(field.name) for field in fields(Medium) if field.name not in SETTINGS)
                simulated.medium = Medium(*known, **settings)  # type: ignore[arg-type]
        if lamp := found("lamp"):
            simulated.lamp = Lamp(**lamp, unit_range=state["lamp"])
        if exposure := found("exposure"):
            simulated.exposure = Exposure(**exposure, names=state["exposure"])
        if caustics := found("caustics"):
            simulated.caustics = Illumination(**caustics, names=state["caustics"])
        return simulated
