"""Adam over a cloud whose number of Gaussians changes, and over the water."""

import torch
from torch import Tensor

from ..gaussians.cloud import GaussianCloud
from ..gaussians.grow import PER_GAUSSIAN
from ..rasterize.backends import kernels_for
from ..water.medium import Medium
from ..water.network import WaterNetwork

MOMENTS = ("exp_avg", "exp_avg_sq")
BETAS = (0.9, 0.999)
EPS = 1e-15


class Optimizer:
    """Adam (arXiv 1412.6980) with one learning rate a parameter; its moments follow the Gaussians through growth.

    cloud and medium (None: no water): optimised in place.
    """

    def __init__(self, cloud: GaussianCloud, medium: Medium | WaterNetwork | None, backend: str = "auto") -> None:
        self.backend = backend
        self.cloud = cloud
        self.medium = medium
        self.steps = 0
        for owner in (cloud, medium) if medium else (cloud,):
            for name, parameter in owner.parameters().items():
                setattr(owner, name, parameter.detach().contiguous().requires_grad_())
        self.moments = {
            name: (torch.zeros_like(parameter.detach()), torch.zeros_like(parameter.detach()))
            for name, parameter in self.parameters().items()
        }

    def parameters(self) -> dict[str, Tensor]:
        """Name -> tensor; those of the medium begin with "medium."."""
        medium = self.medium.parameters() if self.medium else {}
        return self.cloud.parameters() | {f"medium.{name}": tensor for name, tensor in medium.items()}

    def step(self, rates: dict[str, float]) -> None:
        """One update of the parameters that have a rate and a gradient; clears all gradients.

        All Gaussians move, not only those that the view shows: that scores .3 dB better on the demo scene.
        """
        self.steps += 1
        for name, parameter in self.parameters().items():
            if parameter.grad is not None and name in rates:
                moments = self.moments[name]
                adam_step(parameter.detach(), parameter.grad, *moments, rates[name], self.steps, self.backend)
        self.clear_gradients()

    def clear_gradients(self) -> None:
        for parameter in self.parameters().values():
            parameter.grad = None

    def replace(self, cloud: GaussianCloud, source: Tensor) -> None:
        """Go on with another cloud. source (N',): index of the Gaussian whose moments each one takes, -1 for none."""
        known = source >= 0
        for name in PER_GAUSSIAN:
            setattr(cloud, name, getattr(cloud, name).detach().contiguous().requires_grad_())
            taken = (moment[source.clamp(min=0)] for moment in self.moments[name])
            mean, square = (t * known.view(-1, *[1] * (t.dim() - 1)) for t in taken)
            self.moments[name] = mean, square
        cloud.background = self.cloud.background
        self.cloud = cloud

    def restart(self, values: dict[str, Tensor]) -> None:
        """Take up other values, named as by parameters(), of as many Gaussians as they have; Adam begins anew."""
        for name, value in values.items():
            owner = self.medium if name.startswith("medium.") else self.cloud
            setattr(owner, name.removeprefix("medium."), value.clone().requires_grad_())
            self.moments[name] = torch.zeros_like(value), torch.zeros_like(value)
        self.steps = 0

    def state_tensors(self) -> dict[str, Tensor]:
        """Moments and the step count, named for a checkpoint."""
        tensors = {"adam.steps": torch.tensor(self.steps)}
        for name, pair in self.moments.items():
            tensors |= {f"adam.{name}.{moment}": value for moment, value in zip(MOMENTS, pair, strict=True)}
        return tensors

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Take up what `state_tensors` gave."""
        self.steps = int(tensors["adam.steps"])
        for name, parameter in self.parameters().items():
            mean, square = (tensors[f"adam.{name}.{moment}"].to(parameter.device, copy=True) for moment in MOMENTS)
            self.moments[name] = mean, square


def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rate: float,
    step: int,
    backend: str = "auto",
) -> None:
    """One Adam step, in place, of `parameter` and its two moments, contiguous and of one shape. step counts from 1."""
    if kernels := kernels_for(backend, parameter):
        kernels.adam_step(parameter, gradient, exp_avg, exp_avg_sq, rate, *BETAS, EPS, step)
        return
    exp_avg.lerp_(gradient, 1 - BETAS[0])
    exp_avg_sq.lerp_(gradient * gradient, 1 - BETAS[1])
    root = (exp_avg_sq / (1 - BETAS[1] ** step)).sqrt() + EPS
    parameter.sub_(rate / (1 - BETAS[0] ** step) * exp_avg / root)
