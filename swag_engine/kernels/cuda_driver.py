"""Kernels in PTX on NVIDIA cards: loaded and launched through the driver's own library by ctypes."""

import ctypes
import sys
from functools import cache
from typing import Any

import torch
from torch import Tensor

from .build import ptx_path

Argument = Tensor | int | float

OLDEST_CARD = (7, 5)  # compute capability that the PTX is for
OLDEST_DRIVER = 12000  # CUDA 12.0, whose NVRTC the PTX is from
LOG_BYTES = 8192
CU_JIT_ERROR_LOG_BUFFER, CU_JIT_ERROR_LOG_BUFFER_SIZE_BYTES = 5, 6


class CudaError(RuntimeError):
    """What the driver answered, in words."""


class CudaUnavailable(Exception):
    """Why kernels cannot run on this machine: one sentence for users."""


class Driver:
    """Launches kernels on torch's devices and streams. Raises CudaUnavailable where that is impossible."""

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
            raise CudaUnavailable("its kernels are not built; python -m swag_engine.kernels.build makes them.")
        self._module = cache(self._load_module)
        self._function = cache(self._get_function)
        try:
            self._module(torch.cuda.current_device())
        except CudaError as error:
            raise CudaUnavailable(f"the driver does not load its kernels: {error}") from None

    def launch(self, kernel: str, grid: int, block: int, arguments: list[Argument]) -> None:
        """Run `grid` blocks of `block` threads on the current stream of the device where the tensors are.

        Tensors become pointers, int a 64-bit integer, float a 32-bit one. Raises CudaError.
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
        """torch's own context on a device, and the kernels in it."""
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
    """An argument as the kernel takes it; tensors have to be contiguous and on `device_type`."""
    if isinstance(argument, Tensor):
        assert argument.is_contiguous() and argument.device.type == device_type
        return ctypes.c_void_p(argument.data_ptr())
    return ctypes.c_int64(argument) if isinstance(argument, int) else ctypes.c_float(argument)
