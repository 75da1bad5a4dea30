"""Claims on folders that processes on several machines may work in. Standard library only.

A lock (base/files.py) tells processes on one machine apart, and on several where the file system has locks. Where it
has none, the file claim.json says who works in the folder. Its owner counts up the number `beat` in it; whoever finds
the claim of another machine looks whether the number changes. So no clocks of two machines are compared.
"""

import json
import os
import platform
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .files import FolderInUse, atomic_path, locked_folder, read_text
from .strict_json import from_json

BEAT_SECONDS = 3.0
"""Time between two beats."""
WATCHED_SECONDS = 20.0
"""Time in which a living owner beats: several beats, since shared folders show changes some seconds late."""
FILE = "claim.json"
"""Name of the file in the folder."""


class Claim:
    """The claim of this process on a folder.

    Attributes:
        lost: Whether another process took the folder over, because this one did not beat for long; it must not write
            to it any more.
    """

    def __init__(self, folder: Path) -> None:
        self.lost = False
        self._file, self._token, self._ended = folder / FILE, uuid.uuid4().hex, threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)

    def _content(self, beat: int) -> str:
        return json.dumps({"host": platform.node(), "pid": os.getpid(), "token": self._token, "beat": beat})

    def _begin(self) -> None:
        file = os.open(self._file, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        with open(file, "w", encoding="utf-8") as opened:
            opened.write(self._content(0))
        self._thread.start()

    def _beat(self) -> None:
        beat = 0
        while not self._ended.wait(BEAT_SECONDS):
            found = read_claim(self._file)
            if found is None or found.get("token") != self._token:
                self.lost = True
                return
            beat += 1
            with suppress(Exception), atomic_path(self._file) as temporary:  # a full disk does not end the claim
                temporary.write_text(self._content(beat), encoding="utf-8")

    def _end(self) -> None:
        self._ended.set()
        self._thread.join()
        if not self.lost:
            self._file.unlink(missing_ok=True)


@contextmanager
def claimed(folder: Path, watched_seconds: float = WATCHED_SECONDS) -> Iterator[Claim]:
    """Claim a folder while the block runs.

    Args:
        folder: The folder; it is made.
        watched_seconds: How long the claim of another machine is watched before its owner counts as dead.

    Raises:
        FolderInUse: When another process works in the folder.
        InputError: When the folder cannot be written to.
    """
    with locked_folder(folder):
        file = folder / FILE
        if owner := _living_owner(file, watched_seconds):
            raise FolderInUse(f"{folder} is being worked on by {owner}.")
        file.unlink(missing_ok=True)
        claim = Claim(folder)
        try:
            claim._begin()
        except FileExistsError:
            raise FolderInUse(f"{folder} was claimed by another machine just now.") from None
        try:
            yield claim
        finally:
            claim._end()


def read_claim(file: Path) -> dict | None:
    """Return what a claim says (host, pid, token, beat); None without one, or where it is being written."""
    try:
        found = from_json(read_text(file))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _living_owner(file: Path, watched_seconds: float) -> str:
    """Describe the living process that a claim is from; empty where there is none."""
    found = read_claim(file)
    if found is None:
        return ""
    owner = f"process {found.get('pid')} on {found.get('host')}"
    if found.get("host") == platform.node() and not _runs(found.get("pid")):
        return ""
    deadline = time.monotonic() + watched_seconds
    while time.monotonic() < deadline:
        time.sleep(min(1.0, watched_seconds / 10))
        now = read_claim(file)
        if now is None:
            return ""
        if (now.get("token"), now.get("beat")) != (found.get("token"), found.get("beat")):
            return owner
    return ""


def _runs(pid: object) -> bool:
    """Whether a process of this machine may run."""
    if not isinstance(pid, int) or pid == os.getpid():
        return False
    if os.name != "posix":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
