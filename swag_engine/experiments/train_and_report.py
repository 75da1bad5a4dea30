"""Training with what users get around it: the outcome beside the forecast, and a report."""

import sys
import time
from collections.abc import Callable
from pathlib import Path

from ..base.text import printable
from ..settings.settings import TrainSettings
from ..training.trainer import Event, train
from .forecast import expected_outcome, record_outcome
from .report import try_write_report


def train_and_report(
    scene_folder: Path,
    out: Path,
    settings: TrainSettings,
    resume: bool,
    on_event: Callable[[Event], None],
    should_stop: Callable[[], bool],
    preview: bool = False,
    weights_dir: Path | None = None,
    started: float | None = None,
    should_stop_now: Callable[[], bool] = lambda: False,
) -> Event:
    """Train a scene, keep the outcome for later forecasts and write the report.

    Args:
        scene_folder: Folder of the scene.
        out: Folder of the run.
        settings: What the user chose.
        resume: Continue the run in `out`.
        on_event: Gets events as they happen.
        should_stop: Asked between two iterations.
        preview: Write splats for a live preview.
        weights_dir: Folder where networks are searched first.
        started: time.monotonic() that a time budget counts from, now without it.
        should_stop_now: Asked during the evaluation at the end; it stops, and the report says so.

    Returns:
        The `result` event of `train` with the path of the report, None where it could not be written.

    Raises:
        InputError: As `train`.
    """
    started = time.monotonic() if started is None else started
    expected = None if resume else expected_outcome(scene_folder, settings)
    result = train(
        scene_folder, out, settings, resume, on_event, should_stop, preview, weights_dir, started, should_stop_now
    )
    text = {"text": "Writing the report", "iteration": 1, "iterations": 1}
    on_event({"event": "progress", "stage": "evaluate"} | text)
    record_outcome(out, expected, time.monotonic() - started)
    report, problem = try_write_report(out)
    if problem:
        print(printable(problem), file=sys.stderr)
    return result | {"report": report and str(report)}
