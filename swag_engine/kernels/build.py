"""Compile the kernels: C++ into shared libraries with the clang of the `ziglang` package, CUDA into PTX with NVRTC.

    python -m swag_engine.kernels.build          for this machine
    python -m swag_engine.kernels.build --all    for every platform a release carries

A file's name holds a hash of the sources and flags it was made from: one that exists is up to date. PTX is the same on
every platform; the driver turns it into code for its card. NVRTC is the oldest of CUDA 12, from the package
nvidia-cuda-nvrtc-cu12, so that every driver for CUDA 12 or later takes its PTX.
"""

import argparse
import ctypes
import hashlib
import os
import platform
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

FOLDER = Path(__file__).parent
"""Folder of the sources."""
LIBRARIES = FOLDER / "lib"
"""Folder of what is compiled."""
SOURCES = ("adam.cpp", "gaussians.cpp", "photo.cpp", "project.cpp", "raster.cpp", "sh.cpp", "ssim.cpp", "water.cpp")
HEADERS = ("constants.h", "light.h", "raster.h", "sh.h", "simd.h")
FLAGS = (
    *("-std=c++17", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"),
    *("-fno-exceptions", "-fno-rtti", "-nostdlib++", "-fvisibility=hidden", "-shared", "-s"),
    *("-Wall", "-Wextra"),
)
CUDA_SOURCES = (
    *("adam.cu", "blend.cu", "gaussians.cu", "photo.cu", "project.cu", "sh.cu", "ssim.cu", "tiles.cu", "water.cu"),
)
CUDA_HEADERS = ("common.cuh", "constants.h", "light.cuh", "splat.cuh")
CUDA_FLAGS = ("--std=c++17", "--gpu-architecture=compute_75", "--ftz=true")
NVRTC = "nvidia-cuda-nvrtc-cu12"


@dataclass(frozen=True)
class Target:
    """One shared library.

    Attributes:
        system: "linux", "windows" or "macos".
        machine: "x64" or "arm64".
        level: x86-64 level, 2 to 4; 1 on other machines.
        triple: Target of the compiler.
        cpu: Processor that the compiler optimises for.
        vector_width: Floats in a vector.
    """

    system: str
    machine: str
    level: int
    triple: str
    cpu: str
    vector_width: int

    @property
    def path(self) -> Path:
        """File of the library."""
        suffix = {"windows": "dll", "macos": "dylib", "linux": "so"}[self.system]
        return LIBRARIES / f"swag-{self.system}-{self.machine}-v{self.level}-{source_hash()}.{suffix}"


def _x86_targets(system: str, triple: str) -> list[Target]:
    return [
        Target(system, "x64", level, triple, f"x86_64_v{level}", width) for level, width in ((2, 4), (3, 8), (4, 16))
    ]


TARGETS = (
    *_x86_targets("linux", "x86_64-linux-gnu.2.17"),
    *_x86_targets("windows", "x86_64-windows-gnu"),
    *_x86_targets("macos", "x86_64-macos"),
    Target("linux", "arm64", 1, "aarch64-linux-gnu.2.17", "generic", 4),
    Target("macos", "arm64", 1, "aarch64-macos", "apple_m1", 4),
)


@cache
def source_hash() -> str:
    """Return 12 hexadecimal digits that change with the C++ sources and the flags."""
    digest = hashlib.sha256(" ".join(FLAGS).encode())
    for name in (*HEADERS, *SOURCES):
        digest.update((FOLDER / name).read_bytes())
    return digest.hexdigest()[:12]


def ptx_path() -> Path:
    """Return the path of the CUDA kernels' PTX, which is there once it is built."""
    digest = hashlib.sha256(" ".join(CUDA_FLAGS).encode())
    for name in (*CUDA_HEADERS, *CUDA_SOURCES):
        digest.update((FOLDER / name).read_bytes())
    return LIBRARIES / f"swag-cuda-{digest.hexdigest()[:12]}.ptx"


def host() -> tuple[str, str]:
    """Return system and machine of this Python, e.g. ("linux", "x64")."""
    system = {"Windows": "windows", "Darwin": "macos"}.get(platform.system(), "linux")
    machine = platform.machine().lower()
    return system, {"x86_64": "x64", "amd64": "x64", "aarch64": "arm64"}.get(machine, machine)


def host_targets() -> list[Target]:
    """Return what can be built for this machine, the highest level first; empty on a platform without kernels."""
    return sorted((t for t in TARGETS if (t.system, t.machine) == host()), key=lambda t: -t.level)


def build(targets: list[Target]) -> list[Path]:
    """Compile the libraries that are missing, and remove those of older sources.

    Args:
        targets: The libraries.

    Returns:
        Their paths.

    Raises:
        subprocess.CalledProcessError: A source does not compile; the compiler's messages are on stderr.
    """
    _remove_stale()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(_compile, (target for target in targets if not target.path.exists())))
    return [target.path for target in targets]


def _remove_stale() -> None:
    LIBRARIES.mkdir(parents=True, exist_ok=True)
    for library in LIBRARIES.glob("swag-*"):
        if library.stem.rpartition("-")[2] != source_hash() and library != ptx_path():
            library.unlink()


def _compile(target: Target) -> None:
    command = [sys.executable, "-m", "ziglang", "c++", "-target", target.triple, f"-mcpu={target.cpu}"]
    command += [f"-DVW={target.vector_width}", *FLAGS, *([] if target.system == "windows" else ["-fPIC"])]
    with tempfile.TemporaryDirectory(dir=LIBRARIES) as folder:  # linkers leave other files beside the library
        made = Path(folder) / target.path.name
        subprocess.run([*command, *SOURCES, "-o", str(made)], cwd=FOLDER, check=True)
        os.replace(made, target.path)


def build_ptx() -> Path:
    """Compile the CUDA kernels if they are not there yet.

    Returns:
        The path of their PTX.

    Raises:
        importlib.metadata.PackageNotFoundError: NVRTC is not installed.
        RuntimeError: A source does not compile; the message has NVRTC's log.
    """
    path = ptx_path()
    if not path.exists():
        ptx = _compile_ptx(_nvrtc())
        _remove_stale()
        with tempfile.TemporaryDirectory(dir=LIBRARIES) as folder:
            made = Path(folder) / path.name
            made.write_bytes(ptx)
            os.replace(made, path)
    return path


def _nvrtc() -> ctypes.CDLL:
    paths = [str(file.locate()) for file in metadata.files(NVRTC) or [] if ".so." in file.name or file.suffix == ".dll"]
    paths.sort(key=lambda path: "builtins" not in path)  # NVRTC looks for its builtins by name: they go first
    return [ctypes.CDLL(path) for path in paths][-1]


def _compile_ptx(nvrtc: ctypes.CDLL) -> bytes:
    """Compile all sources as one program; the files are given to NVRTC by name."""
    names = [*CUDA_HEADERS, *CUDA_SOURCES]
    program = ctypes.c_void_p()
    main = "".join(f'#include "{name}"\n' for name in CUDA_SOURCES).encode()
    texts = _strings([(FOLDER / name).read_bytes() for name in names])
    includes = _strings([name.encode() for name in names])
    flags = _strings([flag.encode() for flag in CUDA_FLAGS])
    if nvrtc.nvrtcCreateProgram(ctypes.byref(program), main, b"swag.cu", len(names), texts, includes):
        raise RuntimeError("NVRTC could not start.")
    try:
        failed = nvrtc.nvrtcCompileProgram(program, len(flags), flags)
        if failed:
            raise RuntimeError(f"The CUDA kernels do not compile:\n{_text(nvrtc, program, 'ProgramLog').decode()}")
        return _text(nvrtc, program, "PTX")
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def _strings(values: list[bytes]) -> ctypes.Array[ctypes.c_char_p]:
    return (ctypes.c_char_p * len(values))(*values)


def _text(nvrtc: ctypes.CDLL, program: ctypes.c_void_p, what: str) -> bytes:
    size = ctypes.c_size_t()
    getattr(nvrtc, f"nvrtcGet{what}Size")(program, ctypes.byref(size))
    text = ctypes.create_string_buffer(size.value)
    getattr(nvrtc, f"nvrtcGet{what}")(program, text)
    return text.value


def main() -> None:
    """Build what the command line asks for and print the paths."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="every platform, not only this machine's")
    every = parser.parse_args().all
    for path in build(list(TARGETS) if every else host_targets()):
        print(path)
    try:
        print(build_ptx())
    except metadata.PackageNotFoundError:
        print(f"The CUDA kernels are left out: {NVRTC} is not installed (pip has it for Linux and Windows on x64).")


if __name__ == "__main__":
    main()
