"""Adam over a cloud whose number of Gaussians changes, and over the effects that are modelled."""

from collections.abc import Mapping

import torch
from torch import Tensor

from ..effects.effect import EffectModel
from ..effects.scene_effects import SceneEffects
from ..gaussians.cloud import GaussianCloud
from ..gaussians.densify import PER_GAUSSIAN
from ..kernels.backends import kernels_for

MOMENTS = ("exp_avg", "exp_avg_sq")
"""Names of the two moments in a checkpoint."""
BETAS = (0.9, 0.999)
"""Decay of the two moments in each step."""
EPS = 1e-15
"""Added to the root of the second moment, at least."""
DAMPED = tuple(name for name in PER_GAUSSIAN if name not in ("means", "features"))
"""Parameters that move less where images hardly show a Gaussian. Gradients by the means depend on the scene's unit, and
those by features are not of an image's colors."""


class Optimizer:
    """Adam (arXiv 1412.6980) with one learning rate a parameter; its moments follow the Gaussians in densification.

    Args:
        cloud: The Gaussians; updated in place.
        effects: The effects; updated in place.
        backend: What computes.
        fixed: Number of Gaussians, the last ones of the cloud, that never change.

    Attributes:
        steps: Steps since the moments were last zero.
        moments: First and second moment by parameter name.
    """

    def __init__(self, cloud: GaussianCloud, effects: SceneEffects, backend: str = "auto", fixed: int = 0) -> None:
        self.backend, self.fixed = backend, fixed
        self.cloud = cloud
        self.effects = effects
        self.steps = 0
        self.moments: dict[str, tuple[Tensor, Tensor]] = {}
        self.adopt()

    def adopt(self) -> None:
        """Include effects that were added to `effects` and drop those that were removed; new moments are zero."""
        owners: tuple[GaussianCloud | EffectModel, ...] = (self.cloud, *self.effects.models.values())
        for owner in owners:
            for name, parameter in owner.parameters().items():
                if not parameter.requires_grad:
                    setattr(owner, name, parameter.detach().contiguous().requires_grad_())
        self.moments = {
            name: self.moments.get(name, (torch.zeros_like(parameter.detach()), torch.zeros_like(parameter.detach())))
            for name, parameter in self.parameters().items()
        }

    def parameters(self) -> dict[str, Tensor]:
        """Return all parameters by name; those of effects begin with the effect's name: "medium.background_sh"."""
        return self.cloud.parameters() | self.effects.parameters()

    def step(self, rates: Mapping[str, float], epsilon: float = EPS) -> None:
        """Update the parameters that have a rate and a gradient once, and clear all gradients.

        All Gaussians move, not only those in view: that scores .3 dB better on the demo scene.

        Args:
            rates: Step size by parameter name.
            epsilon: Added to the root of the second moment of DAMPED; EPS is to that of all others.
        """
        self.steps += 1
        for name, parameter in self.parameters().items():
            if parameter.grad is not None and name in rates:
                mean, square = self.moments[name]
                values, gradient = parameter.detach(), parameter.grad
                if self.fixed and name in PER_GAUSSIAN:
                    free = len(values) - self.fixed
                    values, gradient, mean, square = values[:free], gradient[:free], mean[:free], square[:free]
                adam_step(
                    values, gradient, mean, square, rates[name], self.steps, self.backend, epsilon_of(name, epsilon)
                )
        self.clear_gradients()

    def clear_gradients(self) -> None:
        """Drop the gradients of all parameters."""
        for parameter in self.parameters().values():
            parameter.grad = None

    def replace(self, cloud: GaussianCloud, source: Tensor) -> None:
        """Continue with another cloud.

        Args:
            cloud: The Gaussians.
            source: (N',) index of the Gaussian whose moments each one takes, -1 for none.
        """
        known = source >= 0
        for name in PER_GAUSSIAN:
            setattr(cloud, name, getattr(cloud, name).detach().contiguous().requires_grad_())
            taken = (moment[source.clamp(min=0)] for moment in self.moments[name])
            mean, square = (t * known.view(-1, *[1] * (t.dim() - 1)) for t in taken)
            self.moments[name] = mean, square
        cloud.background = self.cloud.background
        self.cloud = cloud

    def restart(self, values: Mapping[str, Tensor]) -> None:
        """Set parameters to other values and all moments to zero.

        Args:
            values: Values by name, of as many Gaussians as they have; names of effects that are not modelled any more
                are ignored.
        """
        owners, known = self.effects.models | {"": self.cloud}, self.parameters()
        for name in values.keys() & known.keys():
            owner, _, own_name = name.rpartition(".")
            setattr(owners[owner], own_name, values[name].clone().requires_grad_())
        self.moments = {
            name: (torch.zeros_like(value.detach()), torch.zeros_like(value.detach()))
            for name, value in self.parameters().items()
        }
        self.steps = 0

    def state_tensors(self) -> dict[str, Tensor]:
        """Return moments and step count, named for a checkpoint."""
        tensors = {"adam.steps": torch.tensor(self.steps)}
        for name, pair in self.moments.items():
            tensors |= {f"adam.{name}.{moment}": value for moment, value in zip(MOMENTS, pair, strict=True)}
        return tensors

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        """Read what `state_tensors` returned."""
        self.steps = int(tensors["adam.steps"])
        for name, parameter in self.parameters().items():
            mean, square = (tensors[f"adam.{name}.{moment}"].to(parameter.device, copy=True) for moment in MOMENTS)
            self.moments[name] = mean, square


def epsilon_of(name: str, epsilon: float) -> float:
    """Return what is added to the root of the second moment of a parameter, where `epsilon` is to that of DAMPED."""
    return epsilon if name in DAMPED else EPS


def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rate: float,
    step: int,
    backend: str = "auto",
    epsilon: float = EPS,
) -> None:
    """Update one parameter and its moments in place by one step of Adam.

    Args:
        parameter: Contiguous tensor of any shape.
        gradient: Its gradient, of the same shape.
        exp_avg: First moment, contiguous, of the same shape.
        exp_avg_sq: Second moment, contiguous, of the same shape.
        rate: Step size.
        step: Number of the step, from 1.
        backend: What computes.
        epsilon: Added to the root of the second moment.
    """
    kernels = kernels_for(backend, parameter)
    kernels.adam_step(parameter, gradient, exp_avg, exp_avg_sq, rate, *BETAS, epsilon, step)
