"""The CUDA kernels on a CPU, unmodified, for tests: compiled with cuda_fibres.h, launched as by cuda_driver.Driver."""

import ctypes
import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from swag_engine.kernels import build, cuda_driver
from swag_engine.kernels.backends import KERNELS
from swag_engine.kernels.cuda import CudaKernels
from swag_engine.kernels.cuda_driver import Argument, converted

ON_CARD = bool(os.environ.get("SWAG_TEST_CUDA"))
"""Whether the tests of the kernels run on the card that is there instead of fibres."""
DEVICE = "cuda" if ON_CARD else "cpu"
"""Where the tensors of those tests are."""
SHIPPED = tuple(build.FOLDER / name for name in build.CUDA_SOURCES)
HEADER = Path(__file__).with_name("cuda_fibres.h")
FLAGS = (
    *("-std=c++17", "-O2", "-ffp-contract=fast", "-nostdlib++", "-fno-exceptions", "-fno-rtti", "-Wall"),
    *(f"-I{HEADER.parent}", f"-I{build.FOLDER}"),
)
CUDA_ERROR_OUT_OF_MEMORY = 2
LETTERS = {
    torch.float64: "D",
    torch.float32: "F",
    torch.int64: "L",
    torch.int32: "I",
    torch.int16: "S",
    torch.uint8: "B",
    torch.bool: "B",
}


class Fibres:
    """Launches kernels on CPU tensors. folder: where the compiled library is kept. sources: files of kernels.

    Raises TypeError for arguments that are not what the kernel takes, RuntimeError for a barrier that is never reached.
    """

    device_type = "cpu"

    def __init__(self, folder: Path, sources: Sequence[Path] = SHIPPED) -> None:
        self.order = 0  # in which threads run between barriers: fair, first warps first, last warps first
        self._library = ctypes.CDLL(str(_compiled(folder, sources)))
        self._library.fibres_launch.restype = self._library.fibres_signature.restype = ctypes.c_char_p

    def launch(self, kernel: str, grid: int, block: int, arguments: list[Argument]) -> None:
        takes, given = self._library.fibres_signature(kernel.encode()).decode(), "".join(map(_letter, arguments))
        if not _fits(takes, given, arguments):
            raise TypeError(f"{kernel} takes {takes}, not {given}")
        values = [converted(argument, "cpu") for argument in arguments]
        self.run(kernel, grid, block, (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values)))

    def run(self, kernel: str, grid: int, block: int, pointers: ctypes.Array) -> None:
        error = self._library.fibres_launch(kernel.encode(), grid, block, pointers, self.order)
        if error:
            raise RuntimeError(error.decode())


@contextmanager
def cuda_backend(folder: Path) -> Iterator[CudaKernels]:
    """The CUDA backend, registered as such: on the card that is there, or on fibres compiled in a folder."""
    with pytest.MonkeyPatch.context() as patch:
        if not ON_CARD:
            if sys.platform != "linux":
                pytest.skip("the fibres are for Linux")
            fibres = Fibres(folder)
            patch.setitem(KERNELS, "cuda", CudaKernels(lambda: fibres))
        kernels = KERNELS["cuda"]
        assert isinstance(kernels, CudaKernels) and kernels.unavailable_reason() is None
        yield kernels


class Libcuda:
    """What cuda_driver.Driver calls of the driver's library, with fibres in place of a card.

    too_large: whether a launch of this kernel with this number of blocks fails with too little memory.
    """

    def __init__(self, fibres: Fibres, too_large: Callable[[str, int], bool]) -> None:
        self._fibres, self._too_large, self._names = fibres, too_large, [""]

    def __getattr__(self, name: str) -> Callable[..., int]:
        return lambda *_: 0

    def cuDriverGetVersion(self, version: Any) -> int:
        version._obj.value = cuda_driver.OLDEST_DRIVER
        return 0

    def cuModuleGetFunction(self, function: Any, module: Any, name: bytes) -> int:
        function._obj.value = len(self._names)
        self._names.append(name.decode())
        return 0

    def cuLaunchKernel(self, function: Any, grid: int, _y: int, _z: int, block: int, *rest: Any) -> int:
        kernel = self._names[function.value]
        if self._too_large(kernel, grid):
            return CUDA_ERROR_OUT_OF_MEMORY
        self._fibres.run(kernel, grid, block, rest[-2])
        return 0

    def cuGetErrorString(self, error: int, text: Any) -> int:
        text._obj.value = b"out of memory"
        return 0


def pretend_card(monkeypatch: pytest.MonkeyPatch, library: Any) -> None:
    """Let Driver find a card, whose tensors are the CPU's, and `library` as its libcuda."""
    monkeypatch.setattr(cuda_driver, "_load_library", lambda: library)
    monkeypatch.setattr(cuda_driver.Driver, "device_type", "cpu")
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    answers = {
        "is_available": True,
        "get_device_capability": (8, 6),
        "get_device_name": "Fake 1",
        "current_device": 0,
        "synchronize": None,
        "current_stream": SimpleNamespace(cuda_stream=2**40 + 7),
    }
    for name, answer in answers.items():
        monkeypatch.setattr(torch.cuda, name, lambda *_, answer=answer: answer)


def _fits(takes: str, given: str, arguments: list[Argument]) -> bool:
    """Whether the types are those that a kernel takes; 0 stands for a tensor that there is not."""
    null = [not isinstance(argument, torch.Tensor) and argument == 0 for argument in arguments]
    pairs = zip(takes, given, null, strict=False)
    return len(takes) == len(given) and all(a == b or (a.isupper() and none) for a, b, none in pairs)


def _letter(argument: Argument) -> str:
    if isinstance(argument, torch.Tensor):
        return LETTERS[argument.dtype]
    return "i" if isinstance(argument, int) else "f"


def _compiled(folder: Path, sources: Sequence[Path]) -> Path:
    """A shared library of kernels; made once for the same sources."""
    digest = hashlib.sha256(" ".join(FLAGS).encode())
    for path in (HEADER, Path(__file__), *build.FOLDER.glob("*.cuh"), *sources):
        digest.update(path.read_bytes())
    library = folder / f"cuda-fibres-{digest.hexdigest()[:12]}.so"
    if library.exists():
        return library
    main = "".join(f'#include "{path}"\n' for path in (HEADER, *sources))
    text = _clang("-E", folder=folder, source=main)
    names = re.findall(r'extern "C" __attribute__\(\(used\)\) void\s+(\w+)\(', text)
    main += "const fibres::Entry fibres::entries[] = {\n"
    for name in names:
        main += f'    {{"{name}", fibres::Unpack<{name}>::signature, fibres::Unpack<{name}>::call}},\n'
    made = library.with_suffix(".part")
    _clang("-shared", "-fPIC", "-o", str(made), folder=folder, source=f"{main}    {{}}}};\n")
    return made.replace(library)


def _clang(*options: str, folder: Path, source: str) -> str:
    file = folder / "cuda_fibres.cpp"
    file.write_text(source)
    command = [sys.executable, "-m", "ziglang", "c++", *FLAGS, *options, str(file)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
