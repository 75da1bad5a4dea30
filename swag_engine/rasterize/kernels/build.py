"""Compile the kernels into shared libraries with the clang of the `ziglang` package.

    python -m swag_engine.rasterize.kernels.build          for this machine
    python -m swag_engine.rasterize.kernels.build --all    for every platform a release carries

A library's name holds a hash of the sources and flags it was made from: one that exists is up to date.
"""

import argparse
import hashlib
import os
import platform
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path

FOLDER = Path(__file__).parent
LIBRARIES = FOLDER / "lib"
SOURCES = ("project.cpp", "raster.cpp", "sh.cpp", "ssim.cpp")
FLAGS = (
    *("-std=c++17", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"),
    *("-fno-exceptions", "-fno-rtti", "-nostdlib++", "-fvisibility=hidden", "-shared", "-s"),
    *("-Wall", "-Wextra"),
)


@dataclass(frozen=True)
class Target:
    """One library: `system` and `machine` as `host` names them, `level` the x86-64 level (1 where there is none)."""

    system: str
    machine: str
    level: int
    triple: str
    cpu: str
    vector_width: int

    @property
    def path(self) -> Path:
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
    digest = hashlib.sha256(" ".join(FLAGS).encode())
    for name in ("simd.h", *SOURCES):
        digest.update((FOLDER / name).read_bytes())
    return digest.hexdigest()[:12]


def host() -> tuple[str, str]:
    """(system, machine) of this Python, e.g. ("linux", "x64")."""
    system = {"Windows": "windows", "Darwin": "macos"}.get(platform.system(), "linux")
    machine = platform.machine().lower()
    return system, {"x86_64": "x64", "amd64": "x64", "aarch64": "arm64"}.get(machine, machine)


def host_targets() -> list[Target]:
    """What can be built for this machine, the highest level first; empty on a platform without kernels."""
    return sorted((t for t in TARGETS if (t.system, t.machine) == host()), key=lambda t: -t.level)


def build(targets: list[Target]) -> list[Path]:
    """Compile what is missing among `targets`; returns their paths. Libraries of older sources are removed.

    Raises subprocess.CalledProcessError, after the compiler's own words on stderr, when a source does not compile.
    """
    LIBRARIES.mkdir(parents=True, exist_ok=True)
    for library in LIBRARIES.glob("swag-*"):
        if library.stem.rpartition("-")[2] != source_hash():
            library.unlink()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(_compile, (target for target in targets if not target.path.exists())))
    return [target.path for target in targets]


def _compile(target: Target) -> None:
    command = [sys.executable, "-m", "ziglang", "c++", "-target", target.triple, f"-mcpu={target.cpu}"]
    command += [f"-DVW={target.vector_width}", *FLAGS, *([] if target.system == "windows" else ["-fPIC"])]
    with tempfile.TemporaryDirectory(dir=LIBRARIES) as folder:  # linkers leave other files beside the library
        made = Path(folder) / target.path.name
        subprocess.run([*command, *SOURCES, "-o", str(made)], cwd=FOLDER, check=True)
        os.replace(made, target.path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="every platform, not only this machine's")
    every = parser.parse_args().all
    for path in build(list(TARGETS) if every else host_targets()):
        print(path)


if __name__ == "__main__":
    main()
