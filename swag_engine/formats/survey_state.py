"""State of the blocks of a survey, as their files show it. Blender imports it."""

import math
import re
from dataclasses import dataclass
from typing import Any

from ..base.claim import read_claim
from ..base.errors import InputError
from ..base.strict_json import from_json
from .run_folder import read_json
from .survey_folder import State, SurveyFolder


@dataclass(frozen=True)
class Progress:
    """How far a block is.

    Attributes:
        name: Name of the block, or of the coarse model.
        state: Its state.
        iteration: Iterations done.
        iterations: Iterations that it will have.
        seconds: Time trained, s.
        psnr: PSNR of its held-out images, dB: of its test images once it is done; None while it is not known.
        gaussians: Number of its Gaussians, 0 while it is not known.
        beat: Number that the process which works on it counts up; -1 without one.
        problem: Why it failed, empty for other states.
    """

    name: str
    state: State
    iteration: int
    iterations: int
    seconds: float
    psnr: float | None
    gaussians: int
    beat: int
    problem: str

    @property
    def fraction(self) -> float:
        """How much of its iterations is done, 0..1."""
        return min(1.0, self.iteration / max(1, self.iterations))


def progress_of(folder: SurveyFolder, name: str, iterations: int) -> Progress:
    """Read how far a block, or the coarse model, is. Nothing is locked or written.

    A block that was killed counts as running as long as its claim is there: whether `beat` changes from one reading to
    the next tells the two apart, on whatever machine it runs.

    Args:
        folder: The survey.
        name: Name of the block, or COARSE.
        iterations: Iterations that it will have.
    """
    if done := _read(folder.done(name)):
        seconds, gaussians = _number(done.get("seconds")) or 0.0, int(_number(done.get("gaussians")) or 0)
        psnr = _number(done.get("test_psnr"))
        return Progress(name, "done", iterations, iterations, seconds, psnr, gaussians, -1, "")
    state: State = "begun" if folder.run(name).config.exists() else "waiting"
    beat, problem = -1, ""
    if (claim := read_claim(folder.claim(name))) is not None:
        state, beat = "running", claim["beat"] if isinstance(claim.get("beat"), int) else 0
    elif failed := _read(folder.failed(name)):
        state, problem = "failed", str(failed.get("problem", ""))
    entry = _last_entry(folder, name)
    iteration, seconds = int(_number(entry.get("iteration")) or 0), _number(entry.get("seconds")) or 0.0
    psnr, gaussians = _number(entry.get("psnr")), int(_number(entry.get("gaussians")) or 0)
    return Progress(name, state, iteration, iterations, seconds, psnr, gaussians, beat, problem)


def _read(file: Any) -> dict[str, Any] | None:
    try:
        return read_json(file, "missing")
    except InputError:
        return None


def _last_entry(folder: SurveyFolder, name: str) -> dict[str, Any]:
    """Return the last whole line of the run's metrics.jsonl; its last kilobytes are enough."""
    try:
        with open(folder.run(name).metrics_log, "rb") as log:
            log.seek(0, 2)
            log.seek(max(0, log.tell() - 4096))
            lines = re.findall(rb"^\{.*\}$", log.read(), re.MULTILINE)
    except OSError:
        return {}
    for line in reversed(lines):
        try:
            entry = from_json(line)
        except ValueError:
            continue
        if isinstance(entry, dict) and "psnr" in entry:
            return entry
    return {}


def _number(value: Any) -> float | None:
    """Return a finite number, None for anything else that a damaged file may hold."""
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
