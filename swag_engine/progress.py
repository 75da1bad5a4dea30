"""Progress bars of the command line, on stderr."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn


@contextmanager
def fraction_bar() -> Iterator[Callable[[str, float], None]]:
    """Yield a function of (stage, fraction 0..1) that draws a bar."""
    with make_progress("{task.description}") as progress:
        task = progress.add_task("Starting", total=1.0)

        def update(stage: str, fraction: float) -> None:
            progress.update(task, description=stage, completed=fraction)

        yield update


@contextmanager
def training_bar() -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yield a function that takes the events of a training run and draws a bar of its `progress` events.

    Nothing is drawn before the first of them, so that an unusable scene leaves its sentence alone on the screen.
    """
    progress = make_progress("{task.description}")
    task = progress.add_task("", total=None)

    def update(event: dict[str, Any]) -> None:
        if event["event"] == "progress":
            progress.start()
            line = progress_line(event)
            progress.update(task, description=line, completed=event["iteration"], total=event["iterations"])

    try:
        yield update
    finally:
        progress.stop()


def make_progress(text: str) -> Progress:
    console = Console(stderr=True, soft_wrap=not sys.stderr.isatty())
    return Progress(TextColumn(text), BarColumn(bar_width=24), TaskProgressColumn(), console=console)


def progress_line(event: dict[str, Any]) -> str:
    """One `progress` event in words."""
    if event["stage"] == "load":
        return f"Photograph {event['iteration']} of {event['iterations']}"
    psnr = f"{event['psnr']:.2f} dB" if event["psnr"] is not None else "..."
    minutes, seconds = divmod(round(event["seconds_left"]), 60)
    return (
        f"loss {event['loss']:.4f}  validation {psnr}  {event['gaussians']} Gaussians  "
        f"{event['iterations_per_second']:.1f} it/s  {minutes}:{seconds:02d} left"
    )
