"""How threads share the cores with other work, above all with Blender's, and how torch gets its memory.

Import this module before numpy and torch, which read the environment once. Blender itself must not import it.
"""

import contextlib
import ctypes
import os

# Waiting threads sleep instead of spin: spinning halves the speed of training where cores are shared.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# The matrices of numpy and scipy are small here: on shared cores, threads wait ten times as long as they work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# OpenCV refuses larger images by their header: 2^28 pixels, as scene/images.py does for the formats that Pillow knows.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**28))
# Huge pages: an iteration makes and frees hundreds of megabytes, and Linux takes long to clear them in pages of 4 kB.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt, from malloc.h of the GNU C library."""
KEPT_BYTES = 1 << 30
"""Freed memory, at most, that stays with this process. Linux would have to clear it again each time it is used, which
takes up to an eighth of an iteration with many Gaussians."""

with contextlib.suppress(OSError, TypeError, AttributeError):  # systems with another library
    for parameter in (M_TRIM_THRESHOLD, M_MMAP_THRESHOLD):
        ctypes.CDLL(None).mallopt(parameter, KEPT_BYTES)


def available_cores() -> int:
    """Return how many processor cores this process may use: OMP_NUM_THREADS where it is set, else all it may run on."""
    asked = os.environ.get("OMP_NUM_THREADS", "")
    if asked.isdecimal() and int(asked):
        return int(asked)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
