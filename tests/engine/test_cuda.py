"""The CUDA backend: its kernels on CPU fibres, or, with SWAG_TEST_CUDA=1, on the card that is there."""

import ctypes
import math
import os
import re
import subprocess
import sys
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from benchmarks import gpu_check
from benchmarks.step import both_steps
from swag_engine.base.errors import InputError
from swag_engine.kernels import build, cuda, cuda_driver
from swag_engine.kernels.cuda import CudaKernels
from swag_engine.kernels.hardware import device_for
from swag_engine.kernels.protocol import Projection
from swag_engine.kernels.reference.projection import project
from swag_engine.rasterize.api import contributions, rasterize
from swag_engine.training.losses import photometric
from swag_engine.water.medium import Medium, through_water
from tests.engine.cuda_fibres import DEVICE, ON_CARD, Fibres, cuda_backend, pretend_card
from tests.engine.kernel_suite import KernelSuite
from tests.engine.raster_scenes import changed, clear_scenes, make_scene, relative_error
from tests.engine.raster_scenes import run as run_with

PTXAS = "nvidia-cuda-nvcc-cu12"
ARCHITECTURES = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")

on_fibres = pytest.mark.skipif(ON_CARD, reason="about the fibres themselves")


@pytest.fixture(scope="module", autouse=True)
def kernels(request):
    with cuda_backend(request.config.cache.mkdir("cuda_fibres")) as kernels:
        yield kernels


@pytest.fixture
def fibres(kernels):
    return kernels._launcher


def on_device(values):
    return {k: v.float().to(DEVICE) if isinstance(v, torch.Tensor) else v for k, v in values.items()}


def run(scene):
    """As raster_scenes.run, by the CUDA kernels."""
    return run_with(scene, "cuda", device=DEVICE)


def check(scene, image=1e-5):
    truth, _ = run_with(scene, "torch", torch.float64)
    result, _ = run(scene)
    errors = {key: relative_error(result[key], truth[key]) for key in truth}
    assert max(errors["channels_out"], errors["alpha"]) < image, errors
    assert max(errors.values()) < 1e-4, errors


# -- images and gradients ---------------------------------------------------------------------------------------------


class TestCuda(KernelSuite):
    """The suite of all backends."""

    backend, device, small_scenes = "cuda", DEVICE, 100


@pytest.mark.parametrize("channels", [2, 5, 8, 35])
def test_agrees_for_other_numbers_of_channels(channels):
    check(next(clear_scenes(1, n=50, channels=channels, width=36, height=35)))


def test_agrees_on_images_one_pixel_wide():
    for scene in clear_scenes(2, n=200, width=1, height=31, size=0.05):
        check(scene)


def test_agrees_for_needles_a_hundred_thousand_times_longer_than_wide():
    for seed in range(4):
        generator = torch.Generator().manual_seed(seed)
        quats = torch.randn(5, 4, generator=generator).double()
        check(changed(quats=quats, scales=lambda s: s * 0 + torch.tensor([100, 1e-3, 1e-3])), image=1e-4)


def test_the_determinant_of_a_needles_conic_keeps_its_digits(kernels):
    generator = torch.Generator().manual_seed(0)
    along = torch.nn.functional.normalize(torch.randn(100, 2, generator=generator), dim=1)
    across = torch.stack([-along[:, 1], along[:, 0]], 1)
    xx, xy, yy = (
        along[:, i] * along[:, j] / 60**2 + across[:, i] * across[:, j] / 0.6**2 for i, j in ((0, 0), (0, 1), (1, 1))
    )
    conics = torch.stack([xx, xy, yy], 1)
    geometry = torch.full([100, 2], 20.0), conics, torch.ones(100), torch.full([100], 300.0)
    projected = Projection(*(tensor.to(DEVICE) for tensor in geometry))
    pairs = kernels.tile_pairs(projected, torch.full([100], 0.3, device=DEVICE), 40, 30)
    a, b, c = conics.double().unbind(1)
    torch.testing.assert_close(pairs.splats[:, 4].double().cpu(), (a - b * b / c) / 2, atol=0, rtol=3e-7)


def test_same_bits_each_time():
    scene = make_scene(300, channels=4, width=70, height=50, size=0.2)
    first, second = run(scene)[0], run(scene)[0]
    assert all(torch.equal(first[key], second[key]) for key in first)


@on_fibres
def test_no_result_depends_on_the_order_of_threads_between_barriers(fibres, monkeypatch):
    scene = make_scene(300, channels=9, width=40, height=30, size=0.4)
    a, b = torch.rand(2, 30, 40, 3)

    def everything():
        image = a.clone().requires_grad_()
        loss = photometric(image, b, None, backend="cuda")
        loss.backward()
        scene3 = scene | {"channels": scene["channels"][:, :3], "background": scene["background"][:3]}
        return [*run(scene)[0].values(), *contributions_of(scene3, images=2), loss, image.grad]

    fair = everything()
    for order in (1, 2):
        monkeypatch.setattr(fibres, "order", order)
        assert all(torch.equal(x, y) for x, y in zip(fair, everything(), strict=True))


def test_large_images_have_more_tiles_than_16_bits(kernels):
    size = 16 * 182
    scene = changed(n=3, width=size, height=size)
    tensors = [v for v in on_device(scene).values() if isinstance(v, torch.Tensor)]
    means, quats, scales, opacities, channels, viewmat, K, background = tensors
    projection = kernels.project(means, quats, scales, opacities, channels, viewmat, K, size, size)
    pairs = kernels.tile_pairs(projection, opacities, size, size)
    tile_of = torch.searchsorted(pairs.tile_starts, torch.arange(len(pairs.ids), device=DEVICE), right=True) - 1
    assert pairs.tile_starts.shape == (182 * 182 + 1,) and pairs.tile_starts[-1] == len(pairs.ids) > 0
    places = (tile_of % 182 * 16 + 8, tile_of // 182 * 16 + 8)
    for axis, place in enumerate(places):
        assert ((place - projection.means2d[pairs.ids.long(), axis]).abs() < projection.radii.max() + 17).all()


@on_fibres
def test_a_run_keeps_its_tensors_where_the_kernels_take_them():
    assert device_for("cuda") == device_for("auto") == torch.device(DEVICE)


def test_too_many_pairs_are_refused():
    scene = on_device(changed(n=1500, width=20_000, height=20_000, scales=lambda s: s * 0 + 1e4))
    with pytest.raises(InputError, match="meet [0-9]{10} tiles"):
        rasterize(**scene, backend="cuda")


# -- contributions -----------------------------------------------------------------------------------------------------


def contributions_of(scene, images):
    given = random_images(scene, images)
    found = contributions(**on_device(scene | given), backend="cuda")
    return [value.double().cpu() for value in (found.weighted, found.importance, found.error)]


def random_images(scene, images):
    generator = torch.Generator().manual_seed(5)
    size = scene["height"], scene["width"]
    return {
        "weights": torch.rand(*size, images, generator=generator, dtype=torch.float64),
        "image_gradient": torch.randn(*size, scene["channels"].shape[1], generator=generator, dtype=torch.float64),
    }


def contributions_by_definition(scene, images):
    """Sums of contributions: one Gaussian after the other, pixel by pixel."""
    names = ("means", "quats", "scales", "opacities", "channels", "viewmat", "K", "width", "height")
    seen, given = project(*(scene[name] for name in names)), random_images(scene, images)
    n = len(scene["means"])
    sums = torch.zeros(n, images).double(), torch.zeros(n).double(), torch.zeros(n).double()
    order = [i for i in torch.argsort(seen.depths, stable=True).tolist() if seen.radii[i] > 0]
    for y in range(scene["height"]):
        for x in range(scene["width"]):
            drawn, transmittance = [], 1.0
            for i in order:
                (u, v), (a, b, c), opacity = seen.means2d[i].tolist(), seen.conics[i].tolist(), scene["opacities"][i]
                dx, dy = u - x - 0.5, v - y - 0.5
                unclamped = opacity.item() * math.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
                alpha = min(unclamped, 0.99)
                if alpha < 1 / 255:
                    continue
                if transmittance * (1 - alpha) <= 1e-4:
                    break
                drawn.append((i, alpha, transmittance, unclamped < 0.99))
                transmittance *= 1 - alpha
            behind = scene["background"]
            for i, alpha, before, varies in reversed(drawn):
                color = scene["channels"][i]
                change = scene["opacities"][i] * before * (color - behind) * varies
                sums[0][i] += before * alpha * given["weights"][y, x]
                sums[1][i] += change.square().sum()
                sums[2][i] += (given["image_gradient"][y, x] * change).sum() ** 2
                behind = alpha * color + (1 - alpha) * behind
    return sums


@pytest.mark.parametrize("channels, images", [(1, 0), (3, 3), (8, 14)])
def test_contributions_agree_with_their_definition(channels, images):
    scene = next(clear_scenes(1, n=25, channels=channels, width=19, height=17, size=0.5))
    turn, shift = scene["viewmat"][:3, :3], scene["viewmat"][:3, 3]
    scene["means"][0] = turn.T @ (torch.tensor([0.0, 0.0, 1.2]).double() - shift)
    scene["opacities"][0], scene["scales"][0] = 1.0, 0.5  # clamped at its centre, in the image
    truth, result = contributions_by_definition(scene, images), contributions_of(scene, images)
    for value, expected in zip(result, truth, strict=True):
        assert value.shape == expected.shape
        assert not expected.numel() or relative_error(value, expected) < 1e-5


# -- colors, loss, optimiser ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("raw", [-200.0, 1e4])
@pytest.mark.parametrize("range_", [0.0, 1e-20, 1e6])
def test_water_stays_finite(raw, range_):
    colors, offsets = torch.tensor([[0.0, 0.5, 1.3]]), torch.tensor([[0.0, 0.0, range_]])
    medium = Medium(torch.full((3,), raw), torch.full((3,), raw), torch.zeros(9, 3), 1.0)
    medium.background_sh[0] = torch.tensor([-300.0, 0.0, 300.0])
    medium = medium.to(torch.device(DEVICE))
    leaves = [t.to(DEVICE).requires_grad_() for t in (colors, offsets)]
    parameters = [t.requires_grad_() for t in medium.parameters().values()]
    seen = through_water(leaves[0], leaves[1], medium, backend="cuda")
    assert seen.isfinite().all()
    assert all(g.isfinite().all() for g in torch.autograd.grad(seen.sum(), [*leaves, *parameters]))


# -- fibres ------------------------------------------------------------------------------------------------------------

STUCK = """
extern "C" __global__ void stuck(float *values) {
    if (threadIdx.x == 40) __syncthreads();
    values[threadIdx.x] = __shfl_xor_sync(0xffffffffu, values[threadIdx.x], 1);
}
"""


@on_fibres
def test_a_barrier_that_some_threads_miss_is_reported(tmp_path):
    source = tmp_path / "stuck.cu"
    source.write_text(STUCK)
    fibres = Fibres(tmp_path, [source])
    for _ in range(2):
        with pytest.raises(RuntimeError, match="stuck, block 0: 32 threads wait"):
            fibres.launch("stuck", 1, 64, [torch.zeros(64)])
    values = torch.arange(32.0)
    fibres.launch("stuck", 1, 32, [values])
    assert torch.equal(values, torch.arange(32.0) + torch.tensor([1.0, -1.0]).repeat(16))


@on_fibres
def test_wrong_arguments_are_refused(fibres):
    with pytest.raises(TypeError, match="sh_forward takes iiiFFFF, not iifF"):
        fibres.launch("sh_forward", 1, 256, [1, 2, 0.5, torch.zeros(3)])


@on_fibres
def test_what_gpu_check_times_runs(monkeypatch):
    monkeypatch.setattr(gpu_check, "DEVICE", torch.device("cpu"))
    monkeypatch.setattr(gpu_check, "SIZE", (64, 48))
    monkeypatch.setattr(gpu_check, "milliseconds", lambda step: step() and 1.0)
    monkeypatch.setattr(gpu_check, "both_steps", lambda *given: both_steps(*given[:-1]))  # fibres are slow
    gpu_check.small_scene()
    for step in gpu_check.stages(300, 64, 48).values():
        step()
    assert len(gpu_check.training_steps(100)) == 2


# -- PTX and the driver ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ptx():
    try:
        return build.build_ptx()
    except build.metadata.PackageNotFoundError:
        pytest.skip(f"{build.NVRTC} is not installed")


def test_ptx_is_built_once(ptx):
    assert ptx.read_text(encoding="ascii").count(".entry blend_forward_") == cuda.GROUP
    written = ptx.stat().st_mtime_ns
    assert build.build_ptx() == ptx == build.ptx_path() and ptx.stat().st_mtime_ns == written


def find_ptxas() -> Path | None:
    """Return the path of CUDA's assembler, None where its package is not installed."""
    files = (metadata.files(PTXAS) or []) if gpu_check.version(PTXAS) else []
    return next((Path(str(f.locate())) for f in files if f.stem == "ptxas"), None)


def assemble(ptx: Path, architecture: str) -> dict[str, dict[str, int]]:
    """Assemble a PTX file; return per kernel the registers per thread and the bytes of stack and spills."""
    command = [str(find_ptxas()), "-v", f"-arch={architecture}", str(ptx), "-o", os.devnull]
    report = subprocess.run(command, check=True, capture_output=True, text=True).stderr
    kernels = re.findall(
        r"Compiling entry function '(\w+)'.*?(\d+) bytes stack frame, (\d+) bytes spill stores.*?Used (\d+) registers",
        report,
        re.DOTALL,
    )
    return {name: {"registers": int(r), "stack": int(st), "spills": int(sp)} for name, st, sp, r in kernels}


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_every_kernel_assembles_without_spills(architecture, ptx):
    if not find_ptxas():
        pytest.skip(f"{PTXAS} is not installed")
    kernels = assemble(ptx, architecture)
    assert {"adam_step", "blend_backward_8", "contributions_8", "l1_ssim_forward", "pack"} <= kernels.keys()
    spilling = {name: found for name, found in kernels.items() if found["spills"] or found["stack"]}
    assert not spilling


def test_ptx_that_does_not_compile_says_why(tmp_path, missing, monkeypatch):
    if not find_spec("nvidia.cuda_nvrtc"):
        missing(f"NVRTC is missing: pip install {build.NVRTC}.")
    (tmp_path / "wrong.cu").write_text("int wrong = nothing;")
    for name, value in {"FOLDER": tmp_path, "CUDA_SOURCES": ("wrong.cu",), "CUDA_HEADERS": ()}.items():
        monkeypatch.setattr(build, name, value)
    with pytest.raises(RuntimeError, match='wrong.cu.*identifier "nothing" is undefined'):
        build.build_ptx()


FAKE_DRIVER = r"""
#include <stdint.h>
#include <string.h>
int version = 12080, load_error = 0, contexts = 0;
unsigned grid, block;
void *stream;
int cuDriverGetVersion(int *to) { return *to = version, 0; }
int cuDeviceGet(int *to, int ordinal) { return *to = ordinal, 0; }
int cuDevicePrimaryCtxRetain(void **to, int device) { return *to = (void *)0x123456789abcLL, 0; }
int cuCtxPushCurrent_v2(void *context) { return contexts++, context == (void *)0x123456789abcLL ? 0 : 201; }
int cuCtxPopCurrent_v2(void **to) { return contexts--, 0; }
int cuModuleLoadDataEx(void **to, const char *ptx, unsigned count, int *options, void **values) {
    if (load_error && count == 2 && options[0] == 5 && options[1] == 6)
        strncpy((char *)values[0], "line 1 is wrong", (size_t)values[1]);
    *to = (void *)0x7fff00000001LL;
    return contexts != 1 || !strstr(ptx, ".entry pack(") ? 1 : load_error;
}
int cuModuleGetFunction(void **to, void *module, const char *name) {
    *to = (void *)0x7fff00000002LL;
    return module != (void *)0x7fff00000001LL || strcmp(name, "probe") ? 500 : 0;
}
int cuLaunchKernel(void *function, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz,
                   unsigned shared, void *on, void **values, void **extra) {
    if (function != (void *)0x7fff00000002LL || gy * gz * by * bz != 1 || shared || extra || contexts != 1) return 1;
    grid = gx, block = bx, stream = on;
    (*(float **)values[0])[0] = (float)(*(int64_t *)values[1] >> 32);
    (*(float **)values[0])[1] = *(float *)values[2];
    return 0;
}
int cuGetErrorString(int error, const char **to) { return *to = error == 500 ? "not found" : "too bad", 0; }
"""


@pytest.fixture(scope="module")
def fake_library(tmp_path_factory, missing):
    if not find_spec("ziglang"):
        missing("The compiler is missing: pip install ziglang.")
    folder = tmp_path_factory.mktemp("fake driver")
    (folder / "fake.c").write_text(FAKE_DRIVER)
    command = [sys.executable, "-m", "ziglang", "cc", "-O1", "-shared", "-fPIC", "fake.c", "-o", "fake.so"]
    subprocess.run(command, cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "fake.so"))


@pytest.fixture
def fake(fake_library, ptx, monkeypatch):
    pretend_card(monkeypatch, fake_library)
    yield fake_library
    assert ctypes.c_int.in_dll(fake_library, "contexts").value == 0
    ctypes.c_int.in_dll(fake_library, "version").value = 12080
    ctypes.c_int.in_dll(fake_library, "load_error").value = 0


def test_the_driver_passes_arguments_grid_and_stream(fake):
    values = torch.zeros(2)
    cuda_driver.Driver().launch("probe", 2**31 - 1, 256, [values, 5 << 32, 0.25])
    assert values.tolist() == [5.0, 0.25]
    assert ctypes.c_uint.in_dll(fake, "grid").value == 2**31 - 1
    assert ctypes.c_uint.in_dll(fake, "block").value == 256
    assert ctypes.c_void_p.in_dll(fake, "stream").value == 2**40 + 7


def test_no_blocks_no_launch(fake):
    cuda_driver.Driver().launch("no such kernel", 0, 256, [torch.zeros(2)])


def test_errors_of_the_driver_have_its_message(fake):
    with pytest.raises(cuda_driver.CudaError, match="cuModuleGetFunction failed with error 500, not found"):
        cuda_driver.Driver().launch("no such kernel", 1, 256, [torch.zeros(2)])


def without_library():
    raise OSError("libcuda.so.1: cannot open shared object file")


@pytest.mark.parametrize(
    "where, name, value, reason",
    [
        (torch.version, "cuda", None, "this PyTorch was built without CUDA"),
        (cuda_driver, "_load_library", without_library, "no NVIDIA driver is installed"),
        (torch.cuda, "is_available", lambda: False, "PyTorch finds no NVIDIA card"),
        (torch.cuda, "get_device_capability", lambda: (6, 1), "Fake 1 has compute capability 6.1"),
        (cuda_driver, "ptx_path", lambda: build.FOLDER / "none.ptx", "its kernels are not built"),
        ("library", "version", 11080, "the NVIDIA driver knows CUDA 11.8, 12.0 is needed"),
        ("library", "load_error", 222, "error 222, too bad\nline 1 is wrong"),
    ],
)
def test_the_reason_why_cuda_is_unavailable(where, name, value, reason, fake, monkeypatch):
    if where == "library":
        ctypes.c_int.in_dll(fake, name).value = value
    else:
        monkeypatch.setattr(where, name, value)
    assert reason in CudaKernels().unavailable_reason()
