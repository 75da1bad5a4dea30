"""Child processes in which COLMAP runs: their job, their messages, their end.

A child reports on its standard output and ends with its standard input, so that a crash or a cancel leaves no files.
"""

import json
import os
import queue
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.isolation import child_environment
from .progress import Progress


def run_child(module: str, task: dict[str, Any], scratch: Path, first_stage: str, report: Progress) -> dict[str, Any]:
    """Run a module as a child process until it has a result.

    Args:
        module: Full name of the module, which calls `do_job`.
        task: What the child is to do, for JSON.
        scratch: Folder for files that nobody needs later; COLMAP's database in it is database.db.
        first_stage: Stage that is reported until the child reports one.
        report: Called with the stages.

    Returns:
        The result of the child.

    Raises:
        InputError: When the child failed or ended early.
    """
    job = scratch / "job.json"
    job.write_text(json.dumps(task), encoding="utf-8")
    command = [sys.executable, "-m", module, str(job)]
    result: dict[str, Any] | None = None
    with (
        open(scratch / "colmap.log", "ab") as log,
        subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env=child_environment(),
            encoding="utf-8",
        ) as child,
    ):
        try:
            for message in _messages(child, scratch / "database.db", first_stage):
                if "stage" in message:
                    report(message["stage"], message["fraction"])
                elif "error" in message:
                    raise InputError(message["error"])
                else:
                    result = message["result"]
        finally:
            if result is None:
                child.kill()
    if result is None:
        raise InputError(f"COLMAP ended without a result (exit code {child.returncode}): free memory and try again.")
    return result


def _messages(child: subprocess.Popen[str], database: Path, first_stage: str) -> Iterator[dict[str, Any]]:
    """Yield the messages of the child until it ends, the last one with a stage twice a second while it is silent.

    COLMAP reports no progress of features and matching, so the child sends the name of the table of COLMAP's database
    that they fill, and its rows are counted from here. (Not in the child: closing a second connection in one process
    would drop the locks of COLMAP's own copy of SQLite, and crash it: sqlite.org/howtocorrupt.html, section 2.2.)
    """
    lines: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        assert child.stdout is not None
        for line in child.stdout:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    latest: dict[str, Any] = {"stage": first_stage, "fraction": 0.0}
    while True:
        try:
            line = lines.get(timeout=0.5)
        except queue.Empty:
            if "table" in latest and (count := _rows(database, latest["table"])) is not None:
                latest["fraction"] = min(1.0, count / max(1, latest["total"]))
            yield latest
            continue
        if line is None:
            return
        message = json.loads(line)
        if "stage" in message:
            latest = message = {"fraction": 0.0} | message
        yield message


def _rows(database: Path, table: str) -> int | None:
    try:
        with closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True, timeout=0.1)) as connection:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:  # not made yet, or being written to
        return None


def say(**message: Any) -> None:
    """Send a message from the child to its parent; end the child where the parent has ended."""
    try:
        print(json.dumps(message), flush=True)
    except BrokenPipeError:
        os._exit(1)


def do_job(work: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Do the job whose file is the first argument of this child process, and tell the parent its result.

    Args:
        work: Takes the task and returns the result; raises InputError with the user's sentence.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        say(result=work(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))))
    except Exception as error:  # the parent turns it into the user's sentence
        reason = str(error) if isinstance(error, InputError) else f"COLMAP failed: {str(error).splitlines()[0]}"
        say(error=reason)
        sys.exit(1)


def _end_with_parent() -> None:
    """Wait for the end of standard input, which the parent holds open as long as it lives, and end this process."""
    sys.stdin.read()
    os._exit(1)
