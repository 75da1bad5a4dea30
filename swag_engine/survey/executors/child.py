"""The child process of a job. Standard library only, and no imports of the engine: Ray sends this file to its nodes."""

import ctypes
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

GRACE_SECONDS = 60.0
"""Time in which a process that was asked to end may finish an iteration and write a checkpoint."""
POLL_SECONDS = 0.1
"""Time between two looks whether a process has ended."""
TAIL_BYTES = 4000
"""Bytes of the end of the error output that are kept."""


@dataclass(frozen=True)
class Exit:
    """How a process has ended.

    Attributes:
        code: Exit code; minus the signal that ended it.
        error: `error` of the JSON document that it printed, empty without one.
        errors: The end of its error output.
    """

    code: int
    error: str
    errors: str


class Child:
    """A job's process. It gets SIGTERM where its parent dies (Linux), so that no job goes on unseen.

    Args:
        words: Words of the command after the name of Python.
        threads: Number of threads.
        root: Folder from which Python imports the engine where this machine has it; without it the installed engine.
    """

    def __init__(self, words: Sequence[str], threads: int, root: str) -> None:
        self._output, self._errors = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115 (see `exit`)
        search = [root if os.path.isdir(root) else "", os.environ.get("PYTHONPATH", "")]
        environment = os.environ | {
            "OMP_NUM_THREADS": str(threads),
            "PYTHONIOENCODING": "utf-8",
            "PYTHONPATH": os.pathsep.join(filter(None, search)),
            "PYTHONSAFEPATH": "1",  # nothing is imported from the current folder
        }
        # In a session of its own: Ctrl-C reaches the parent alone, which asks each child once.
        self._process = subprocess.Popen(
            [sys.executable, *words], stdin=subprocess.DEVNULL, stdout=self._output, stderr=self._errors,
            env=environment, start_new_session=True, preexec_fn=_end_with_parent(),
        )  # fmt: skip

    def running(self) -> bool:
        """Return whether the process runs."""
        return self._process.poll() is None

    def exit(self) -> Exit:
        """Return how the process has ended. Call it once, when it does not run any more."""
        code = self._process.wait()
        with self._output, self._errors:
            self._output.seek(0)
            output = self._output.read()
            self._errors.seek(max(0, self._errors.seek(0, os.SEEK_END) - TAIL_BYTES))
            errors = self._errors.read().decode("utf-8", "replace")
        try:
            error = str(json.loads(output).get("error", ""))
        except (ValueError, AttributeError):
            error = ""
        return Exit(code, error, errors)

    def terminate(self) -> None:
        """Ask the process to end with what exists kept; on Windows it ends at once."""
        self._process.terminate()

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()


def run(words: Sequence[str], threads: int, root: str) -> Exit:
    """Run a job's process until it ends; an interrupt, with which Ray cancels, ends it too.

    Call it in the main thread.

    Args:
        words: As `Child` takes them.
        threads: As `Child` takes them.
        root: As `Child` takes it.

    Raises:
        KeyboardInterrupt: There was an interrupt; the process has ended.
    """
    # Interrupts are only noted: one that comes while the process starts would leave it with nobody to end it, and Ray
    # may interrupt more than once, which must not shorten the time that it has to end. Processes that a shell starts in
    # the background ignore interrupts, Ray's among them; with a handler they notice them.
    interrupts: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: interrupts.append(number))
    try:
        child = Child(words, threads, root)
        try:
            while child.running() and not interrupts:
                time.sleep(POLL_SECONDS)
        finally:
            end([child])
        if interrupts:
            raise KeyboardInterrupt
        return child.exit()
    finally:
        signal.signal(signal.SIGINT, before)


def run_on_node(words: Sequence[str], threads: int, root: str) -> tuple[str, str, tuple[int, str, str]]:
    """Run a job's process as a Ray task.

    Args:
        words: As `Child` takes them.
        threads: As `Child` takes them.
        root: As `Child` takes it.

    Returns:
        Ray's name of the node, the name of its machine, and the values of `Exit`.
    """
    import ray

    node, ended = ray.get_runtime_context().get_node_id(), run(words, threads, root)
    return node, platform.node(), (ended.code, ended.error, ended.errors)


def end(children: Sequence[Child]) -> None:
    """Ask processes to end, wait for them, and kill those that do not end."""
    try:
        for child in children:
            child.terminate()
        until = time.monotonic() + GRACE_SECONDS
        while time.monotonic() < until and any(child.running() for child in children):
            time.sleep(POLL_SECONDS)
    finally:
        for child in children:
            child.kill()


def _end_with_parent() -> Callable[[], None] | None:
    """Return a function for a new process to call, after which it gets SIGTERM where its parent dies; Linux only."""
    if sys.platform != "linux":
        return None
    set_option, parent = ctypes.CDLL(None).prctl, os.getpid()

    def ask() -> None:
        set_option(1, signal.SIGTERM)  # 1: PR_SET_PDEATHSIG
        if os.getppid() != parent:  # it has died in between
            os._exit(128 + signal.SIGTERM)

    return ask
