"""Jobs as child processes of this machine, as many at once as memory and cores allow."""

import time
from collections.abc import Sequence
from dataclasses import replace

from ...base.computer_memory import free_memory
from ...base.isolation import ROOT
from ...base.threads import available_cores
from ...kernels.hardware import hardware_for
from ...training.pacing.memory import USABLE_FRACTION
from .child import Child, end
from .protocol import BAD_INPUT, KILLED, Ended, Job, Machine, cores_for_each, result_of

POLL_SECONDS = 0.1
"""Time between two looks whether a job has ended."""


class LocalExecutor:
    """Runs jobs on this machine.

    Args:
        backend: `backend` of the survey's settings: memory is that of the hardware on which blocks are trained.
        most: Number of jobs that run at the same time at most; None for as many as memory and cores allow.
    """

    def __init__(self, backend: str, most: int | None = None) -> None:
        self._hardware, self._most = hardware_for(backend), most
        self._threads = self._at_once = 1
        self._children: dict[str, Child] = {}

    def divide(self, jobs: Sequence[Job]) -> None:
        """Divide the cores; a job that needs more memory than is free runs alone, and is reduced to what is free."""
        free = [free for free in (free_memory(), self._hardware.free_memory()) if free is not None]
        memory = max(job.memory for job in jobs)
        usable = max(memory, int(USABLE_FRACTION * min(free))) if free else memory * len(jobs)
        machine = Machine(available_cores(), usable, self._most or len(jobs))
        self._threads = cores_for_each([machine], memory, len(jobs))
        self._at_once = min(len(jobs), machine.fitting(self._threads, memory))

    def room(self) -> int:
        """Return how many more jobs may be started now."""
        return self._at_once - len(self._children)

    def start(self, job: Job) -> None:
        """Start a job as a child process."""
        self._children[job.name] = Child(job.words(), self._threads, str(ROOT))

    def ended(self, seconds: float) -> list[Ended]:
        """Return the jobs that have ended, each once; wait for the first of them for so many seconds.

        Where the system killed one, there is one less at once from then on.
        """
        until = time.monotonic() + seconds
        while all(child.running() for child in self._children.values()) and time.monotonic() < until:
            time.sleep(POLL_SECONDS)
        names = [name for name, child in self._children.items() if not child.running()]
        ended = [result_of(name, self._children.pop(name).exit()) for name in names]
        if self._children and any(job.code == KILLED for job in ended):
            self._at_once = max(1, self._at_once - 1)
        return [replace(job, final=job.code == BAD_INPUT) for job in ended]

    def cancel(self) -> None:
        """Ask all jobs to end with what exists kept, and wait for it; those that do not end are killed."""
        end(list(self._children.values()))
        for child in self._children.values():
            child.exit()
        self._children.clear()

    def close(self) -> None:
        """Kill the jobs that are left."""
        for child in self._children.values():
            child.kill()
            child.exit()
        self._children.clear()

    def describe(self) -> str:
        """Return how many jobs run at once, and with how many threads."""
        threads = "1 thread" if self._threads == 1 else f"{self._threads} threads"
        return f"{self._at_once} at once with {threads} each"
