"""Progress of the command line on stderr: a bar in a terminal, lines in a log."""

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.text import Text

from ..base.text import BLOCKS, printable, sparkline, time_text

LOG_SECONDS = 10.0
"""Least seconds between two lines of one stage where stderr is no terminal."""
BARS = BLOCKS if (sys.stderr.encoding or "").lower().startswith("utf") else "_.-=*#"
"""Characters of a sparkline that stderr can show, from low to high."""

Show = Callable[[str, str, float], None]
"""A function of the stage of the work, a line of text about it, and how far it is (fraction 0..1)."""


@contextmanager
def progress_display() -> Iterator[Show]:
    """Yield a function that shows progress on stderr: a bar in a terminal, else lines.

    Nothing is drawn before its first call, so that an error in the input is the only line on the screen. As lines,
    the first of each stage is written, and then one every LOG_SECONDS.
    """
    if not sys.stderr.isatty():
        last_stage, written = "", 0.0

        def write(stage: str, text: str, fraction: float) -> None:
            nonlocal last_stage, written
            now = time.monotonic()
            if stage != last_stage or now - written >= LOG_SECONDS:
                last_stage, written = stage, now
                print(f"{100 * fraction:3.0f} %  {printable(text)}", file=sys.stderr, flush=True)

        yield write
        return
    columns = TextColumn("{task.description}", markup=False), BarColumn(bar_width=24), TaskProgressColumn()
    bar = Progress(*columns, console=Console(stderr=True))
    task = bar.add_task("", total=1.0)

    def draw(stage: str, text: str, fraction: float) -> None:
        bar.start()
        bar.update(task, description=printable(text), completed=fraction)

    try:
        yield draw
    finally:
        bar.stop()


@contextmanager
def stage_progress() -> Iterator[Callable[[str, float], None]]:
    """Yield a function that shows the progress of work in stages; it takes the stage and its fraction (0..1)."""
    with progress_display() as show:
        yield lambda stage, fraction: show(stage, stage, fraction)


@contextmanager
def training_progress() -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yield a function that takes the events of a training run and shows its `plan` and `progress` events."""
    with progress_display() as show:

        def update(event: dict[str, Any]) -> None:
            if event["event"] == "plan":
                show("plan", plan_line(event["plan"]), 0.0)
            if event["event"] == "progress":
                show(event["stage"], progress_line(event), event["iteration"] / event["iterations"])

        yield update


@contextmanager
def survey_progress() -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yield a function that takes the events of `run_survey` and shows a line for each block that is at work."""
    if not sys.stderr.isatty():
        with progress_display() as show:
            yield lambda event: show("survey", "; ".join(survey_lines(event)), survey_fraction(event))
        return
    with Live(console=Console(stderr=True), auto_refresh=False, transient=True) as live:
        yield lambda event: live.update(Text(printable("\n".join(survey_lines(event)))), refresh=True)


def survey_fraction(event: dict[str, Any]) -> float:
    """Return how far a survey is, as a fraction of its iterations.

    Args:
        event: An event of `run_survey`.
    """
    blocks = event["blocks"]
    return sum(block["iteration"] for block in blocks) / max(1, sum(block["iterations"] for block in blocks))


def survey_lines(event: dict[str, Any]) -> list[str]:
    """Return a line about a survey, then one for each block that runs or has failed; the others are counted.

    Args:
        event: An event of `run_survey`.
    """
    blocks = event["blocks"]
    counts = Counter(block["state"] for block in blocks)
    states = [
        f"{counts[state]} {state}" for state in ("done", "running", "begun", "waiting", "failed") if counts[state]
    ]
    left = "" if event["seconds_left"] is None else f", {time_text(event['seconds_left'])} left"
    lines = [f"{', '.join(states)}{left} ({event['executor']})"]
    for block in blocks:
        if block["state"] == "failed":
            lines.append(f"{block['name']}  failed: {block['problem']}")
        elif block["state"] == "running":
            psnr = "" if block["psnr"] is None else f"  PSNR {block['psnr']:.2f} dB"
            seconds = "" if block["seconds_left"] is None else f"  {time_text(block['seconds_left'])} left"
            lines.append(f"{block['name']}  iteration {block['iteration']} of {block['iterations']}{psnr}{seconds}")
    return lines


def plan_line(plan: dict[str, Any]) -> str:
    """Return the effects of a plan that are on, as a sentence.

    Args:
        plan: The plan as in plan.json.
    """
    on = [name.replace("_", " ") for name, effect in plan["effects"].items() if effect["state"] == "on"]
    return f"Effects of this scene: {', '.join(on) or 'none'} (plan.json has the reasons)"


def progress_line(event: dict[str, Any]) -> str:
    """Return a line of text about a training run.

    Args:
        event: A `progress` event.
    """
    if event["stage"] == "load":
        return f"Photo {event['iteration']} of {event['iterations']}"
    if event["stage"] == "evaluate":
        return str(event["text"])
    psnr = "not yet"
    if event["psnr"] is not None:
        psnr = f"{event['psnr']:.2f} dB {sparkline([psnr for *_, psnr in event['curve']], BARS)}"
    gain = event["next_minute_db"]
    if gain is not None:
        psnr += f", {gain:+.2f} dB expected from another minute"
    return (
        f"loss {event['loss']:.4f}  validation PSNR {psnr}  {event['gaussians']} Gaussians  "
        f"{event['iterations_per_second']:.1f} iterations/s  {time_text(event['seconds_left'])} left"
    )
