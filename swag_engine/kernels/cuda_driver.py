"""Kernels in PTX on NVIDIA cards: loaded and launched through the driver's own library by ctypes."""

import ctypes
import sys
from functools import cache
from typing import Any, Protocol

import torch
from torch import Tensor

from ..base.errors import remedy
from .build import ptx_path

Argument = Tensor | int | float
"""What a kernel takes: a tensor as the pointer to its data, an int as int64, a float as float32."""

OLDEST_CARD = (7, 5)
"""Compute capability that the PTX is for: the oldest that all of CUDA 12 and later know."""
OLDEST_DRIVER = 12000
"""Version of CUDA whose NVRTC makes the PTX, 1000 major + 10 minor: 12.0."""
LOG_BYTES = 8192
"""Size of the buffer for the messages of the driver's compiler, bytes."""
CU_JIT_ERROR_LOG_BUFFER = 5
"""Option of cuModuleLoadDataEx, from cuda.h: the buffer for error messages."""
CU_JIT_ERROR_LOG_BUFFER_SIZE_BYTES = 6
"""Option of cuModuleLoadDataEx, from cuda.h: its size."""


class CudaError(RuntimeError):
    """An error that the driver reported, with its message."""


class CudaUnavailable(Exception):
    """Why kernels cannot run on this machine: one sentence for users."""


class Launcher(Protocol):
    """What launches kernels.

    Attributes:
        device_type: Type of the torch devices whose tensors it takes.
    """

    device_type: str

    def launch(self, kernel: str, grid: int, block: int, arguments: list[Argument]) -> None:
        """Run a kernel on the device where the tensors are.

        Args:
            kernel: Name of the kernel.
            grid: Number of blocks.
            block: Number of threads in each block.
            arguments: What the kernel takes.
        """


class Driver:
    """Launches kernels on torch's devices and streams, through the driver's own library.

    Raises:
        CudaUnavailable: That is impossible on this machine.
    """

    device_type = "cuda"

    def __init__(self) -> None:
        if torch.version.cuda is None:
            raise CudaUnavailable("this PyTorch was built without CUDA; pytorch.org has builds with it.")
        try:
            self._library = _load_library()
        except OSError:
            raise CudaUnavailable("no NVIDIA driver is installed.") from None
        version = ctypes.c_int()
        self._call("cuDriverGetVersion", ctypes.byref(version))
        if version.value < OLDEST_DRIVER:
            known, needed = (f"{v // 1000}.{v % 1000 // 10}" for v in (version.value, OLDEST_DRIVER))
            raise CudaUnavailable(f"the NVIDIA driver knows CUDA {known}, {needed} is needed; update the driver.")
        if not torch.cuda.is_available():
            raise CudaUnavailable("PyTorch finds no NVIDIA card that it can use.")
        capability = torch.cuda.get_device_capability()
        if capability < OLDEST_CARD:
            name, (major, minor) = torch.cuda.get_device_name(), capability
            raise CudaUnavailable(f"{name} has compute capability {major}.{minor}, 7.5 or later is needed.")
        if not ptx_path().exists():
            how = remedy("python -m swag_engine.kernels.build makes them", "the released extension has them")
            raise CudaUnavailable(f"its kernels are not built; {how}.")
        self._module = cache(self._load_module)
        self._function = cache(self._get_function)
        try:
            self._module(torch.cuda.current_device())
        except CudaError as error:
            raise CudaUnavailable(f"the driver does not load its kernels: {error}") from None

    def launch(self, kernel: str, grid: int, block: int, arguments: list[Argument]) -> None:
        """Run a kernel on the current stream of the device where the tensors are.

        Args:
            kernel: Name of the kernel.
            grid: Number of blocks; nothing is done for 0.
            block: Number of threads in each block.
            arguments: What the kernel takes; one at least is a tensor.

        Raises:
            CudaError: The driver refused.
        """
        if grid == 0:
            return
        device = next(a for a in arguments if isinstance(a, Tensor)).device.index
        context, _ = self._module(device)
        values = [converted(argument, self.device_type) for argument in arguments]
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        stream = ctypes.c_void_p(torch.cuda.current_stream(device).cuda_stream)
        function = self._function(device, kernel)
        self._call("cuCtxPushCurrent_v2", context)
        try:
            self._call("cuLaunchKernel", function, grid, 1, 1, block, 1, 1, 0, stream, pointers, None)
        finally:
            self._call("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))

    def _load_module(self, device: int) -> tuple[ctypes.c_void_p, ctypes.c_void_p]:
        """Load the kernels into torch's own context on a device; returns both."""
        torch.cuda.synchronize(device)  # torch starts CUDA late; the context is torch's
        number, context, module = ctypes.c_int(), ctypes.c_void_p(), ctypes.c_void_p()
        self._call("cuDeviceGet", ctypes.byref(number), device)
        self._call("cuDevicePrimaryCtxRetain", ctypes.byref(context), number)
        log = ctypes.create_string_buffer(LOG_BYTES)
        options = (ctypes.c_int * 2)(CU_JIT_ERROR_LOG_BUFFER, CU_JIT_ERROR_LOG_BUFFER_SIZE_BYTES)
        settings = (ctypes.c_void_p * 2)(ctypes.addressof(log), LOG_BYTES)
        ptx = ctypes.c_char_p(ptx_path().read_bytes())
        self._call("cuCtxPushCurrent_v2", context)
        try:
            self._call("cuModuleLoadDataEx", ctypes.byref(module), ptx, 2, options, settings, log=log)
        finally:
            self._call("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))
        return context, module

    def _get_function(self, device: int, kernel: str) -> ctypes.c_void_p:
        function = ctypes.c_void_p()
        self._call("cuModuleGetFunction", ctypes.byref(function), self._module(device)[1], kernel.encode())
        return function

    def _call(self, name: str, *arguments: Any, log: Any = None) -> None:
        result = getattr(self._library, name)(*arguments)
        if result:
            text = ctypes.c_char_p()
            self._library.cuGetErrorString(result, ctypes.byref(text))
            words = (text.value or b"unknown error").decode()
            more = f"\n{log.value.decode(errors='replace')}" if log is not None and log.value else ""
            raise CudaError(f"{name} failed with error {result}, {words}{more}")


def _load_library() -> ctypes.CDLL:
    if sys.platform == "win32":
        return ctypes.WinDLL("nvcuda.dll")
    return ctypes.CDLL("libcuda.so.1")


def converted(argument: Argument, device_type: str) -> ctypes.c_void_p | ctypes.c_int64 | ctypes.c_float:
    """Convert an argument to what the kernel takes.

    Args:
        argument: A contiguous tensor on a device of `device_type`, or a number.
        device_type: Type of the torch device.

    Returns:
        The pointer to a tensor's data, an int64 or a float32.
    """
    if isinstance(argument, Tensor):
        assert argument.is_contiguous() and argument.device.type == device_type
        return ctypes.c_void_p(argument.data_ptr())
    return ctypes.c_int64(argument) if isinstance(argument, int) else ctypes.c_float(argument)
