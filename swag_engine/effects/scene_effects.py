"""The effects that a run models, together: what is learned of each, and how they change an image.

An effect without a model here is not modelled, and none of its code runs.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from torch import Tensor

from ..water.medium import Medium
from ..water.network import WaterNetwork
from .effect import EffectModel, ImageModel, InitialContext
from .image_gain import apply_log_gains
from .lamp import Lamp
from .registry import MODELS, REGISTRY

FEW_IMAGES = 20
"""Images up to which rows of one image have the full step size: with 229, log gains that were fitted to .025 were
moved by .2."""


@dataclass
class SceneEffects:
    """Models of the effects of a scene.

    The medium and the lamp act on the Gaussians (rendering/render.py), image effects on the rendered image.

    Attributes:
        models: By key, in the order of the registry.
    """

    models: dict[str, EffectModel] = field(default_factory=dict)

    @classmethod
    def initial(
        cls, medium: Medium | WaterNetwork | None, effects: frozenset[str], context: Mapping[str, InitialContext]
    ) -> "SceneEffects":
        """Make the models at the start of a run.

        Args:
            medium: The water, None without.
            effects: Names of the effects that are modelled.
            context: What initial values depend on, by effect.

        Returns:
            The models.
        """
        models: dict[str, EffectModel] = {} if medium is None else {"medium": medium}
        for name, effect in REGISTRY.items():
            if name in effects and effect.initial:
                models[name] = effect.initial(context[name])
        return cls(models)

    @property
    def medium(self) -> Medium | WaterNetwork | None:
        """The water, None without."""
        medium = self.models.get("medium")
        assert medium is None or isinstance(medium, Medium | WaterNetwork)
        return medium

    @property
    def lamp(self) -> Lamp | None:
        """The lamp, None without."""
        lamp = self.models.get("lamp")
        assert lamp is None or isinstance(lamp, Lamp)
        return lamp

    def parameters(self) -> dict[str, Tensor]:
        """Return what is learned by name, as in "lamp.log_tau"."""
        return {
            f"{key}.{name}": tensor for key, model in self.models.items() for name, tensor in model.parameters().items()
        }

    def learning_rates(self) -> dict[str, float]:
        """Return Adam's step size at the start of the run by parameter name; that of the medium is the recipe's.

        A row that belongs to one image has a gradient in one of V steps. With its moments Adam then moves it by about
        sqrt(V) step sizes for each, so the step size falls with the root of V.
        """
        rates = {}
        for name, tensor in self.parameters().items():
            effect = MODELS[name.partition(".")[0]]
            rows = len(tensor) if effect.row_an_image else 1
            rates[name] = effect.learning_rate * min(1.0, (FEW_IMAGES / rows) ** 0.5)
        return rates

    def to(self, device: torch.device) -> "SceneEffects":
        """Move the tensors to a device, in place."""
        for model in self.models.values():
            for name, tensor in model.parameters().items():
                setattr(model, name, tensor.to(device))
        return self

    def apply_to_image(self, image: Tensor, name: str, amount: float = 1.0) -> Tensor:
        """Apply the image effects to a rendered image.

        Args:
            image: (H, W, 3) display values.
            name: Name of the image; it need not be one that was trained on.
            amount: 0 (the image as rendered) to 1, the exponent of the gains.

        Returns:
            (H, W, 3) display values as the camera would show them; differentiable.
        """
        height, width = image.shape[:2]
        gains = [
            cast(ImageModel, model).log_gain(name, height, width)
            for key, model in self.models.items()
            if MODELS[key].acts_on == "image"
        ]
        return apply_log_gains(image, gains, amount)

    # -- checkpoints --------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint's JSON needs beside the tensors of `parameters`."""
        return {key: model.settings() for key, model in self.models.items()}

    @classmethod
    def from_checkpoint(cls, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> "SceneEffects":
        """Read the models of a checkpoint.

        Args:
            tensors: Tensors by name.
            state: The checkpoint's JSON document.

        Returns:
            The models, which share no memory with the arguments.
        """
        models = {}
        for key, effect in MODELS.items():
            prefix = f"{key}."
            own = {name[len(prefix) :]: t.clone() for name, t in tensors.items() if name.startswith(prefix)}
            if own and effect.load:
                models[key] = effect.load(own, state[key])
        return cls(models)
