"""The engine's child process: which Python runs it, how messages are exchanged, how it ends.

They exchange one JSON object per line: requests on the child's stdin, events on its stdout, logs on its stderr.
"""

import atexit
import contextlib
import functools
import importlib.util
import json
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ..swag_engine.base.errors import missing_package_sentence
from . import EXTENSION
from .blender_types import present

ROOT = Path(__file__).resolve().parents[1]
PACKAGES: tuple[str, ...] = ("torch", "pycolmap")
"""A Python that has these packages is assumed to have all that the engine needs."""
CANCEL_SECONDS = 60.0
"""Time without an event after which a cancelled child is terminated."""
TERMINATE_SECONDS = 5.0
"""Time that a terminated child gets before it is killed."""
CLOSE_SECONDS = 2.0
"""Time that a child gets to end by itself after its stdin was closed."""
KILL = 9
"""Number of the signal SIGKILL, which Python on Windows does not name."""
GO_ON = "What was saved is kept: start again, or press Continue."
"""What to do when the engine has ended before it was done."""
NICENESS = 10
"""Lower priority of the child: it uses the processors that Blender does not need."""

_running: set["Engine"] = set()


class EngineError(Exception):
    """The engine failed or cannot be started; the message is one sentence for the user."""


def environment_folder() -> Path:
    """Folder of the Python environment that Install Engine makes; it need not exist."""
    return Path(bpy.utils.extension_path_user(EXTENSION)) / "engine"


def environment_python() -> Path:
    """The Python of that environment; it need not exist."""
    name = ("Scripts", "python.exe") if os.name == "nt" else ("bin", "python")
    return environment_folder().joinpath(*name)


def environment_is_whole() -> bool:
    """Whether the installation was completed: make_environment.py writes installed.json last.

    The environment's Python is a link: it is broken once the Blender that made it was removed, and finds no packages
    once a system's update put another version of Python in its place.
    """
    try:
        installed = json.loads((environment_folder() / "installed.json").read_text(encoding="utf-8"))
        version = installed["doctor"]["python"].split(".")[:2]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return version == [str(number) for number in sys.version_info[:2]] and environment_python().exists()


@functools.cache
def blender_finds(package: str) -> bool:
    """Whether Blender's own Python can find a package; it is not imported."""
    return importlib.util.find_spec(package) is not None


def engine_python() -> str:
    """Path of the Python that runs the engine.

    The preference comes first, then the variable SWAG_ENGINE_PYTHON, then Blender's own Python if it finds torch, then
    the environment of Install Engine. Raises EngineError when there is none, or when the chosen one cannot be run.
    """
    own: Any = present(bpy.context.preferences).addons[EXTENSION].preferences
    for named, place in (
        (bpy.path.abspath(own.engine_python), "the preferences of SWAG Splatting"),
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
        "The engine is not installed: press Install Engine in the preferences of SWAG Splatting, or set a Python there."
    )


def engine_problem() -> str:
    """Why the engine cannot run; "" where it can."""
    try:
        engine_python()
    except EngineError as error:
        return str(error)
    return ""


def clean_environment() -> dict[str, str]:
    """Environment variables for the engine: it finds this extension's swag_engine, and no modules of Blender's."""
    kept = {key: value for key, value in os.environ.items() if key not in ("PYTHONHOME", "PYTHONPATH", "LD_PRELOAD")}
    # PYTHONSAFEPATH: modules in the folder that Blender was started from are not imported.
    return kept | {"PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1", "PYTHONUNBUFFERED": "1"}


class Engine:
    """A child process that exchanges messages as app/protocol.py of the engine describes.

    Args:
        command: what to run; the engine's worker by default.

    Attributes:
        terminated: whether it did not stop after `cancel` and was ended.

    Raises:
        EngineError: it cannot be started.
    """

    def __init__(self, command: list[str] | None = None) -> None:
        command = command or [engine_python(), "-m", "swag_engine.app.worker"]
        self._python = command[0]
        # A session of its own: Ctrl-C in the terminal reaches Blender alone, which then cancels or stops the child.
        options: dict[str, Any] = {"start_new_session": True}
        if sys.platform == "win32":
            options = {"creationflags": subprocess.CREATE_NO_WINDOW | subprocess.BELOW_NORMAL_PRIORITY_CLASS}
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                encoding="utf-8",
                errors="replace",
                env=clean_environment(),
                **options,
            )
        except OSError as error:
            raise EngineError(f"The engine's Python {command[0]} cannot be started: {error.strerror}.") from error
        if os.name != "nt":
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)
        self.log: deque[str] = deque(maxlen=200)
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._deadline: float | None = None
        self.terminated = self._ended = self._hurried = False
        self._readers = [
            threading.Thread(target=_read, args=(self._process.stdout, self._lines.put), daemon=True),
            threading.Thread(target=_read, args=(self._process.stderr, _into(self.log)), daemon=True),
        ]
        for reader in self._readers:
            reader.start()
        _running.add(self)

    def send(self, request: dict[str, Any]) -> None:
        """Send one request. A child that has died is reported by `poll`."""
        stdin = present(self._process.stdin)
        with contextlib.suppress(OSError, ValueError):
            stdin.write(json.dumps(request) + "\n")
            stdin.flush()

    def poll(self) -> list[dict[str, Any]]:
        """The events that arrived since the last call; never waits.

        Raises EngineError for an `error` event, and with the last line of the log when the child has died.
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
            if self._deadline is not None and not self.terminated:
                self._deadline = time.monotonic() + CANCEL_SECONDS
        if self._ended and not events:
            raise EngineError(self._how_it_ended())
        if self._deadline is not None and time.monotonic() > self._deadline:
            self._terminate_or_kill()
        return events

    def cancel(self, now: bool = False) -> None:
        """Ask for a stop that keeps the result so far; `poll` terminates and then kills a child that does not stop.

        Args:
            now: also leave out the evaluation that a training ends with.
        """
        if self._deadline is None or now and not self._hurried:
            self._deadline, self._hurried = time.monotonic() + CANCEL_SECONDS, now
            self.send({"request": "cancel"} | ({"now": True} if now else {}))

    def stop(self) -> None:
        """End the child within a few seconds; files that it has saved stay."""
        _running.discard(self)
        with contextlib.suppress(OSError):
            present(self._process.stdin).close()
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

    def _terminate_or_kill(self) -> None:
        if self.terminated:
            self._process.kill()
        else:
            self._process.terminate()
            self.terminated, self._deadline = True, time.monotonic() + TERMINATE_SECONDS

    def _how_it_ended(self) -> str:
        code = self._process.wait()
        self._readers[1].join(1.0)
        self._print_log()
        last = next((line.strip() for line in reversed(self.log) if line.strip()), "")
        if self.terminated:
            return f"The engine did nothing for {CANCEL_SECONDS:.0f} s after Cancel and was ended. {GO_ON}"
        # The worker handles the first signal itself and ends with the code that shells give to it.
        number = -code if code < 0 else code - 128
        if number == signal.SIGTERM:
            return f"The engine was ended by the system or another program (signal {number}). {GO_ON}"
        if number == KILL:
            return (
                f"The engine was ended by the system (signal {number}), usually because memory ran out. "
                f"Close other programs or choose a lower Quality. {GO_ON}"
            )
        if missing := re.match(r"ModuleNotFoundError: No module named '(?!swag_engine)([^'.]+)", last):
            return missing_package_sentence(self._python, missing[1])
        how = f"crashed (signal {number})" if code < 0 else f"ended with exit code {code}"
        return f"The engine {how} before it was done{': ' + last.rstrip('.') if last else ''}. {GO_ON}"

    def _print_log(self) -> None:
        for line in self.log:
            print(f"swag engine: {line}", file=sys.stderr)


def _read(pipe: Any, put: Callable[[str | None], None]) -> None:
    """Pass the lines of a pipe on, then None (in a thread, which must not use Blender's data: it may be freed)."""
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


def stop_all(*kept: Engine) -> None:
    """End every child but some that go on."""
    for engine in _running.difference(kept):
        engine.stop()


def register() -> None:
    """Stop all children when Blender ends."""
    atexit.register(stop_all)


def unregister() -> None:
    """Stop all children now."""
    stop_all()
    atexit.unregister(stop_all)
    blender_finds.cache_clear()
