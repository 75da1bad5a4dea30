"""A training as users start it: what was forecast is kept beside what came out, and a report follows."""

import sys
import time
from collections.abc import Callable
from pathlib import Path

from ..settings.settings import TrainSettings
from ..training.trainer import Event, train
from .forecast import expectation, record
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
) -> Event:
    """As training.loop.train; the result event has the path of the report beside, None where none could be written."""
    started = time.monotonic() if started is None else started
    expected = None if resume else expectation(scene_folder, settings)
    result = train(scene_folder, out, settings, resume, on_event, should_stop, preview, weights_dir, started)
    record(out, expected, time.monotonic() - started)
    report, problem = try_write_report(out)
    if problem:
        print(problem, file=sys.stderr)
    return result | {"report": report and str(report)}
