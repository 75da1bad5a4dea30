"""Training a survey: the coarse model first, then the blocks, then the seams, each in a process of its own.

Whether a block is done is read from the folder alone, so that this program may be ended and started again at any time,
and several of it may work on one survey. No clock of one machine is compared with that of another.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.text import time_text
from ..formats.run_folder import write_json
from ..formats.survey_folder import COARSE, VERSION, Block, Survey, SurveyFolder
from ..formats.survey_state import Progress, progress_of
from ..training.pacing.memory import needed
from ..training.pacing.speed import Extent
from .executors.protocol import Ended, Executor, Job
from .job import check_engine

ATTEMPTS = 3
"""Attempts of a block in which it gets no further than before; then it is left, and the others continue."""
REFRESH_SECONDS = 1.0
"""Time between two reports."""
RECHECK_SECONDS = 30.0
"""Time after which a block on which another process works is looked at again."""


def run_survey(
    folder: Path,
    executor: Executor,
    progress: Callable[[dict[str, Any]], None] = lambda event: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Train what is not done of a survey.

    Args:
        folder: Folder of the survey.
        executor: Where the jobs run; it is closed at the end.
        progress: Called about once a second with {"event": "survey", "blocks", "done", "seconds_left", "executor"}.
            Each of `blocks`, with the coarse model and the seams, is a dict of name, state, iteration, iterations, psnr
            (of validation images, dB), seconds, seconds_left, attempts (those that failed) and problem (a sentence, or
            empty); what is not known is None.
        should_stop: Asked about once a second; once it returns true, all jobs end with what exists kept.

    Returns:
        {"survey", "interrupted", "exit_code", "seconds", "done", "blocks", "sentences"}. `exit_code` is 0 where all is
        done and 2 otherwise. `blocks` is as above. `sentences` says for each failed block how to continue.

    Raises:
        InputError: If the folder is not a survey, it was planned by another version of the engine, or the executor has
            no machine for it.
    """
    started = time.monotonic()
    try:
        run = _SurveyRun(SurveyFolder(folder.absolute()), executor, progress, should_stop)
        run.train()
    finally:
        executor.close()
    return run.document() | {"seconds": round(time.monotonic() - started, 1)}


@dataclass
class _Record:
    """A job, and how its attempts went.

    Attributes:
        job: The job.
        iterations: Number of its iterations.
        attempts: Attempts that failed.
        in_vain: Attempts that failed since it last got further.
        furthest: Iteration that the furthest of them got to.
        problem: Why the last one failed, empty where none did.
        given_up: Whether no other attempt is made.
    """

    job: Job
    iterations: int
    attempts: int = 0
    in_vain: int = 0
    furthest: int = -1
    problem: str = ""
    given_up: bool = False


class _SurveyRun:
    """The jobs of a survey while they run.

    Args:
        files: The survey's folder.
        executor: As `run_survey` takes it.
        progress: As `run_survey` takes it.
        should_stop: As `run_survey` takes it.
    """

    def __init__(
        self,
        files: SurveyFolder,
        executor: Executor,
        progress: Callable[[dict[str, Any]], None],
        should_stop: Callable[[], bool],
    ) -> None:
        survey = files.read()
        check_engine(survey)
        parts = [files.read_block(name) for name in survey.parts]
        coarse = Job(files.path, COARSE, _coarse_memory(survey))
        self._records = {
            COARSE: _Record(coarse, survey.coarse_settings.iterations),
            **{part.name: _Record(Job(files.path, part.name, part.memory), part.iterations) for part in parts},
        }
        # The longest first, so that none of them is left alone at the end.
        ordered = sorted(parts, key=_work, reverse=True)
        blocks, seams = ([part.name for part in ordered if bool(part.sides) == of_seams] for of_seams in (False, True))
        self._stages = [[COARSE], blocks, seams]
        self._files, self._executor = files, executor
        self._progress, self._should_stop = progress, should_stop
        self._finished: dict[str, Progress] = {}
        self._next_report = 0.0
        self._interrupted = False

    def train(self) -> None:
        """Train the coarse model, then the blocks, then the seams."""
        for names in self._stages:
            waiting = [self._records[name].job for name in names if not self._done(name)]
            if waiting:
                self._executor.divide(waiting)
                self._train(waiting)
            if self._interrupted or not all(self._done(name) for name in names):
                return

    def _train(self, waiting: list[Job]) -> None:
        """Train jobs until each is done or given up, or the user stops."""
        running: set[str] = set()
        elsewhere: dict[str, float] = {}
        while waiting or running or elsewhere:
            if self._should_stop():
                self._interrupted = True
                self._executor.cancel()
                return
            now = time.monotonic()
            for name in [name for name, again in elsewhere.items() if again <= now]:
                del elsewhere[name]
                waiting.append(self._records[name].job)
            while waiting and self._executor.room() > 0:
                job = waiting.pop(0)
                if not self._done(job.name):
                    self._executor.start(job)
                    running.add(job.name)
            for ended in self._executor.ended(REFRESH_SECONDS):
                running.discard(ended.name)
                if self._done(ended.name):
                    continue
                if ended.code == 0:
                    elsewhere[ended.name] = time.monotonic() + RECHECK_SECONDS
                elif self._may_try_again(ended):
                    waiting.append(self._records[ended.name].job)
            self._report()

    def _may_try_again(self, ended: Ended) -> bool:
        """Count a failed attempt and return whether there is to be another one; if not, write failed.json."""
        record = self._records[ended.name]
        record.attempts += 1
        record.problem = ended.problem
        iteration = self._progress_of(ended.name).iteration
        record.in_vain = record.in_vain + 1 if iteration <= record.furthest else 1
        record.furthest = max(record.furthest, iteration)
        record.given_up = ended.final or record.in_vain >= ATTEMPTS
        if record.given_up:
            document = {"version": VERSION, "block": ended.name, "problem": ended.problem, "attempts": record.attempts}
            with suppress(InputError):  # where the disk is full, the sentences at the end still say it
                write_json(self._files.failed(ended.name), document)
        return not record.given_up

    def _progress_of(self, name: str) -> Progress:
        """Return how far a job is; the files of one that is done are read once."""
        if name in self._finished:
            return self._finished[name]
        found = progress_of(self._files, name, self._records[name].iterations)
        if found.state == "done":
            self._finished[name] = found
        return found

    def _done(self, name: str) -> bool:
        """Return whether a job is done."""
        return self._progress_of(name).state == "done"

    def _report(self) -> None:
        """Report the progress of all jobs."""
        if time.monotonic() < self._next_report:
            return
        self._next_report = time.monotonic() + REFRESH_SECONDS
        rows = [self._row(name) for name in self._records]
        seconds = sum(row["seconds"] for row in rows)
        iterations = sum(row["iteration"] for row in rows if row["seconds"])
        left = sum(row["iterations"] - row["iteration"] for row in rows if row["state"] != "failed")
        at_once = sum(row["state"] == "running" for row in rows)
        self._progress(
            {
                "event": "survey",
                "blocks": rows,
                "done": sum(row["state"] == "done" for row in rows),
                "seconds_left": seconds / iterations * left / at_once if iterations and at_once else None,
                "executor": self._executor.describe(),
            }
        )

    def _row(self, name: str) -> dict[str, Any]:
        """Return state and progress of a job."""
        record = self._records[name]
        found = self._progress_of(name)
        state = found.state
        if record.given_up and state != "done":
            state = "failed"
        elif state == "failed":
            state = "waiting"  # it is tried again
        left = None
        if state == "running" and found.iteration and found.seconds:
            left = found.seconds / found.iteration * (record.iterations - found.iteration)
        return {
            "name": name, "state": state, "iteration": found.iteration, "iterations": record.iterations,
            "psnr": found.psnr, "seconds": found.seconds, "seconds_left": left, "attempts": record.attempts,
            "problem": record.problem,
        }  # fmt: skip

    def document(self) -> dict[str, Any]:
        """Return the result of `run_survey`."""
        rows = [self._row(name) for name in self._records]
        done = sum(row["state"] == "done" for row in rows)
        return {
            "survey": str(self._files.path),
            "interrupted": self._interrupted,
            "exit_code": 0 if done == len(rows) else 2,
            "done": done,
            "blocks": rows,
            "sentences": [self._sentence(name) for name, record in self._records.items() if record.given_up],
        }

    def _sentence(self, name: str) -> str:
        """Say why a job was given up, and how to continue."""
        record = self._records[name]
        what = "The coarse model" if name == COARSE else f"Seam {name}" if name.startswith("S-") else f"Block {name}"
        times = "at the first attempt" if record.attempts == 1 else f"in {record.attempts} attempts"
        return (
            f"{what} failed {times}: {record.problem} To try it again: survey run {self._files.path}, or survey block "
            f"{self._files.path} --block {name}."
        )


def describe(document: dict[str, Any]) -> str:
    """Format what `run_survey` returned as the lines that `survey run` prints."""
    failed = document["sentences"]
    count = f"{document['done']} of {len(document['blocks'])} jobs are done, {time_text(document['seconds'])}."
    if document["interrupted"]:
        count = f"Interrupted: {count} Started again, survey run continues."
    elif not failed and document["exit_code"] == 0:
        count += f" Next: survey merge {document['survey']}"
    return "\n".join([count, *failed])


def _work(block: Block) -> int:
    """Return what the time of a block is about proportional to."""
    return block.iterations * block.max_gaussians


def _coarse_memory(survey: Survey) -> int:
    """Estimate the memory of the coarse model, bytes; its images count as square, the survey does not say otherwise."""
    width, training = survey.coarse_settings.width, len(survey.coarse_training)
    extent = Extent(training, len(survey.coarse_validation), 0, 1.0, width, width)
    return needed(extent, width, survey.coarse_settings.max_gaussians)
