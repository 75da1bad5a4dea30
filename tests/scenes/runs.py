"""Training in tests with parts of the trainer exchanged."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from swag_engine.base.files import claimed
from swag_engine.formats.run_folder import RunFolder
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.schedule import Schedule
from swag_engine.training.trainer import Trainer, make_trainer


def train_with(
    scene: Path,
    out: Path,
    settings: TrainSettings,
    change: Callable[[Trainer], None] = lambda trainer: None,
    *,
    resume: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
    schedule: Schedule | None = None,
) -> dict[str, Any]:
    """Train a scene as `train` does, after `change` has been given the trainer; returns the `result` event."""
    with claimed(out):
        trainer = make_trainer(
            RunFolder(out), scene, settings, resume, lambda event: None, None, time.monotonic(), schedule or Schedule()
        )
        change(trainer)
        return trainer.run_to_end(should_stop, preview=False)
