"""Training in tests with parts of the trainer exchanged."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from swag_engine.base.files import locked_folder
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.init import gaussians_from_points
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.schedule import STANDARD, Schedule
from swag_engine.training.trainer import InitialCloud, Trainer, make_trainer


def training_times(folder: Path) -> dict[str, int]:
    """Return when each run below `folder` was trained: time of change of its metrics.json, ns, by name of the run."""
    return {str(path.parent.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("metrics.json")}


def train_with(
    scene: Path,
    out: Path,
    settings: TrainSettings,
    change: Callable[[Trainer], None] = lambda trainer: None,
    *,
    resume: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
    schedule: Schedule = STANDARD,
    initial_cloud: InitialCloud = gaussians_from_points,
) -> dict[str, Any]:
    """Train a scene as `train` does with another schedule or initial cloud, and with a trainer that `change` was given.

    Returns:
        The `result` event.
    """
    with locked_folder(out):
        trainer = make_trainer(
            RunFolder(out),
            scene,
            settings,
            resume,
            lambda event: None,
            None,
            time.monotonic(),
            schedule,
            initial_cloud,
        )
        change(trainer)
        return trainer.run_to_end(should_stop, preview=False)
