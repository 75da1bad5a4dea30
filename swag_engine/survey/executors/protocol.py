"""What an executor does, and how cores and memory are divided among jobs."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from . import child

JOB = ("-m", __package__.partition(".")[0], "survey", "block")
"""Words after the name of Python that start a job; the folder of the survey and the name of the block follow."""

BAD_INPUT = 2
"""Exit code of a job that cannot use its input; failed.json and its output say why."""
KILLED = 137
"""Exit code of a job that SIGKILL ended, as the system does where memory runs out."""


@dataclass(frozen=True)
class Job:
    """A block, or the coarse model, that is to be trained.

    Attributes:
        folder: Folder of the survey.
        name: Name of the block.
        memory: Estimate of the memory that it needs, bytes.
    """

    folder: Path
    name: str
    memory: int

    def words(self) -> list[str]:
        """Return the words after the name of Python that start the job."""
        return [*JOB, str(self.folder), "--block", self.name, "--json"]


@dataclass(frozen=True)
class Ended:
    """A job whose process has ended.

    Attributes:
        name: Name of the block.
        code: Exit code as shells count: 0 done or at work elsewhere, 1 a bug, 2 bad input, 128 and the signal.
        problem: A sentence, empty for exit code 0.
        final: Whether another attempt would fail the same way.
        where: Node on which it ran, empty for this machine.
    """

    name: str
    code: int
    problem: str = ""
    final: bool = False
    where: str = ""


@dataclass(frozen=True)
class Machine:
    """What jobs may use of a machine.

    Attributes:
        cores: Processor cores.
        memory: Memory, bytes; for jobs on a graphics card the card's.
        most: Number of jobs that it runs at the same time at most.
    """

    cores: int
    memory: int
    most: int = sys.maxsize

    def fitting(self, cores: int, memory: int) -> int:
        """Return how many jobs it runs at the same time.

        Args:
            cores: Cores for each.
            memory: Memory for each, bytes.
        """
        return min(self.cores // cores, self.memory // max(1, memory), self.most)


class Executor(Protocol):
    """Runs jobs as processes of their own, on one machine or on many."""

    def divide(self, jobs: Sequence[Job]) -> None:
        """Divide cores and memory among jobs, before the first of them is started.

        Raises:
            InputError: If there is no machine for them.
        """

    def room(self) -> int:
        """Return how many more jobs may be started now."""

    def start(self, job: Job) -> None:
        """Start a job."""

    def ended(self, seconds: float) -> list[Ended]:
        """Return the jobs that have ended, each once; wait for the first of them for so many seconds."""

    def cancel(self) -> None:
        """Ask all jobs to end with what exists kept, and wait for it; those that do not end are killed."""

    def close(self) -> None:
        """Kill the jobs that are left, and release the machines."""

    def describe(self) -> str:
        """Return what jobs run on, for the user, such as `2 jobs at once with 4 threads each`."""


def cores_for_each(machines: Sequence[Machine], memory: int, jobs: int) -> int:
    """Choose how many cores each job gets: as few cores as possible stay idle, then as many jobs as possible run.

    Args:
        machines: The machines.
        memory: Memory of the largest job, bytes.
        jobs: Number of jobs.

    Returns:
        Number of cores, 0 where no machine has the memory.
    """

    def used(cores: int) -> tuple[int, int]:
        at_once = min(jobs, sum(machine.fitting(cores, memory) for machine in machines))
        return at_once * cores, at_once

    best = max(range(1, max(machine.cores for machine in machines) + 1), key=used)
    return best if used(best)[1] else 0


def result_of(name: str, exit_: child.Exit, where: str = "") -> Ended:
    """Say how a job has ended.

    Args:
        name: Name of the block.
        exit_: Exit code and output of its process.
        where: Node on which it ran.
    """
    code = exit_.code if exit_.code >= 0 else 128 - exit_.code
    if code == 0:
        return Ended(name, code, where=where)
    last = (exit_.errors.strip().splitlines() or ["it printed nothing"])[-1]
    if exit_.error:
        problem = exit_.error
    elif code == KILLED:
        problem = "The system ended its process (SIGKILL), most often because memory ran out."
    elif code > 128:
        problem = f"Signal {code - 128} ended its process; its last line: {last}"
    else:
        problem = f"Its process ended with exit code {code}; its last line: {last}"
    return Ended(name, code, f"On node {where}: {problem}" if where else problem, where=where)
