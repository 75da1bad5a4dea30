"""Files that are either whole or absent, and folders that one process at a time writes to."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from .errors import InputError

LOCK = ".lock"
HALF = (".*.part", ".tmp??????")
"""What killed processes leave: our temporary files, and those of safetensors."""


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling of `path` to write to; flush it and rename it over `path` when the block succeeds.

    The parent folder is made. When the block fails, the temporary file is removed and an existing `path` is untouched.
    After a power cut there is the old file or the new one: the bytes reach the disk before the name does.
    Raises InputError when the disk is full or the folder cannot be written to.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with open(temporary, "rb+") as written:
            os.fsync(written.fileno())
        os.replace(temporary, path)
        _flush_names(path.parent)
    except OSError as error:
        raise InputError(f"Cannot write {path}: {error.strerror or error}.") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def _flush_names(folder: Path) -> None:
    """Let the disk have what a folder lists, where the system has a way to ask for it."""
    if os.name != "posix":
        return
    with suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Hold `folder`, which is made, against other processes that claim it; what a killed one left half is cleared.

    The system lets go of a claim when its process dies. A folder that stays empty is taken away again. Raises
    InputError when another process holds it, or it cannot be written to.
    """
    lock = folder / LOCK
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = _locked(lock, folder)
        while not (lock.exists() and os.path.samestat(os.fstat(held.fileno()), lock.stat())):
            held.close()  # whoever had it took the file away in between
            held = _locked(lock, folder)
    except OSError as error:
        raise InputError(f"Cannot write {folder}: {error.strerror or error}.") from error
    try:
        for left in [path for pattern in HALF for path in folder.glob(pattern)]:
            left.unlink(missing_ok=True)
        yield
    finally:
        if os.name == "posix":
            lock.unlink(missing_ok=True)
        held.close()
        with suppress(OSError):  # Windows does not remove an open file
            lock.unlink(missing_ok=True)
        with suppress(OSError):
            folder.rmdir()


def _locked(path: Path, folder: Path) -> BinaryIO:
    """The file, open and locked. A file system that knows no locks is taken as it is."""
    file = open(path, "ab")  # noqa: SIM115 (stays open as long as the lock is held)
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        file.close()
        raise InputError(f"Another process is working in {folder}: let it end, or choose another folder.") from None
    except OSError:
        pass
    return file
