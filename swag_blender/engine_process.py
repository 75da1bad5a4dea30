"""The engine's child process: which Python runs it, how messages travel, how it ends.

Blender and the child exchange one JSON object a line: requests on its stdin, events on its stdout, logs on its stderr.
"""

import atexit
import contextlib
import functools
import importlib.util
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from . import EXTENSION

ROOT = Path(__file__).resolve().parents[1]
# With these a Python is taken to have the whole engine.
PACKAGES = ("torch", "pycolmap")
# Seconds that a cancelled child gets to keep what it has, and that a terminated one gets before it is killed.
CANCEL_SECONDS, TERMINATE_SECONDS = 60.0, 5.0
# Seconds that a child whose stdin has been closed gets to end by itself.
CLOSE_SECONDS = 2.0
NICENESS = 10

_running: set["Engine"] = set()


class EngineError(Exception):
    """The engine did not do what was asked; the message is one sentence for the user."""


def environment_folder() -> Path:
    """Where Install Engine puts its Python environment; it need not exist."""
    return Path(bpy.utils.extension_path_user(EXTENSION)) / "engine"


def environment_python() -> Path:
    name = ("Scripts", "python.exe") if os.name == "nt" else ("bin", "python")
    return environment_folder().joinpath(*name)


def environment_is_whole() -> bool:
    """Whether an installation came to its end: make_environment.py writes installed.json last.

    The Python in it is gone when the Blender that made it is.
    """
    return (environment_folder() / "installed.json").is_file() and environment_python().exists()


@functools.cache
def blender_finds(package: str) -> bool:
    """Whether Blender's own Python can find a package; it is not imported."""
    return importlib.util.find_spec(package) is not None


def engine_python() -> str:
    """Path of the Python that runs the engine.

    The preference comes first, then the variable SWAG_ENGINE_PYTHON, then Blender's own Python if it can find torch,
    then the environment of Install Engine. Raises EngineError when there is none, or when a named one is not there.
    """
    preferences = bpy.context.preferences.addons[EXTENSION].preferences
    for named, place in (
        (bpy.path.abspath(preferences.engine_python), "the preferences of SWAG Splatting"),
        (os.environ.get("SWAG_ENGINE_PYTHON", ""), "the variable SWAG_ENGINE_PYTHON"),
    ):
        if named:
            if os.path.isfile(named) and os.access(named, os.X_OK):
                return named
            raise EngineError(f"The engine's Python {named} cannot be run: correct it in {place}.")
    if all(blender_finds(package) for package in PACKAGES):
        return sys.executable
    if environment_is_whole():
        return str(environment_python())
    raise EngineError(
        "The engine is not installed: press Install Engine in the preferences of SWAG Splatting, or name a Python."
    )


def clean_environment() -> dict[str, str]:
    """Environment variables for the engine: it finds this extension's swag_engine, and none of Blender's Python."""
    kept = {key: value for key, value in os.environ.items() if key not in ("PYTHONHOME", "PYTHONPATH", "LD_PRELOAD")}
    # PYTHONSAFEPATH: modules in the folder that Blender was started from stay out.
    return kept | {"PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1", "PYTHONUNBUFFERED": "1"}


class Engine:
    """A child process that speaks the protocol; `command` is the engine's worker unless said otherwise.

    Raises EngineError when it cannot be started.
    """

    def __init__(self, command: list[str] | None = None) -> None:
        command = command or [engine_python(), "-m", "swag_engine.app.worker"]
        # A session of its own: Ctrl-C in the terminal reaches Blender, which then decides what becomes of the child.
        # A lower priority: the child takes all processors that Blender leaves, and the window stays quick.
        apart: dict[str, Any] = {"start_new_session": True}
        if os.name == "nt":
            apart = {"creationflags": subprocess.CREATE_NO_WINDOW | subprocess.BELOW_NORMAL_PRIORITY_CLASS}
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                encoding="utf-8",
                errors="replace",
                env=clean_environment(),
                **apart,
            )
        except OSError as error:
            raise EngineError(f"The engine's Python {command[0]} cannot be started: {error.strerror}.") from error
        if os.name != "nt":
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)
        self.log: deque[str] = deque(maxlen=200)
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._deadline: float | None = None
        self._terminated = self._ended = False
        self._readers = [
            threading.Thread(target=_read, args=(self._process.stdout, self._lines.put), daemon=True),
            threading.Thread(target=_read, args=(self._process.stderr, _into(self.log)), daemon=True),
        ]
        for reader in self._readers:
            reader.start()
        _running.add(self)

    def send(self, request: dict[str, Any]) -> None:
        """Send one request. A child that has died is noticed by `poll`."""
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()

    def poll(self) -> list[dict[str, Any]]:
        """The events that arrived since the last call; never waits.

        Raises EngineError with the child's last line of log when it has died. An `error` event raises it too.
        """
        events: list[dict[str, Any]] = []
        while not self._ended:
            try:
                line = self._lines.get_nowait()
            except queue.Empty:
                break
            if line is None:
                self._ended = True
                break
            try:
                event = json.loads(line)
                if not isinstance(event, dict):
                    raise ValueError
            except ValueError:
                self.log.append(line)
                continue
            if event.get("event") == "error":
                if event.get("kind") == "bug":
                    self._print_log()
                raise EngineError(event["message"])
            events.append(event)
        if self._ended and not events:
            raise EngineError(self._last_words())
        if self._deadline is not None and time.monotonic() > self._deadline:
            self._end_sooner()
        return events

    def cancel(self) -> None:
        """Ask for a stop that keeps what exists. `poll` goes on; it terminates and then kills a child that is deaf."""
        if self._deadline is None:
            self._deadline = time.monotonic() + CANCEL_SECONDS
            self.send({"request": "cancel"})

    def stop(self) -> None:
        """End the child now, within a few seconds; what it has saved stays."""
        _running.discard(self)
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        for seconds, end in ((CLOSE_SECONDS, self._process.terminate), (TERMINATE_SECONDS, self._process.kill)):
            try:
                self._process.wait(seconds)
                break
            except subprocess.TimeoutExpired:
                end()
        self._process.wait()
        for reader in self._readers:
            reader.join(1.0)

    def __enter__(self) -> "Engine":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _end_sooner(self) -> None:
        if self._terminated:
            self._process.kill()
        else:
            self._process.terminate()
            self._terminated, self._deadline = True, time.monotonic() + TERMINATE_SECONDS

    def _last_words(self) -> str:
        code = self._process.wait()
        self._readers[1].join(1.0)
        self._print_log()
        last = next((line.strip() for line in reversed(self.log) if line.strip()), "")
        how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return f"The engine {how} before it was done{': ' + last if last else '.'}"

    def _print_log(self) -> None:
        for line in self.log:
            print(f"swag engine: {line}", file=sys.stderr)


def _read(pipe: Any, put: Callable[[str | None], None]) -> None:
    """Runs in a thread that holds only the pipe and where its lines go: Blender's data may be gone when it ends."""
    with contextlib.suppress(OSError, ValueError), pipe:
        for line in pipe:
            put(line.rstrip("\n"))
    put(None)


def _into(log: deque[str]) -> Callable[[str | None], None]:
    return lambda line: log.append(line) if line else None


def run_request(message: dict[str, Any], on_event: Callable[[dict[str, Any]], None] | None = None) -> dict[str, Any]:
    """Send one request to a new worker, wait, and return its `result` event; other events go to `on_event`.

    Raises EngineError with one sentence.
    """
    with Engine() as engine:
        engine.send(message)
        return wait_for_result(engine, on_event)


def wait_for_result(engine: Engine, on_event: Callable[[dict[str, Any]], None] | None = None) -> dict[str, Any]:
    """Block until the `result` event. Ctrl-C cancels, which still gives a result. Raises EngineError."""
    while True:
        try:
            for event in engine.poll():
                if event.get("event") == "result":
                    return event
                if on_event:
                    on_event(event)
            time.sleep(0.01)
        except KeyboardInterrupt:
            engine.cancel()


def stop_all() -> bool:
    """End every child. Returns whether there was one."""
    was_running = bool(_running)
    for engine in list(_running):
        engine.stop()
    return was_running


def register() -> None:
    atexit.register(stop_all)


def unregister() -> None:
    stop_all()
    atexit.unregister(stop_all)
    blender_finds.cache_clear()
