"""Adam over a cloud whose number of Gaussians changes."""

import torch
from torch import Tensor

from ..gaussians.cloud import GaussianCloud
from ..gaussians.grow import PER_GAUSSIAN
from .config import LearningRates

MOMENTS = ("exp_avg", "exp_avg_sq")


class CloudOptimizer:
    """Adam (arXiv 1412.6980) with one learning rate a parameter; its moments follow the Gaussians through growth.

    cloud: optimised in place. median_range: scene units that the means' learning rate is given in.
    """

    def __init__(self, cloud: GaussianCloud, rates: LearningRates, median_range: float) -> None:
        self.rates = rates
        self.median_range = median_range
        self.cloud = cloud
        groups = []
        for name, parameter in cloud.parameters().items():
            setattr(cloud, name, parameter.detach().requires_grad_())
            groups.append({"params": [getattr(cloud, name)], "name": name, "lr": getattr(rates, name)})
        self.adam = torch.optim.Adam(groups, eps=1e-15, fused=True)

    def step(self, fraction: float) -> None:
        """One update from the gradients that are there, `fraction` (0..1) of the way through the run; clears them."""
        for group in self.adam.param_groups:
            if group["name"] == "means":
                decay = (self.rates.means_end / self.rates.means) ** fraction
                group["lr"] = self.rates.means * decay * self.median_range
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)

    def replace(self, cloud: GaussianCloud, source: Tensor) -> None:
        """Go on with another cloud. source (N',): index of the Gaussian whose moments each one takes, -1 for none."""
        known = source >= 0
        for group in self.adam.param_groups:
            name = group["name"]
            if name not in PER_GAUSSIAN:
                continue
            state = self.adam.state.pop(group["params"][0], {})
            parameter = getattr(cloud, name).detach().requires_grad_()
            for moment in MOMENTS:
                if moment in state:
                    taken = state[moment][source.clamp(min=0)]
                    state[moment] = torch.where(
                        known.view(-1, *[1] * (taken.dim() - 1)), taken, torch.zeros_like(taken)
                    )
            group["params"][0] = parameter
            if state:
                self.adam.state[parameter] = state
            setattr(cloud, name, parameter)
        cloud.background = self.cloud.background
        self.cloud = cloud

    def state_tensors(self) -> dict[str, Tensor]:
        """Moments and step counts, named for a checkpoint."""
        tensors = {}
        for group in self.adam.param_groups:
            for key, value in self.adam.state.get(group["params"][0], {}).items():
                tensors[f"adam.{group['name']}.{key}"] = value
        return tensors

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Take up what `state_tensors` gave."""
        for group in self.adam.param_groups:
            prefix = f"adam.{group['name']}."
            state = {key[len(prefix) :]: value.clone() for key, value in tensors.items() if key.startswith(prefix)}
            if state:
                self.adam.state[group["params"][0]] = state
