"""What an effect is: a decision, a model of what is learned, and words for the user."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from ..evidence.decision import Decision
from ..evidence.scene_evidence import SceneEvidence
from ..scene.cameras import Camera

Decide = Callable[[SceneEvidence, Mapping[str, Decision]], Decision]
"""The decision of an effect, from the evidence and the decisions of the effects before it."""


class EffectModel(Protocol):
    """What is learned of an effect."""

    def parameters(self) -> dict[str, Tensor]:
        """Return what is learned, by attribute name."""

    def settings(self) -> Any:
        """Return what a checkpoint's JSON needs beside the tensors."""


class ImageModel(EffectModel, Protocol):
    """The model of an effect that multiplies the linear light of a whole rendered image."""

    def log_gain(self, image: str, height: int, width: int) -> Tensor | None:
        """Return the log gain of an image, None where there is none.

        Args:
            image: Name of the image; it need not be one that was trained on.
            height: Height of the rendered image, pixels.
            width: Its width, pixels.

        Returns:
            Tensor that broadcasts to (height, width, 3).
        """


@dataclass(frozen=True)
class InitialContext:
    """What the initial values of an effect depend on.

    Attributes:
        fitted: Values that the plan fitted, empty without.
        images: Names of the training images, sorted.
        width: Width of the training images, pixels.
        height: Their height, pixels.
        median_range: Median range of the scene, scene units.
    """

    fitted: Mapping[str, Any]
    images: Sequence[str]
    width: int
    height: int
    median_range: float


@dataclass(frozen=True)
class CostProbe:
    """Inputs on which the cost of an effect is measured.

    Attributes:
        camera: A camera of the size that is trained at.
        backend: What computes.
        device: Where the tensors are.
        random: Makes a tensor of a shape, uniform in 0..1, with a gradient.
        gaussians: Number of Gaussians.
    """

    camera: Camera
    backend: str
    device: torch.device
    random: Callable[..., Tensor]
    gaussians: int

    def image(self) -> Tensor:
        """Return a random image (H, W, 3) of the camera's size."""
        return self.random(self.camera.height, self.camera.width, 3)


@dataclass(frozen=True)
class Effect:
    """One effect that a scene may call for.

    Attributes:
        title: Name for the user.
        acts_on: What the effect changes: the medium, the Gaussians, the rendered image, or the training images.
        decide: Decides whether a scene calls for it.
        fitted: Values that the evidence gives training to start from, for the plan.
        model_name: Key of the model in checkpoints; the effect's own name where it is empty.
        initial: Makes the model at the start of a run; None for an effect without a model of its own.
        load: Makes the model of a checkpoint's tensors and settings.
        learning_rate: Adam's step size at the start of the run; it falls to 0 as a cosine.
        row_an_image: Whether each row of the parameters belongs to one image.
        cost: Gives the work whose time, forward and backward, is the effect's cost; None for one without cost.
        cost_every: Iterations in one of which that work is done.
        tried_at: Fraction of the run at which the effect is tried where the plan is not certain; None for never.
        determined_by_ranges: Whether images from such ranges cannot determine it during training either.
        on_when_unknown: Whether a run models it where the images cannot determine it.
        needs_network: Whether it needs a pretrained network.
    """

    title: str
    acts_on: Literal["medium", "gaussians", "image", "training images", "labels"]
    decide: Decide
    fitted: Callable[[SceneEvidence], dict[str, Any]] = lambda evidence: {}
    model_name: str = ""
    initial: Callable[[InitialContext], EffectModel] | None = None
    load: Callable[[dict[str, Tensor], Any], EffectModel] | None = None
    learning_rate: float = 0.0
    row_an_image: bool = False
    cost: Callable[[CostProbe], Callable[[], Tensor]] | None = None
    cost_every: int = 1
    tried_at: float | None = None
    determined_by_ranges: bool = False
    on_when_unknown: bool = False
    needs_network: bool = False
