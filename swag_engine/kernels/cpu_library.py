"""The compiled kernels: loaded through ctypes and run on Python threads (ctypes frees the GIL)."""

import ctypes
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch
from torch import Tensor

from .build import Target, host_targets

TASKS_PER_THREAD = 8


@cache
def target() -> Target | None:
    """The build of the kernels that fits this processor best and loads, or None after one warning that says why."""
    level = {"AVX512": 4, "AVX2": 3}.get(torch.backends.cpu.get_cpu_capability(), 2)
    reason = "none are built for this platform"
    for candidate in host_targets():
        if candidate.level > level:
            continue
        try:
            ctypes.CDLL(str(candidate.path))
            return candidate
        except OSError as error:
            reason = str(error)
    warnings.warn(
        f"CPU kernels not loaded ({reason}); using torch, which is many times slower. "
        "To build them: python -m swag_engine.kernels.build",
        stacklevel=2,
    )
    return None


@cache
def library() -> ctypes.CDLL | None:
    """The kernels for this processor, or None where there are none."""
    chosen = target()
    return ctypes.CDLL(str(chosen.path)) if chosen else None


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="swag-kernels")


Argument = Tensor | int | float | None


def constant(kernel: str, *arguments: Argument) -> int:
    """Call a kernel once, on this thread; returns its integer."""
    function = getattr(library(), kernel)
    function.restype = ctypes.c_int64
    return int(function(*map(_converted, arguments)))


def run(kernel: str, count: int, *arguments: Argument) -> None:
    """Call `kernel(begin, end, *arguments)` over ranges that cover [0, count), on all threads."""
    function = getattr(library(), kernel)
    values = [_converted(argument) for argument in arguments]
    threads = torch.get_num_threads()
    tasks = min(count, TASKS_PER_THREAD * threads if threads > 1 else 1)
    _spread(lambda task: function(*_range(count, task, tasks), *values), tasks)


def run_parts(kernel: str, count: int, arguments: list[Argument], per_part: Tensor) -> None:
    """As `run`, but in as many ranges as `per_part` has rows whatever the threads; each range gets its row, last."""
    function = getattr(library(), kernel)
    values = [_converted(argument) for argument in arguments]
    parts = len(per_part)
    _spread(lambda part: function(*_range(count, part, parts), *values, _converted(per_part[part])), parts)


def _range(count: int, part: int, parts: int) -> tuple[ctypes.c_int64, ctypes.c_int64]:
    return ctypes.c_int64(count * part // parts), ctypes.c_int64(count * (part + 1) // parts)


def _spread(task: Callable[[int], None], tasks: int) -> None:
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
    """A tensor as the pointer to its data."""
    if argument is None:
        return ctypes.c_void_p()
    if isinstance(argument, Tensor):
        assert argument.is_contiguous() and argument.device.type == "cpu"
        return ctypes.c_void_p(argument.data_ptr())
    return ctypes.c_int64(argument) if isinstance(argument, int) else ctypes.c_float(argument)
