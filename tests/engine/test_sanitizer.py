"""The kernels built with address and undefined-behaviour sanitizers run their tests: no read or write out of bounds."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from swag_engine.kernels import build

ROOT = Path(__file__).resolve().parents[2]
TESTS = (
    "test_rasterize.py", "test_losses.py", "test_optimizer.py", "test_sh.py", "test_water.py", "test_native_step.py",
)  # fmt: skip
RUN = """
import sys
from pathlib import Path
import pytest
from swag_engine.kernels.backends import KERNELS
from swag_engine.kernels.cpu import CpuKernels
from swag_engine.kernels.cpu_library import CpuLibrary
KERNELS["cpu"] = CpuKernels(lambda: CpuLibrary(Path(sys.argv[1])))
skipped = "instruction_set or in_float32 or without_kernels or build_compiles"
# What runs the reference alone calls none of these kernels.
skipped += " or reference_blends or finite_differences or torch] or make_on_card"
skipped += " or 200_steps or resumes or float64_reference or step_that_is_not_finite or left_to_autograd"
sys.exit(pytest.main(["-x", "-v", "--capture=no", "-p", "no:cacheprovider", "-k", f"not ({skipped})", *sys.argv[2:]]))
"""


@pytest.mark.skipif(not shutil.which("g++") or sys.platform != "linux", reason="needs g++ on Linux")
def test_kernels_stay_in_bounds(tmp_path):
    library = tmp_path / "sanitized.so"
    flags = ["-std=c++17", "-O0", "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    flags += ["-fno-omit-frame-pointer", "-ffp-contract=fast", "-fPIC", "-shared", "-DVW=8", "-mavx2", "-mfma"]
    subprocess.run(["g++", *flags, *build.SOURCES, "-o", str(library)], cwd=build.FOLDER, check=True)
    # The C++ library comes first too, because the sanitizer looks for its exceptions when it starts.
    names = ("libasan.so", "libstdc++.so.6")
    found = [subprocess.run(["g++", f"-print-file-name={name}"], capture_output=True, text=True) for name in names]
    preload = " ".join(path.stdout.strip() for path in found)
    environment = os.environ | {"LD_PRELOAD": preload, "ASAN_OPTIONS": "detect_leaks=0", "PYTHONPATH": str(ROOT)}
    tests = [str(ROOT / "tests" / "engine" / name) for name in TESTS]
    command = [sys.executable, "-c", RUN, str(library), *tests]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-6000:]
    assert "passed" in done.stdout
