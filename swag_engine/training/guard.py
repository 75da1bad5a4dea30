"""What keeps a run alive when a number stops being one: steps are skipped, states taken back, learning rates eased.

Every iteration the loss and the sums of the gradients are looked at before the optimiser moves, and a step with one
that is not finite is left out. Every so often all parameters and moments are looked at, and whether the loss has run
away: what passes is kept as the last good state, what does not is put back to it.
"""

import math
import re
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from ..gaussians.cloud import GaussianCloud
from ..gaussians.densify import PER_GAUSSIAN
from .optimizer import Optimizer

CHECKS = 50
"""Full checks in a run; each costs about a third of an iteration."""
LEAST_APART, MOST_APART = 5, 100
"""Iterations between two full checks."""
SKIPS = 10
"""So many skipped steps one after the other are the state's fault, not the photographs'."""
EASING, LEAST_EASE = 0.25, 1e-4
"""Factor on the learning rates each time the state is put back; at less than LEAST_EASE nothing is learned: stop."""
RISE, SLACK = 1.5, 0.03
"""A loss over RISE times the best so far, plus SLACK, has run away."""
MIDDLING = 0.15
"""A first loss below this was an easy photograph's, or one that was known already: others may well cost this much."""
NAMED = 5
"""Gaussians that a finding names."""


@dataclass
class Watch:
    """What a guard has seen. ease: factor on the learning rates. finding: what was wrong last, without a full stop.
    first: the run's first loss that is compared; best: mean loss of the best window of this phase; losses, count: of
    this window."""

    skipped: int = 0
    in_a_row: int = 0
    put_back: int = 0
    ease: float = 1.0
    finding: str = ""
    phase: str = ""
    first: float | None = None
    best: float = 0.0
    losses: float = 0.0
    count: int = 0


class Guard:
    """Watches over the state of one run. optimizer: holds the state at the start. iterations: of the whole run."""

    def __init__(self, optimizer: Optimizer, iterations: int) -> None:
        self.every = min(max(iterations // CHECKS, LEAST_APART), MOST_APART)
        self.watch = Watch()
        self.good = copies(optimizer)

    @property
    def ease(self) -> float:
        """What the learning rates are to be multiplied with."""
        return self.watch.ease

    @property
    def gives_up(self) -> bool:
        """Whether going on is of no use."""
        return self.watch.ease < LEAST_EASE

    def admits(self, loss: Tensor, optimizer: Optimizer, view: str, phase: str) -> bool:
        """Whether a step may be made with `loss` (a scalar) and the gradients at hand.

        view: name of the photograph. phase: what the loss is made of; only losses of one phase are compared,
        and those of none ("") not at all.
        """
        watch = self.watch
        parameters = optimizer.parameters()
        gradients = {f"the gradient of {name}": p.grad for name, p in parameters.items() if p.grad is not None}
        # A finite sum has finite terms, and is far quicker than asking each. shN's gradient is sh0's times the basis.
        sums = [gradient.sum() for name, gradient in gradients.items() if not name.endswith(" shN")]
        value, total = torch.stack([loss.detach(), *sums]).cumsum(0)[[0, -1]].tolist()
        if not math.isfinite(total) and (finding := not_finite({"the loss": loss.detach()} | gradients)):
            watch.finding = f"{finding} at the photograph {view}"
            watch.skipped += 1
            watch.in_a_row += 1
            return False
        watch.in_a_row = 0
        if not phase:
            return True
        if watch.first is None:
            watch.first = max(value, MIDDLING)
        if phase != watch.phase:
            watch.phase, watch.best, watch.losses, watch.count = phase, watch.first, 0.0, 0
        watch.losses += value
        watch.count += 1
        return True

    def puts_back(self, optimizer: Optimizer, iteration: int) -> bool:
        """To be called after each iteration. Whether the state was put back to the last good one."""
        watch = self.watch
        stuck = watch.in_a_row >= SKIPS
        if not stuck and iteration % self.every:
            return False
        mean = watch.losses / max(watch.count, 1)
        finding = not_finite(optimizer.parameters() | optimizer.state_tensors())
        if not finding and mean > RISE * watch.best + SLACK:
            finding = f"the loss rose from {watch.best:.3g} to {mean:.3g}"
        if bad := stuck or bool(finding):
            watch.finding = f"{finding} by iteration {iteration}" if finding else watch.finding
            watch.in_a_row = 0
            watch.put_back += 1
            watch.ease *= EASING
            optimizer.restart(self.good)
        elif watch.count:
            watch.best = min(watch.best, mean)
            self.keep(optimizer)
        watch.losses, watch.count = 0.0, 0
        return bad

    def keep(self, optimizer: Optimizer) -> None:
        """Take the state as the last good one."""
        self.good = copies(optimizer)

    def settle(self, optimizer: Optimizer) -> None:
        """Before the state becomes a result: one that is not finite is put back to the last good one."""
        if finding := not_finite(optimizer.parameters()):
            self.watch.finding = finding
            self.watch.put_back += 1
            optimizer.restart(self.good)

    def note(self, iteration: int) -> str:
        """A sentence for the user, empty where nothing happened."""
        watch = self.watch
        if not watch.finding:
            return ""
        end = (
            f"Training stopped at iteration {iteration} with the last good state"
            if self.gives_up
            else "Training went on"
        )
        done = f"{watch.skipped} steps were skipped and the state was put back {watch.put_back} times"
        return f"{end}: {done}, last because {watch.finding}."

    def state(self) -> dict[str, Any]:
        """What `load` takes, for JSON."""
        return asdict(self.watch)

    def tensors(self) -> dict[str, Tensor]:
        """The last good state, named for a checkpoint."""
        return {f"guard.{name}": tensor for name, tensor in self.good.items()}

    def load(self, state: dict[str, Any], tensors: dict[str, Tensor], optimizer: Optimizer) -> None:
        """Go on from a checkpoint's state and tensors."""
        self.watch = Watch(**state)
        device = optimizer.cloud.means.device
        self.good = {
            name.removeprefix("guard."): tensor.to(device, copy=True)
            for name, tensor in tensors.items()
            if name.startswith("guard.")
        }


def finite_part(cloud: GaussianCloud) -> GaussianCloud:
    """The cloud without Gaussians that have a parameter that is not finite."""
    values = {name: getattr(cloud, name) for name in PER_GAUSSIAN}
    finite = torch.stack([torch.isfinite(value.reshape(len(cloud), -1)).all(1) for value in values.values()]).all(0)
    if finite.all():
        return cloud
    return GaussianCloud(**{name: value[finite] for name, value in values.items()}, background=cloud.background)


def copies(optimizer: Optimizer) -> dict[str, Tensor]:
    """The parameters as they are."""
    return {name: parameter.detach().clone() for name, parameter in optimizer.parameters().items()}


def not_finite(tensors: dict[str, Tensor]) -> str:
    """Which of the tensors is not finite, and in which Gaussians; empty where all are."""
    for name, tensor in ((name, tensor.detach()) for name, tensor in tensors.items()):
        if math.isfinite(float(tensor.sum())) or not (bad := ~torch.isfinite(tensor)).any():
            continue
        if not any(part in PER_GAUSSIAN for part in re.split("[. ]", name)):
            return f"{name} is not finite"
        rows = bad.reshape(len(bad), -1).any(1).nonzero().squeeze(-1).tolist()
        named = ", ".join(map(str, rows[:NAMED])) + (", ..." if len(rows) > NAMED else "")
        return f"{name} of {len(rows)} Gaussians (number {named}) is not finite"
    return ""
