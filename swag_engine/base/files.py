"""Files that are written completely or not at all, and folders that one process at a time writes to."""

import csv
import errno
import math
import os
import secrets
import shutil
import stat
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from .errors import InputError

LOCK = ".swag.lock"
"""Name of the file whose lock a process holds while it writes to a folder."""
FULL_BYTES = 2**16
"""Free bytes below which a disk is full: a block that a library could not write is no larger."""
TEMPORARY = ".swag-"
"""First characters of the names of temporary folders, before twelve random hexadecimal digits."""


def inside(name: str) -> str:
    """Return the name of an image or a file without parts that lead out of its folder; "_" where nothing is left."""
    parts = name.replace("\\", "/").split("/")
    return "/".join(part for part in parts if part not in ("", ".", "..") and not part.endswith(":")) or "_"


def refuse_link(path: Path) -> None:
    """Refuse a folder that is a link, or a junction of Windows: what is written or deleted there belongs to others.

    Raises:
        InputError: For a link.
    """
    if os.path.normcase(path.resolve()) != os.path.normcase(path.parent.resolve() / path.name):
        raise InputError(f"{path} is a link to another folder: remove the link, or move that folder here.")


def regular(path: str, flags: int) -> int:
    """Open a regular file, as an `opener` of `open`; raises OSError for others, such as pipes, which never end."""
    opened = os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)
    if stat.S_ISREG(os.fstat(opened).st_mode):
        return opened
    is_folder = stat.S_ISDIR(os.fstat(opened).st_mode)
    os.close(opened)
    if is_folder:
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), path)
    raise OSError(errno.EINVAL, "it is no regular file", path)


def no_link(path: str, flags: int) -> int:
    """Open a regular file that is no link, as `regular` does."""
    return regular(path, flags | getattr(os, "O_NOFOLLOW", 0))


def read_bytes(path: Path) -> bytes:
    """Return the bytes of a regular file; raises OSError for others."""
    with open(path, "rb", opener=regular) as file:
        return file.read()


def read_text(path: Path, encoding: str = "utf-8", errors: str = "strict") -> str:
    """Return the text of a regular file; raises OSError for others, and ValueError for another encoding."""
    return read_bytes(path).decode(encoding, errors)


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Make a hidden folder with a random name, and remove it with its files when the block ends."""
    folder = parent / f"{TEMPORARY}{secrets.token_hex(6)}"
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary file to write to; flush it and rename it over the file when the block succeeds.

    It has the same name and lies in a temporary folder beside the file, which is removed with all that is in it. When
    the block fails, an existing file is untouched. After a power cut there is the old file or the new one: the bytes
    reach the disk before the name does.

    Args:
        path: The file; its parent folder is made.

    Raises:
        InputError: When the disk is full or the folder cannot be written to.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not path.is_file():
            raise OSError(errno.EINVAL, "it is no regular file")
        with temporary_folder(path.parent) as folder:
            yield (temporary := folder / path.name)
            with open(temporary, "rb+") as written:
                os.fsync(written.fileno())
            os.replace(temporary, path)
            _flush_names(path.parent)
    except OSError as error:
        raise not_writable(path, error) from error


def require_parent(path: Path) -> Path:
    """Return a file or folder that a user chose to write to, in a folder that exists: no typing error makes a folder.

    Raises:
        InputError: When the folder that it lies in does not exist.
    """
    if not path.parent.exists():
        raise InputError(
            f"There is no folder {path.parent} to write {path.name} to: create it, or choose another folder."
        )
    return path


def output_names(images: Iterable[str], suffix: str) -> dict[str, str]:
    """Name a file for each of all images: NAME with `suffix` in place of its own, or after it where two would share."""
    names = {image: str(PurePosixPath(image).with_suffix(suffix)) for image in images}
    # Names are compared as Windows and macOS do.
    counts = Counter(name.lower() for name in names.values())
    return {image: name if counts[name.lower()] == 1 else f"{image}{suffix}" for image, name in names.items()}


def not_writable(path: Path, error: OSError) -> InputError:
    """Make the error that says why a file or folder cannot be written, and what to do."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        remedy = "free some space on the disk, or choose a folder on another one"
    else:
        remedy = "choose another folder, or check who may write to this one"
    return InputError(f"Cannot write {path}: {error.strerror or error}; {remedy}.")


def unexplained(path: Path, said: str) -> OSError:
    """Make the error of a library that could not write a file and does not say why: a full disk, or what it said."""
    full = shutil.disk_usage(path.parent).free < FULL_BYTES
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) if full else OSError(errno.EIO, said)


def _flush_names(folder: Path) -> None:
    """Flush the names that a folder lists to the disk, on systems that can."""
    if os.name != "posix":
        return
    with suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV table. Text that a spreadsheet would take for a formula gets an apostrophe in front.

    Raises:
        InputError: When the file cannot be written.
    """
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([_no_formula(cell) for cell in row] for row in (columns, *rows))


def _no_formula(cell: Any) -> Any:
    acts = isinstance(cell, str) and cell.startswith(("=", "+", "-", "@", "\t", "\r"))
    with suppress(ValueError):
        acts = acts and not math.isfinite(float(cell))
    return f"'{cell}" if acts else cell


class FolderInUse(InputError):
    """Another process is working in a folder."""


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Lock a folder against other processes while the block runs, and remove temporary folders of killed ones.

    The system releases the lock when the process dies. A folder that stays empty is removed again.

    Args:
        folder: The folder; it is made.

    Raises:
        FolderInUse: When another process holds the lock.
        InputError: When the folder cannot be written to.
    """
    lock = folder / LOCK
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = _locked(lock, folder)
        while not (lock.exists() and os.path.samestat(os.fstat(held.fileno()), lock.stat())):
            held.close()  # the process that had it has removed the file in between
            held = _locked(lock, folder)
    except OSError as error:
        raise not_writable(folder, error) from error
    try:
        for left in list(folder.glob(TEMPORARY + 12 * "[0-9a-f]")):
            shutil.rmtree(left, ignore_errors=True)  # which follows no link
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
    """Open and lock a file; without a lock on file systems that have none."""
    file = open(path, "ab", opener=no_link)  # noqa: SIM115 (stays open as long as the lock is held)
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        file.close()
        raise FolderInUse(f"Another process is working in {folder}: wait for its end or choose another one.") from None
    except OSError:
        pass
    return file
