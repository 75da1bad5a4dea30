"""Detection of numbers that are not finite and of diverging losses, and the rollback to the last good parameters.

Each iteration the loss and the sums of all gradients are checked before the optimiser moves; a step with a value that
is not finite is skipped. At intervals all parameters and optimiser moments are checked, and whether the loss has
diverged: parameters that pass become the last good ones, others are rolled back and the learning rates are reduced.
"""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.nn.utils import get_total_norm

from ..gaussians.cloud import GaussianCloud
from ..gaussians.densify import PER_GAUSSIAN
from ..scene.cameras import Camera
from .optimizer import Optimizer

CHECKS = 50
"""Full checks in a run; each costs about a third of an iteration."""
LEAST_INTERVAL = 5
"""Iterations between two full checks, at least."""
MOST_INTERVAL = 100
"""Iterations between two full checks, at most."""
MOST_SKIPPED = 10
"""Skipped steps in a row after which the parameters are rolled back: then they are at fault, not single images."""
RATE_REDUCTION = 0.25
"""Factor on the learning rates at each rollback."""
LEAST_RATE_FACTOR = 1e-4
"""Factor on the learning rates below which nothing is learned any more and training stops."""
DIVERGED_FACTOR = 1.5
"""A loss has diverged when it is above this factor times the best so far, plus DIVERGED_OFFSET."""
DIVERGED_OFFSET = 0.03
"""Loss added to the limit of divergence."""
LEAST_FIRST_LOSS = 0.15
"""The first loss counts as at least this much: an easy first image says nothing about the others."""
NAMED = 5
"""Gaussians that a finding names."""

STORED = {"rollbacks": "put_back", "rate_factor": "ease"}
"""Names that checkpoints have for fields of GuardRecord, where they differ."""


@dataclass
class GuardRecord:
    """What the guard has seen in a run.

    Attributes:
        skipped: Steps that were skipped.
        in_a_row: Steps skipped since the last accepted one.
        rollbacks: How often the parameters were rolled back.
        rate_factor: Factor on the learning rates.
        finding: What was wrong last, without a full stop.
        phase: What the losses of this phase are made of; only losses of one phase are compared.
        first: First loss that was compared.
        best: Mean loss of the best window of this phase.
        losses: Sum of the losses of this window.
        count: Losses in this window.
    """

    skipped: int = 0
    in_a_row: int = 0
    rollbacks: int = 0
    rate_factor: float = 1.0
    finding: str = ""
    phase: str = ""
    first: float | None = None
    best: float = 0.0
    losses: float = 0.0
    count: int = 0

    def to_json(self) -> dict[str, Any]:
        """Return a plain dict for a checkpoint."""
        return {STORED.get(entry.name, entry.name): getattr(self, entry.name) for entry in fields(self)}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> "GuardRecord":
        """Read what `to_json` returned."""
        return cls(**{entry.name: stored[STORED.get(entry.name, entry.name)] for entry in fields(cls)})


@dataclass
class GuardedState:
    """The guard's part of a run's state: its record, and copies of the last good parameters by name."""

    record: GuardRecord = field(default_factory=GuardRecord)
    last_good: dict[str, Tensor] = field(default_factory=dict)

    @property
    def training_failed(self) -> bool:
        """Whether the learning rates have become too small for training to continue."""
        return self.record.rate_factor < LEAST_RATE_FACTOR

    def keep(self, optimizer: Optimizer) -> None:
        """Take the optimiser's parameters as the last good ones."""
        self.last_good = copies(optimizer)

    def record_step(self, loss: float, problem: str, image: str, phase: str) -> None:
        """Record the outcome of one step.

        Args:
            loss: Loss of the step.
            problem: What was not finite, empty where the step was accepted.
            image: Name of the training image.
            phase: What the loss is made of; only losses of one phase are compared, and those of phase "" not at all.
        """
        record = self.record
        if problem:
            record.finding = f"{problem} at the image {image}"
            record.skipped += 1
            record.in_a_row += 1
            return
        record.in_a_row = 0
        if not phase:
            return
        if record.first is None:
            record.first = max(loss, LEAST_FIRST_LOSS)
        if phase != record.phase:
            record.phase, record.best, record.losses, record.count = phase, record.first, 0.0, 0
        record.losses += loss
        record.count += 1


class OnDevice(Protocol):
    """Parameters that steps have left on a device, and steps whose outcome the guard has not recorded.

    Attributes:
        names: Parameters that are there, with their moments.
    """

    names: Collection[str]

    def fetch(self, names: Collection[str] | None = None) -> None:
        """Wait for all steps and bring the state's tensors up to date, those of the last good parameters too.

        Args:
            names: Bring only these parameters of the Gaussians, and those of the effects.
        """

    def not_finite(self) -> str:
        """Wait for all steps; name a parameter or moment that is not finite, as a clause, empty where none is."""

    def keep(self) -> None:
        """Take the parameters as the last good ones."""

    def render(self, camera: Camera, sh_degree: int) -> Tensor | None:
        """Render a view without image effects, while the state's effects are up to date.

        Args:
            camera: The camera.
            sh_degree: Degree of the spherical harmonics.

        Returns:
            (H, W, 3) display values on the CPU; None where the device failed.
        """


class Guard:
    """Decides which steps are accepted and when parameters are rolled back.

    Args:
        iterations: Planned iterations of the run.
    """

    def __init__(self, iterations: int) -> None:
        self.interval = min(max(iterations // CHECKS, LEAST_INTERVAL), MOST_INTERVAL)

    def roll_back_if_bad(
        self, guarded: GuardedState, optimizer: Optimizer, iteration: int, on_device: OnDevice | None = None
    ) -> bool:
        """Check the parameters when a check is due, and roll them back to the last good ones if it fails.

        Args:
            guarded: The guard's part of the run's state.
            optimizer: Holds the parameters and moments to check.
            iteration: Iterations done.
            on_device: The parameters, where they are on a device.

        Returns:
            Whether the parameters were rolled back.
        """
        record = guarded.record
        stuck = record.in_a_row >= MOST_SKIPPED
        if not stuck and iteration % self.interval:
            return False
        elsewhere = on_device.not_finite() if on_device else ""
        mean = record.losses / max(record.count, 1)
        tensors = optimizer.parameters() | optimizer.state_tensors()
        if on_device:
            tensors = without(tensors, on_device.names)
        finding = elsewhere or not_finite(tensors)
        if not finding and mean > DIVERGED_FACTOR * record.best + DIVERGED_OFFSET:
            finding = f"the loss rose from {record.best:.3g} to {mean:.3g}"
        if bad := stuck or bool(finding):
            record.finding = f"{finding} by iteration {iteration}" if finding else record.finding
            record.in_a_row = 0
            record.rollbacks += 1
            record.rate_factor *= RATE_REDUCTION
            if on_device:
                on_device.fetch()
            optimizer.restart(guarded.last_good)
        elif record.count:
            record.best = min(record.best, mean)
            if on_device:
                on_device.keep()
                few = without(optimizer.parameters(), on_device.names)
                guarded.last_good |= {name: parameter.detach().clone() for name, parameter in few.items()}
            else:
                guarded.keep(optimizer)
        record.losses, record.count = 0.0, 0
        return bad

    def check_result(self, guarded: GuardedState, optimizer: Optimizer) -> None:
        """Roll back parameters that are not finite before they become the result of a run."""
        if finding := not_finite(optimizer.parameters()):
            guarded.record.finding = finding
            guarded.record.rollbacks += 1
            optimizer.restart(guarded.last_good)

    @staticmethod
    def note(guarded: GuardedState, iteration: int) -> str:
        """Return a sentence for the user on what happened up to `iteration`, empty where nothing did."""
        record = guarded.record
        if not record.finding:
            return ""
        end = (
            f"Training stopped at iteration {iteration} with the last good parameters"
            if guarded.training_failed
            else "Training continued"
        )
        done = f"{record.skipped} steps were skipped and the parameters were rolled back {record.rollbacks} times"
        return f"{end}: {done}, last because {record.finding}."


def step_problem(loss: Tensor, parameters: Mapping[str, Tensor]) -> tuple[float, str]:
    """Check that a loss and the gradients at hand are finite.

    Args:
        loss: The loss, a scalar.
        parameters: Parameters by name, with their gradients.

    Returns:
        The loss as a number, and what is not finite; an empty text where all is.
    """
    gradients = {f"the gradient of {name}": p.grad for name, p in parameters.items() if p.grad is not None}
    # shN's gradient is sh0's times the basis.
    asked = [gradient for name, gradient in gradients.items() if not name.endswith(" shN")]
    value, total = torch.stack([loss.detach(), norm_of_all(asked).to(loss)]).tolist()
    return value, "" if math.isfinite(value + total) else not_finite({"the loss": loss.detach()} | gradients)


def norm_of_all(tensors: Sequence[Tensor]) -> Tensor:
    """Return the norm of tensors together, (): where it is finite, all values are. Far quicker than asking each."""
    return get_total_norm(tensors)


def finite_part(cloud: GaussianCloud) -> GaussianCloud:
    """Drop the Gaussians of a cloud that have a parameter that is not finite."""
    values = {name: getattr(cloud, name) for name in PER_GAUSSIAN}
    finite = torch.stack([torch.isfinite(value.reshape(len(cloud), -1)).all(1) for value in values.values()]).all(0)
    if finite.all():
        return cloud
    return GaussianCloud(**{name: value[finite] for name, value in values.items()}, background=cloud.background)


def copies(optimizer: Optimizer) -> dict[str, Tensor]:
    """Copy the parameters of an optimiser, by name."""
    return {name: parameter.detach().clone() for name, parameter in optimizer.parameters().items()}


def without(tensors: Mapping[str, Tensor], names: Collection[str]) -> dict[str, Tensor]:
    """Return the tensors that belong to none of some parameters, by name."""
    return {name: tensor for name, tensor in tensors.items() if not any(f".{own}." in f".{name}." for own in names)}


def not_finite(tensors: Mapping[str, Tensor]) -> str:
    """Name the first tensor with values that are not finite, and the Gaussians they belong to; empty where none is."""
    if math.isfinite(float(norm_of_all([t.detach() for t in tensors.values() if t.is_floating_point()]))):
        return ""
    for name, tensor in ((name, tensor.detach()) for name, tensor in tensors.items()):
        if math.isfinite(float(tensor.sum())) or not (bad := ~torch.isfinite(tensor)).any():
            continue
        if not any(part in PER_GAUSSIAN for part in re.split("[. ]", name)):
            return f"{name} is not finite"
        rows = bad.reshape(len(bad), -1).any(1).nonzero().squeeze(-1).tolist()
        named = ", ".join(map(str, rows[:NAMED])) + (", ..." if len(rows) > NAMED else "")
        return f"{name} of {len(rows)} Gaussians (number {named}) is not finite"
    return ""
