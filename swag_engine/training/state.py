"""State of one training run: all that is learned and all that decides how the run continues."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor

from ..effects.scene_effects import SceneEffects
from ..gaussians.cloud import GaussianCloud
from ..gaussians.densify import DensificationStatistics
from ..rendering.model import SceneModel
from ..scene.images import TrainingImage
from ..settings.recipes import Recipe
from .guard import GuardedState, GuardRecord, OnDevice
from .motion import MotionMasks
from .optimizer import Optimizer
from .pacing.clock import Clock, Point
from .pacing.memory import Relief

CPU = torch.device("cpu")


@dataclass
class RunState:
    """All that changes while a run lasts.

    What is drawn at random depends on the seed and the iteration alone, so there is no random state.

    Attributes:
        optimizer: The Gaussians, the effects and their Adam moments.
        recipe: What the run computes now: the settings' recipe, the plan and `choices`.
        clock: How far the run is.
        guarded: Last good parameters, and what the guard has seen.
        statistics: What densification goes by, collected since the last change of the cloud.
        start_count: Number of Gaussians at the start, without the fixed ones.
        choices: Effects switched on or off by trials.
        trials: Trials that were made, as metrics.json has them.
        motion: Masks of moving objects.
        relief: How the run was reduced after it ran out of memory.
        iteration: Iterations done.
        seconds: Time trained, s.
        budget_spent: Time used of a time budget, s; 0 without one.
        curve: Fraction of the run, seconds and validation PSNR of each validation.
        psnr: Last validation PSNR, dB.
        ssim: Last validation SSIM.
        dropout: Fraction of the Gaussians that each iteration drops.
        water_final: Whether the water stays as it is.
        on_device: Parameters, moments and statistics that steps have left on a device; None where they are up to date.
    """

    optimizer: Optimizer
    recipe: Recipe
    clock: Clock
    guarded: GuardedState
    statistics: DensificationStatistics
    start_count: int
    choices: dict[str, bool] = field(default_factory=dict)
    trials: list[dict[str, Any]] = field(default_factory=list)
    motion: MotionMasks = field(default_factory=MotionMasks)
    relief: Relief = field(default_factory=Relief)
    iteration: int = 0
    seconds: float = 0.0
    budget_spent: float = 0.0
    curve: list[Point] = field(default_factory=list)
    psnr: float | None = None
    ssim: float | None = None
    dropout: float = 0.0
    water_final: bool = False
    on_device: OnDevice | None = None

    def synchronize(self, names: Collection[str] | None = None) -> None:
        """Bring parameters, moments and statistics up to date, in place; to be called before they are read.

        Args:
            names: Parameters of the Gaussians that will be read, beside those of the effects; None for all there is.
        """
        if self.on_device:
            self.on_device.fetch(names)

    @classmethod
    def initial(
        cls,
        model: SceneModel,
        recipe: Recipe,
        choices: dict[str, bool],
        iterations: int,
        start_count: int,
        backend: str,
        fixed: int = 0,
    ) -> "RunState":
        """Make the state at the start of a run.

        Args:
            model: Gaussians and effects at their initial values.
            recipe: What the run computes.
            choices: Effects that trials will decide, off until then.
            iterations: Planned iterations.
            start_count: Number of Gaussians that densification starts from.
            backend: What computes.
            fixed: Number of Gaussians, the last ones of the model, that never change.

        Returns:
            The state.
        """
        optimizer = Optimizer(model.cloud, model.effects, backend, fixed)
        guarded = GuardedState()
        guarded.keep(optimizer)
        statistics = DensificationStatistics.zeros(len(model.cloud), model.cloud.means.device)
        return cls(optimizer, recipe, Clock(iterations), guarded, statistics, start_count, choices)

    @property
    def cloud(self) -> GaussianCloud:
        """The Gaussians."""
        return self.optimizer.cloud

    @property
    def effects(self) -> SceneEffects:
        """The effects that are modelled."""
        return self.optimizer.effects

    @property
    def free_count(self) -> int:
        """Number of Gaussians that may change."""
        return len(self.cloud) - self.optimizer.fixed

    @property
    def free_cloud(self) -> GaussianCloud:
        """The Gaussians that may change, as views of the cloud's tensors."""
        return self.cloud.rows(slice(self.free_count)) if self.optimizer.fixed else self.cloud

    def replace_free(self, cloud: GaussianCloud, source: Tensor) -> None:
        """Continue with other Gaussians in place of those that may change, and with new statistics.

        Args:
            cloud: The Gaussians.
            source: Index (N',) of the Gaussian whose optimiser moments each one takes, -1 for none.
        """
        if self.optimizer.fixed:
            fixed = torch.arange(self.free_count, len(self.cloud), device=source.device)
            cloud, source = cloud.followed_by(self.cloud.rows(fixed)), torch.cat([source, fixed])
        self.optimizer.replace(cloud, source)
        self.reset_statistics()

    def reset_statistics(self) -> None:
        """Forget what densification has collected."""
        self.statistics = DensificationStatistics.zeros(len(self.cloud), self.cloud.means.device)

    def to_checkpoint(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Copy the state to the CPU's memory.

        Returns:
            Tensors by name, and the rest as a plain dict for JSON; `from_checkpoint` takes both.
        """
        self.synchronize()
        tensors = {f"cloud.{name}": tensor for name, tensor in self.cloud.parameters().items()}
        tensors |= self.effects.parameters() | self.motion.tensors() | self.optimizer.state_tensors()
        tensors |= {f"guard.{name}": tensor for name, tensor in self.guarded.last_good.items()}
        tensors |= {"densification.gradient": self.statistics.gradient, "densification.views": self.statistics.views}
        stored = self.effects.state() | {
            "choices": dict(self.choices),
            "trials": list(self.trials),
            "masked": self.motion.searches,
            "iteration": self.iteration,
            "seconds": self.seconds,
            "clock": asdict(self.clock),
            "curve": list(self.curve),
            "spent": self.budget_spent,
            "start_count": self.start_count,
            "fixed": self.optimizer.fixed,
            "psnr": self.psnr,
            "ssim": self.ssim,
            "dropout": self.dropout,
            "water_final": self.water_final,
            "guard": self.guarded.record.to_json(),
            "relief": asdict(self.relief),
        }
        return {name: tensor.detach().to(CPU, copy=True) for name, tensor in tensors.items()}, stored

    @classmethod
    def from_checkpoint(
        cls,
        tensors: dict[str, Tensor],
        stored: dict[str, Any],
        recipe_with: Callable[[dict[str, bool]], Recipe],
        images: Sequence[TrainingImage],
        device: torch.device,
        backend: str,
    ) -> "RunState":
        """Read what `to_checkpoint` returned.

        Args:
            tensors: Tensors by name.
            stored: The rest.
            recipe_with: Gives the recipe for the choices that were stored.
            images: Training images of the run.
            device: Where the run keeps its tensors.
            backend: What computes.

        Returns:
            The state, which shares no memory with the arguments.
        """
        model = SceneModel.from_checkpoint(tensors, stored).to(device)
        optimizer = Optimizer(model.cloud, model.effects, backend, stored.get("fixed", 0))
        optimizer.load_state(tensors)
        last_good = {
            name.removeprefix("guard."): tensor.to(device, copy=True)
            for name, tensor in tensors.items()
            if name.startswith("guard.")
        }
        choices = dict(stored["choices"])
        return cls(
            optimizer=optimizer,
            recipe=recipe_with(choices),
            clock=Clock(**stored["clock"]),
            guarded=GuardedState(GuardRecord.from_json(stored["guard"]), last_good),
            statistics=DensificationStatistics(
                *(tensors[name].to(device, copy=True) for name in ("densification.gradient", "densification.views"))
            ),
            start_count=stored["start_count"],
            choices=choices,
            trials=list(stored["trials"]),
            motion=MotionMasks.from_checkpoint(tensors, stored["masked"], images),
            relief=Relief(**stored["relief"]),
            iteration=stored["iteration"],
            seconds=stored["seconds"],
            budget_spent=stored["spent"],
            curve=[tuple(point) for point in stored["curve"]],
            psnr=stored["psnr"],
            ssim=stored["ssim"],
            dropout=stored["dropout"],
            water_final=stored.get("water_final", False),
        )
