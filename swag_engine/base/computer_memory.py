"""Memory of the computer."""

import ctypes
import os
import sys
from pathlib import Path


def total_memory() -> int | None:
    """Return how many bytes the computer has, None where the system does not say."""
    if sys.platform == "win32":
        return _windows(1)
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None


def free_memory() -> int | None:
    """Return how many bytes are free in the computer, None where the system does not say."""
    if sys.platform == "win32":
        return _windows(2)
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return 1024 * int(next(line.split()[1] for line in lines if line.startswith("MemAvailable")))
    except (OSError, StopIteration):
        return None


def _windows(field: int) -> int | None:
    """Return a 64-bit field of MEMORYSTATUSEX."""
    if sys.platform == "win32":
        status = (ctypes.c_uint64 * 8)()
        ctypes.cast(status, ctypes.POINTER(ctypes.c_uint32))[0] = ctypes.sizeof(status)
        return int(status[field]) if ctypes.windll.kernel32.GlobalMemoryStatusEx(status) else None
    return None
