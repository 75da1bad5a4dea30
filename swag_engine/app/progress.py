"""Progress of the command line, on stderr: a bar in a terminal, a line now and then in a log."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

LOG_SECONDS = 5.0


@contextmanager
def progress_display() -> Iterator[Callable[[str, float, bool], None]]:
    """Yield a function of (text, fraction 0..1, urgent) that shows how far the work is.

    Nothing is drawn before its first call, so that unusable input leaves its sentence alone on the screen. In a log
    a text that is not urgent is left out when another was written less than LOG_SECONDS ago.
    """
    if not sys.stderr.isatty():
        written = -LOG_SECONDS

        def write(text: str, fraction: float, urgent: bool) -> None:
            nonlocal written
            if urgent or time.monotonic() - written >= LOG_SECONDS:
                written = time.monotonic()
                print(f"{100 * fraction:3.0f} %  {text}", file=sys.stderr, flush=True)

        yield write
        return
    columns = TextColumn("{task.description}"), BarColumn(bar_width=24), TaskProgressColumn()
    bar = Progress(*columns, console=Console(stderr=True))
    task = bar.add_task("", total=1.0)

    def draw(text: str, fraction: float, urgent: bool) -> None:
        bar.start()
        bar.update(task, description=text, completed=fraction)

    try:
        yield draw
    finally:
        bar.stop()


@contextmanager
def stage_progress() -> Iterator[Callable[[str, float], None]]:
    """Yield a function of (stage, fraction 0..1 of it)."""
    with progress_display() as show:
        shown = ""

        def update(stage: str, fraction: float) -> None:
            nonlocal shown
            show(stage, fraction, stage != shown)
            shown = stage

        yield update


@contextmanager
def training_progress() -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yield a function that takes the events of a training run and shows its `progress` events."""
    with progress_display() as show:

        def update(event: dict[str, Any]) -> None:
            if event["event"] == "plan":
                show(plan_line(event["plan"]), 0.0, True)
            if event["event"] == "progress":
                done = event["iteration"] == event["iterations"]
                show(progress_line(event), event["iteration"] / event["iterations"], done)

        yield update


def plan_line(plan: dict[str, Any]) -> str:
    """The effects that a `plan` event has on, in words."""
    on = [name.replace("_", " ") for name, effect in plan["effects"].items() if effect["state"] == "on"]
    return f"The scene calls for {', '.join(on) or 'no effect'} (plan.json says why)"


def progress_line(event: dict[str, Any]) -> str:
    """One `progress` event in words."""
    if event["stage"] == "load":
        return f"Photograph {event['iteration']} of {event['iterations']}"
    psnr = f"{event['psnr']:.2f} dB {sparkline(event['curve'])}" if event["psnr"] is not None else "not yet"
    more = event["next_minute_db"]
    if more is not None:
        psnr += f", a minute more: +{more:.2f} dB"
    minutes, seconds = divmod(round(event["seconds_left"]), 60)
    return (
        f"loss {event['loss']:.4f}  validation PSNR {psnr}  {event['gaussians']} Gaussians  "
        f"{event['iterations_per_second']:.1f} iterations/s  {minutes}:{seconds:02d} left"
    )


BARS = "▁▂▃▄▅▆▇█" if (sys.stderr.encoding or "").lower().startswith("utf") else "_.-=*#"


def sparkline(curve: Sequence[tuple[float, float, float]]) -> str:
    """The PSNR of a run so far as a row of bars, one for each validation; curve as in training.clock."""
    values = [psnr for *_, psnr in curve]
    least, most = min(values), max(values)
    steps = len(BARS) - 1
    return "".join(BARS[round(steps * (value - least) / max(most - least, 1e-9))] for value in values)
