"""What the vectors of simd.h compute, and the rasteriser on a processor with NEON instructions, which QEMU emulates."""

import ctypes
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from swag_engine.kernels import build
from swag_engine.kernels.protocol import Projection
from swag_engine.kernels.reference.kernels import REFERENCE
from swag_engine.kernels.reference.projection import project
from tests.engine.raster_scenes import clear_scenes, relative_error

PROGRAM = Path(__file__).parent / "raster_program.cpp"
ARM_LIBC = Path("/usr/aarch64-linux-gnu")
COMPILER = (sys.executable, "-m", "ziglang", "c++", "-std=c++17", "-O2", f"-I{build.FOLDER}")
FUNCTIONS = """
#include "simd.h"
#define OVER(name) API void name##_of(int64_t n, const float *from, float *to) { \\
    for (int64_t i = 0; i < n; i += VW) { \\
        Vec v; memcpy(&v, from + i, sizeof v); v = name(v); memcpy(to + i, &v, sizeof v); } }
OVER(exp2)
OVER(log2)
"""


@pytest.fixture(scope="module")
def functions(tmp_path_factory):
    folder = tmp_path_factory.mktemp("functions")
    source, library = folder / "functions.cpp", folder / "functions.library"
    source.write_text(FUNCTIONS, encoding="utf-8")
    target = build.host_targets()[-1]
    flags = ["-target", target.triple, f"-mcpu={target.cpu}", f"-DVW={target.vector_width}", "-shared", "-nostdlib++"]
    subprocess.run([*COMPILER, *flags, str(source), "-o", str(library)], check=True)
    return ctypes.CDLL(str(library))


def values(function, x):
    result = np.empty_like(x)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (x, result)]
    function(ctypes.c_int64(len(x)), *pointers)
    return result.astype(np.float64)


def test_powers_of_two_have_the_stated_error(functions):
    x = np.concatenate([np.arange(1 << 20) / (1 << 20), np.linspace(-126, 126, 1 << 16)]).astype(np.float32)
    exact = np.exp2(x.astype(np.float64))
    assert np.abs(values(functions.exp2_of, x) / exact - 1).max() < 2.5e-7


def test_logarithms_have_the_stated_error(functions):
    x = np.exp2(np.linspace(-100, 100, 1 << 18)).astype(np.float32)
    exact = np.log2(x.astype(np.float64))
    assert np.abs(values(functions.log2_of, x) - exact).max() < 4e-6  # half a unit of the last place at 100 is 3.8e-6
    near_one = np.linspace(0.5, 2, 1 << 18).astype(np.float32)
    assert np.abs(values(functions.log2_of, near_one) - np.log2(near_one.astype(np.float64))).max() < 2.5e-7


@pytest.mark.skipif(sys.platform != "linux", reason="QEMU's user mode is for Linux")
def test_the_rasteriser_agrees_on_neon(tmp_path, missing):
    """Takes about 10 s: the kernels are compiled for another processor."""
    qemu = shutil.which("qemu-aarch64") or shutil.which("qemu-aarch64-static")
    if not (qemu and ARM_LIBC.is_dir()):
        missing("needs QEMU and a libc for aarch64 (Debian: apt-get install qemu-user libc6-arm64-cross)")
    target = next(t for t in build.TARGETS if (t.system, t.machine) == ("linux", "arm64"))
    program, given, results = (tmp_path / name for name in ("program", "scene", "results"))
    flags = ["-target", target.triple, f"-mcpu={target.cpu}", f"-DVW={target.vector_width}", "-nostdlib++"]
    sources = [str(PROGRAM), str(build.FOLDER / "raster.cpp")]
    subprocess.run([*COMPILER, *flags, *sources, "-o", str(program)], check=True)

    for scene in clear_scenes(2, n=60, width=45, height=70):
        truth, arrays = blended_by_reference(scene)
        with given.open("wb") as file:
            np.array([60, scene["width"], scene["height"], 3]).tofile(file)
            for array in arrays:
                array.detach().float().numpy().tofile(file)
        subprocess.run([qemu, "-L", str(ARM_LIBC), str(program), str(given), str(results)], check=True)
        values = torch.from_numpy(np.fromfile(results, np.float32)).double()
        for value, expected in zip(values.split([t.numel() for t in truth]), truth, strict=True):
            assert relative_error(value.view_as(expected), expected) < 1e-5


def blended_by_reference(scene):
    """Results that the program writes, in float64, and its inputs."""
    names = "means", "quats", "scales", "opacities", "channels", "viewmat", "K", "width", "height"
    seen = project(*(scene[name] for name in names))
    leaves = [
        t.float().double().requires_grad_() for t in (seen.means2d, seen.conics, scene["opacities"], scene["channels"])
    ]
    depths, radii = seen.depths.float().double(), seen.radii.float().double()
    projected = Projection(leaves[0], leaves[1], depths, radii)
    image, alpha = REFERENCE.blend(
        projected, leaves[2], leaves[3], scene["background"], scene["width"], scene["height"]
    )
    generator = torch.Generator().manual_seed(1)
    by_image, by_alpha = (torch.randn(t.shape, generator=generator).double() for t in (image, alpha))
    gradients = torch.autograd.grad([image, alpha], leaves, [by_image, by_alpha])
    arrays = *leaves[:3], depths, radii, leaves[3], scene["background"], by_image, by_alpha
    return (image.detach(), 1 - alpha.detach(), *gradients), arrays
