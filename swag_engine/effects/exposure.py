"""Exposure: each image has a brightness, and perhaps a white balance, of its own.

A gain multiplies the linear light of a whole image, water included. Only ratios of gains mean anything, so the mean of
the logarithms of learned gains is always 0. A held-out image has no gain of its own: nothing of it may be used.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.scene_evidence import SceneEvidence
from ..evidence.water_terms import LEAST_GAIN_BIC, LEAST_GAIN_SD
from .effect import CostProbe, Effect, InitialContext
from .image_gain import apply_log_gains
from .range_limits import too_few_observations

LEAST_GAIN_BIC_BY_LAMP = 700.0
"""BIC gain of exposure under a lamp, whose own light gains some hundreds."""
LEAST_KNOWN = 5
"""Images from which neighbours predict one another."""


@dataclass
class Exposure:
    """Exposure of each training image.

    Attributes:
        raw: (V, 1) log gains of V images, or (V, 3) where the white balance changes too.
        names: Names of the images, sorted.
        centred: Whether the mean is subtracted; not for gains that were measured against a finished model.
    """

    raw: Tensor
    names: Sequence[str]
    centred: bool = True

    @classmethod
    def starting(cls, log_gains: dict[str, float], channels: int = 1) -> "Exposure":
        """Return exposures of given log gains by image name."""
        names = sorted(log_gains)
        raw = torch.tensor([log_gains[name] for name in names], dtype=torch.float32)
        return cls(raw[:, None].repeat(1, channels), names)

    def parameters(self) -> dict[str, Tensor]:
        """Return what is learned, by attribute name."""
        return {"raw": self.raw}

    def settings(self) -> dict[str, Any]:
        """Return what a checkpoint has beside the tensor."""
        return {"names": list(self.names), "centred": self.centred}

    @property
    def log_gains(self) -> Tensor:
        """(V, 1 or 3); of mean 0 over the images where they are centred."""
        return self.raw - self.raw.mean(0) if self.centred else self.raw

    def log_gain(self, image: str, height: int = 0, width: int = 0) -> Tensor:
        """Return the log gain (1 or 3,) of an image; predicted from its neighbours where none was learned for it.

        Neighbours are those by name: the exposure of a video changes slowly, that of single photos at random. So their
        mean counts as far as such means have predicted the known images (regression through 0).
        """
        gains = self.log_gains
        if image in self.names:
            return gains[self.names.index(image)]
        if len(self.names) < LEAST_KNOWN:
            return torch.zeros_like(gains[0])
        gains = gains.detach()
        expected = (gains[2:] + gains[:-2]) / 2
        trust = ((expected * gains[1:-1]).sum() / expected.square().sum().clamp(min=1e-12)).clamp(0, 1)
        place = sum(known < image for known in self.names)
        return trust * gains[max(place - 1, 0) : place + 1].mean(0)


def decide(evidence: SceneEvidence, earlier: Mapping[str, Decision]) -> Decision:
    """Decide from gains fitted beside every other term."""
    terms = evidence.water_terms
    if terms is None:
        return too_few_observations(evidence)
    camera = terms.camera
    over = " over backscatter that varies from photo to photo" if camera.over_backscatter else ""
    decision = Decision(
        "on" if camera.gains else "off",
        {
            "gain_sd": camera.gain_sd,
            "gain_sd_least": LEAST_GAIN_SD,
            "bic_gain": camera.gain_bic,
            "bic_gain_least": LEAST_GAIN_BIC,
        },
        f"Exposure varies by {camera.gain_sd:.1%} between photos (threshold {LEAST_GAIN_SD:.1%}), BIC gain "
        f"{camera.gain_bic:,.0f}{over} (threshold {LEAST_GAIN_BIC:.0f}).",
    )
    if camera.gains and terms.lamp.found and camera.gain_bic <= LEAST_GAIN_BIC_BY_LAMP:
        return decision.undetermined(
            f"Cannot be distinguished from the lamp's own light: BIC gain {camera.gain_bic:,.0f} (threshold under a "
            f"lamp {LEAST_GAIN_BIC_BY_LAMP:.0f})."
        )
    return decision


def _fitted(evidence: SceneEvidence) -> dict[str, Any]:
    terms = evidence.water_terms
    if terms is None:
        return {}
    gains = dict.fromkeys(evidence.names, 0.0)
    for image, gain in zip(terms.images, terms.fit.log_gains, strict=True):
        gains[evidence.names[image]] = round(float(gain), 5)
    return {"log_gains": gains}


def _initial(context: InitialContext) -> Exposure:
    gains = context.fitted.get("log_gains")
    known = gains if isinstance(gains, dict) else {}
    return Exposure.starting({name: float(known.get(name, 0.0)) for name in context.images})


def _load(tensors: dict[str, Tensor], settings: Any) -> Exposure:
    # Earlier checkpoints have the list of names alone.
    stored = settings if isinstance(settings, dict) else {"names": settings}
    return Exposure(tensors["raw"], stored["names"], stored.get("centred", True))


def _cost(probe: CostProbe) -> Callable[[], Tensor]:
    exposure = Exposure(torch.zeros(1, 1, device=probe.device, requires_grad=True), [""])
    image, weights = probe.image(), probe.image().detach()
    return lambda: (apply_log_gains(image, [exposure.log_gain("")]) * weights).sum()


EFFECT = Effect(
    "Exposure",
    "image",
    decide,
    fitted=_fitted,
    initial=_initial,
    load=_load,
    learning_rate=5e-3,
    row_an_image=True,
    cost=_cost,
    tried_at=0.1,
)
