"""The compiled C++ kernels: loaded through ctypes and run on Python threads (ctypes frees the GIL)."""

import ctypes
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from .build import host_targets

TASKS_PER_THREAD = 8
"""Ranges that each thread gets of a kernel's work: enough to balance ranges of unequal cost."""

Argument = Tensor | int | float
"""What a kernel takes: a tensor as the pointer to its data, an int as int64, a float as float32."""


class CpuLibrary:
    """Shared library of kernels.

    Args:
        path: File of the library.

    Raises:
        OSError: The file is missing or does not fit this system.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._library = ctypes.CDLL(str(path))

    def call(self, kernel: str, *arguments: Argument) -> int:
        """Call a kernel once, on this thread.

        Args:
            kernel: Name of the function.
            *arguments: Its arguments.

        Returns:
            The integer that the kernel returns.
        """
        function = getattr(self._library, kernel)
        function.restype = ctypes.c_int64
        return int(function(*map(_converted, arguments)))

    def run(self, kernel: str, count: int, *arguments: Argument) -> None:
        """Call `kernel(begin, end, *arguments)` over ranges that cover [0, count), on all threads.

        Args:
            kernel: Name of the function.
            count: Number of items.
            *arguments: Arguments after the range.
        """
        function = getattr(self._library, kernel)
        values = [_converted(argument) for argument in arguments]
        threads = torch.get_num_threads()
        tasks = min(count, TASKS_PER_THREAD * threads if threads > 1 else 1)
        _run_tasks(lambda task: function(*_range(count, task, tasks), *values), tasks)

    def run_parts(self, kernel: str, count: int, arguments: list[Argument], per_part: Tensor) -> None:
        """Call a kernel over a number of ranges that does not depend on the number of threads.

        Args:
            kernel: Name of the function.
            count: Number of items.
            arguments: Arguments after the range.
            per_part: (parts, ...) tensor; each range gets its row as the last argument.
        """
        function = getattr(self._library, kernel)
        values = [_converted(argument) for argument in arguments]
        parts = len(per_part)
        # Places of the rows by arithmetic: indexing the tensor takes longer than some kernels.
        assert per_part.is_contiguous()
        first, row_bytes = per_part.data_ptr(), per_part.nbytes // parts
        rows = [ctypes.c_void_p(first + part * row_bytes) for part in range(parts)]
        _run_tasks(lambda part: function(*_range(count, part, parts), *values, rows[part]), parts)


def load_library() -> CpuLibrary | None:
    """Load the build of the kernels that fits this processor best; without one warn once why there is none."""
    reason = "none are built for this platform"
    for target in host_targets():
        if target.level > supported_level():
            continue
        try:
            return CpuLibrary(target.path)
        except OSError as error:
            reason = str(error)
    warnings.warn(
        f"CPU kernels not loaded ({reason}); using torch, which is many times slower. "
        "To build them: python -m swag_engine.kernels.build",
        stacklevel=2,
    )
    return None


def supported_level() -> int:
    """Return the highest x86-64 level that this processor runs, 2 to 4."""
    return {"AVX512": 4, "AVX2": 3}.get(torch.backends.cpu.get_cpu_capability(), 2)


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="swag-kernels")


def _range(count: int, part: int, parts: int) -> tuple[ctypes.c_int64, ctypes.c_int64]:
    return ctypes.c_int64(count * part // parts), ctypes.c_int64(count * (part + 1) // parts)


def _run_tasks(task: Callable[[int], None], tasks: int) -> None:
    """Call task(0) to task(tasks - 1); each thread, this one among them, takes the next when it is free."""
    numbers = iter(range(tasks))

    def work() -> None:
        for number in numbers:
            task(number)

    others = min(torch.get_num_threads(), tasks) - 1
    waiting = [_threads(others).submit(work) for _ in range(others)]
    work()
    for other in waiting:
        other.result()


def _converted(argument: Argument) -> ctypes.c_void_p | ctypes.c_int64 | ctypes.c_float:
    if isinstance(argument, Tensor):
        assert argument.is_contiguous() and argument.device.type == "cpu"
        return ctypes.c_void_p(argument.data_ptr())
    return ctypes.c_int64(argument) if isinstance(argument, int) else ctypes.c_float(argument)
