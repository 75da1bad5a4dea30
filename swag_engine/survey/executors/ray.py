"""Jobs on the nodes of a Ray cluster. Needs the extra `ray`.

A Ray task is no more than a child process on its node: a crash of native code kills no Ray worker. Nothing but words
travels through Ray; splats and progress are files in the survey's folder, which every node reaches by the same path.
"""

import logging
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from http.client import HTTPConnection
from typing import Any

from ...base.errors import InputError
from ...base.isolation import ROOT
from . import child
from .protocol import BAD_INPUT, Ended, Job, Machine, cores_for_each, result_of

NODE_LOSSES = 20
"""How often Ray starts a job again because its node is gone (spot machines); not counted as a failed attempt."""
STORE_BYTES = 100 * 2**20
"""Shared memory of a cluster on this machine, bytes: only words travel through it; Ray takes no less than 75 MiB."""
PORT = 6379
"""Port of a Ray cluster's head where the address names none: that of `ray start --head`."""

QUIET: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
"""Options with which Ray writes nothing but errors."""
CONNECT_SECONDS = 10.0
"""Time in which the head of a cluster must answer."""
ASKED_AGAIN_SECONDS = 15.0
"""After this time jobs that have not ended are asked again: on a busy machine Ray's request sometimes has no effect."""


class RayExecutor:
    """Runs jobs on the nodes of a Ray cluster.

    Args:
        backend: `backend` of the survey's settings. Each job gets a graphics card for `cuda`, and for `auto` where the
            cluster has cards; none for the others.
        address: `auto` for the cluster that this machine belongs to, or HOST[:PORT] of its head; None to start one on
            this machine.

    Raises:
        InputError: If Ray is not installed, or the cluster cannot be reached.
    """

    def __init__(self, backend: str, address: str | None = None) -> None:
        if sys.platform != "linux":
            raise InputError("Ray has clusters on Linux only: use --executor local here.")
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster of its own reports nothing to Ray's makers
        try:
            import ray
        except ImportError as error:
            raise InputError(
                f"{sys.executable} lacks the package ray: install it with {sys.executable} -m pip install ray, or use "
                "--executor local."
            ) from error
        self._ray, self._backend = ray, backend
        on_sigterm = signal.getsignal(signal.SIGTERM)
        if address is None:
            ray.init("local", include_dashboard=False, object_store_memory=STORE_BYTES, **QUIET)
        else:
            _join(ray, address)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, on_sigterm)  # Ray has put one of its own there
        # Ray prints on stdout when a node is lost; that is for the command's answer alone. Its logs have it too.
        self._silence = redirect_stdout(open(os.devnull, "w"))  # noqa: SIM115 (until `close`)
        self._silence.__enter__()
        ray.cloudpickle.register_pickle_by_value(child)  # nodes may have another version of the engine, or none
        self._tasks: dict[Any, Job] = {}
        self._refused: dict[str, set[str]] = {}
        self._options: dict[str, Any] = {}
        self._cores = 1

    def divide(self, jobs: Sequence[Job]) -> None:
        """Choose cores, memory and cards for each job."""
        nodes = self._nodes()
        if not nodes:
            raise InputError("The Ray cluster has no node with processor cores: add one with `ray start`.")
        resources = [node["Resources"] for node in nodes]
        cards = self._backend == "cuda" or (
            self._backend in ("auto", "wgpu") and any("GPU" in node for node in resources)
        )
        memory = min(max(job.memory for job in jobs), max(int(node.get("memory", 0)) for node in resources))
        machines = [
            Machine(int(node["CPU"]), int(node.get("memory", 0)), int(node.get("GPU", 0)) if cards else len(jobs))
            for node in resources
        ]
        self._cores = cores_for_each(machines, memory, len(jobs))
        if not self._cores:
            raise InputError("The Ray cluster has no node with a graphics card, which the survey's backend cuda needs.")
        self._options = {
            "num_cpus": self._cores, "num_gpus": int(cards), "memory": memory, "max_retries": NODE_LOSSES,
        }  # fmt: skip

    def room(self) -> int:
        """Return that all jobs may be started now: Ray keeps those for which no node is free."""
        return sys.maxsize

    def start(self, job: Job) -> None:
        """Start a job on a node on which it has not failed yet, where there is one."""
        others = self._others(job.name)
        node = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
        refused = self._refused.get(job.name)
        strategy = node(others[0], soft=True) if refused and others else "DEFAULT"
        task = self._ray.remote(child.run_on_node).options(**self._options, scheduling_strategy=strategy, name=job.name)
        self._tasks[task.remote(job.words(), self._cores, str(ROOT))] = job

    def ended(self, seconds: float) -> list[Ended]:
        """Return the jobs that have ended, each once; wait for the first of them for so many seconds."""
        if not self._tasks:
            time.sleep(seconds)
            return []
        self._ray.wait(list(self._tasks), timeout=seconds)
        ready, _ = self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=0)
        return [self._result(self._tasks.pop(task), task) for task in ready]

    def cancel(self) -> None:
        """Ask all jobs to end with what exists kept, and wait for it; those that do not end are killed."""
        tasks, until = list(self._tasks), time.monotonic() + child.GRACE_SECONDS
        while tasks and time.monotonic() < until:
            for task in tasks:
                self._ray.cancel(task)
            _, tasks = self._ray.wait(tasks, num_returns=len(tasks), timeout=ASKED_AGAIN_SECONDS)
        self._tasks.clear()

    def close(self) -> None:
        """Leave the cluster; Ray then ends what is left, and a cluster of its own."""
        self._tasks.clear()
        self._ray.shutdown()
        self._silence.__exit__(None, None, None)

    def describe(self) -> str:
        """Return the nodes, and what each job gets."""
        nodes = len(self._nodes())
        card = " and a graphics card" if self._options.get("num_gpus") else ""
        threads = "1 thread" if self._cores == 1 else f"{self._cores} threads"
        return f"{nodes} {'node' if nodes == 1 else 'nodes'}, {threads}{card} for each job"

    def _nodes(self) -> list[dict[str, Any]]:
        """Return the nodes that are there and have cores."""
        return [node for node in self._ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= 1]

    def _others(self, name: str) -> list[str]:
        """Return the nodes on which a job fits and has not failed, those with the fewest failures first."""
        failures = Counter(node for refused in self._refused.values() for node in refused)
        wanted = {"CPU": self._cores, "memory": self._options["memory"], "GPU": self._options["num_gpus"]}
        fitting = [
            node["NodeID"]
            for node in self._nodes()
            if all(node["Resources"].get(kind, 0) >= value for kind, value in wanted.items())
        ]
        return sorted(set(fitting) - self._refused.get(name, set()), key=lambda node: (failures[node], node))

    def _result(self, job: Job, task: Any) -> Ended:
        """Say how a job has ended."""
        try:
            node, host, values = self._ray.get(task)
        except self._ray.exceptions.RayError as error:
            return Ended(job.name, 1, f"Ray could not run it: {_first_line(error)}")
        ended = result_of(job.name, child.Exit(*values), host)
        if ended.code == 0:
            return ended
        self._refused.setdefault(job.name, set()).add(node)
        final = ended.code == BAD_INPUT and not self._others(job.name)
        return replace(ended, final=final)


def _join(ray: Any, address: str) -> None:
    """Connect to a cluster.

    Raises:
        InputError: If there is none at the address, or this machine does not belong to it.
    """
    try:
        if address != "auto":
            host, _, port = address.partition(":")
            address = f"{host}:{port or PORT}"
            _answers(host, int(port or PORT))  # Ray would try for minutes
    except (OSError, ValueError) as error:
        raise InputError(
            f"No Ray cluster answers at {address} ({error}): start one with `ray start --head` on one machine, and "
            f"`ray start --address=HOST:{PORT}` on each of the others and on this one."
        ) from error
    try:
        ray.init(address, **QUIET)
    except (OSError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
        raise InputError(
            f"This machine cannot use the Ray cluster {address} ({_first_line(error)}): it needs the same versions of "
            f"Ray and Python, `ray start --address=HOST:{PORT}`, and where the cluster asks for a token the file "
            "~/.ray/auth_token of its head and the environment variable RAY_AUTH_MODE=token."
        ) from error


def _first_line(error: Exception) -> str:
    """Return the first line of an error's message."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def _answers(host: str, port: int) -> None:
    """Raise OSError unless a program answers at a port."""
    connection = HTTPConnection(host, port, timeout=CONNECT_SECONDS)
    connection.connect()
    connection.close()
