"""The CUDA kernels on a CPU, unmodified, for tests: compiled with cuda_fibres.h, launched as by cuda_driver.Driver."""

import ctypes
import hashlib
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from swag_engine.rasterize.cuda_driver import Argument, converted
from swag_engine.rasterize.kernels import build

SHIPPED = tuple(build.FOLDER / name for name in build.CUDA_SOURCES)
HEADER = Path(__file__).with_name("cuda_fibres.h")
FLAGS = (
    *("-std=c++17", "-O2", "-ffp-contract=fast", "-nostdlib++", "-fno-exceptions", "-fno-rtti", "-Wall"),
    *(f"-I{HEADER.parent}", f"-I{build.FOLDER}"),
)
LETTERS = {
    torch.float64: "D",
    torch.float32: "F",
    torch.int64: "L",
    torch.int32: "I",
    torch.int16: "S",
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
        if takes != given:
            raise TypeError(f"{kernel} takes {takes}, not {given}")
        values = [converted(argument, "cpu") for argument in arguments]
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        error = self._library.fibres_launch(kernel.encode(), grid, block, pointers, self.order)
        if error:
            raise RuntimeError(error.decode())


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
