"""The WebGPU backend, on a driver that runs its kernels on the processor, with WebGPU's default limits."""

import os
import re
import subprocess
import sys
from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest
import torch

from swag_engine.base.errors import InputError
from swag_engine.kernels import constants, hardware, webgpu_device, webgpu_tiles, webgpu_training
from swag_engine.kernels.backends import CPU, KERNELS, kernels_for
from swag_engine.kernels.hardware import device_for, hardware_for, with_backend_of_run
from swag_engine.kernels.webgpu import WebGpuKernels
from swag_engine.kernels.webgpu_device import (
    ALLOW_SOFTWARE,
    DEFAULT_LIMITS,
    WebGpu,
    WebGpuFailure,
    WebGpuUnavailable,
    request,
)
from swag_engine.kernels.webgpu_training import adam_fields
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.losses import photometric
from swag_engine.training.optimizer import BETAS
from swag_engine.training.trainer import train
from tests.engine.kernel_suite import KernelSuite
from tests.engine.raster_scenes import (
    changed,
    clear_scenes,
    make_scene,
    relative_error,
    run,
)
from tests.engine.webgpu_devices import Adapter, adapters_are, software_device


@pytest.fixture(scope="module")
def driver(missing):
    if not webgpu_device._adapters():
        missing("A Vulkan driver is missing: apt-get install mesa-vulkan-drivers.")


@pytest.fixture(scope="module", params=["atomic floats", "compare and swap"])
def gpu(request, missing):
    return software_device(missing, request.param == "atomic floats")


@pytest.fixture
def kernels(gpu, monkeypatch):
    """The backend, registered as such."""
    monkeypatch.setitem(KERNELS, "wgpu", WebGpuKernels(CPU, lambda: gpu))
    return KERNELS["wgpu"]


@pytest.mark.usefixtures("kernels")
class TestWgpu(KernelSuite):
    """The suite of all backends, with both ways to add floats."""

    backend = "wgpu"

    def adam(self, parameter, gradients, backend, epsilon):
        """By the kernel of a step on the device."""
        if backend != self.backend:
            return super().adam(parameter, gradients, backend, epsilon)
        kernels = KERNELS["wgpu"]
        assert isinstance(kernels, WebGpuKernels)
        gpu, count = kernels.gpu, parameter.numel()
        buffers = [gpu.upload(values) for values in (parameter, 0 * parameter, 0 * parameter)]
        for number, gradient in enumerate(gradients):
            call = {"count": count, **adam_fields(0.1, *BETAS, epsilon, number + 1)}
            bound = dict(zip(("parameter", "mean", "square"), buffers, strict=True))
            gpu.run("adam_step", -(-count // 256), call, **bound, gradient=gpu.upload(gradient), skipped=gpu.empty(1))
        return [gpu.read(buffer, tuple(parameter.shape)) for buffer in buffers]


def test_agrees_with_several_blocks_of_the_sort(kernels):
    scene = make_scene(2500, width=60, height=44, size=0.06)
    truth, result = run(scene, "cpu")[0], run(scene, "wgpu")[0]
    assert max(relative_error(result[key], truth[key]) for key in truth) < 1e-4


# -- runs --------------------------------------------------------------------------------------------------------------

FEW = TrainSettings(recipe="swag", iterations=5, width=32, max_gaussians=100, backend="cpu")


@pytest.mark.parametrize("gpu", ["atomic floats"], indirect=True)
def test_a_run_learns_what_it_learns_on_the_cpu(gpu, kernels, tiny_scene, tmp_path):
    psnr = {}
    for backend in ("cpu", "wgpu"):
        done = train(tiny_scene, tmp_path / backend, replace(FEW, backend=backend))
        psnr[backend] = done["metrics"]["test_psnr"]
    assert gpu.counters.dispatches > 300 and abs(psnr["wgpu"] - psnr["cpu"]) < 0.01, psnr


def lost(*_):
    import wgpu

    raise wgpu.GPUError("Parent device\n  is lost.")


def test_when_the_driver_fails_the_processor_takes_over(gpu, kernels, monkeypatch):
    monkeypatch.setattr(gpu.device.queue, "submit", lost)
    result, expected = run(changed(), "wgpu")[0], run(changed(), "cpu")[0]
    assert all(torch.equal(result[key], expected[key]) for key in expected)
    assert re.fullmatch(r"The graphics card \S.* failed: Parent device is lost. Training continued .*", kernels.failure)
    assert kernels_for("wgpu", torch.zeros(1)) is CPU and not gpu._pending


def test_a_failure_in_a_backward_pass_is_one_sentence(gpu, kernels, monkeypatch):
    image = torch.rand(9, 9, 3).requires_grad_()
    loss = photometric(image, torch.rand(9, 9, 3), None, backend="wgpu")
    monkeypatch.setattr(gpu.device.queue, "submit", lost)
    with pytest.raises(InputError, match=r"^The graphics card \S.* failed: Parent device is lost. Train with"):
        loss.backward()


# -- limits ------------------------------------------------------------------------------------------------------------


def test_operations_on_each_gaussian_run_in_parts_that_fit_a_binding(kernels, gpu, monkeypatch):
    scene = next(clear_scenes(1, n=50))
    tensors = {k: v.float() if isinstance(v, torch.Tensor) else v for k, v in scene.items()}
    del tensors["background"]
    whole = kernels.project(**tensors)
    monkeypatch.setattr(gpu, "largest_binding", 4 * 4 * 7)  # seven Gaussians
    before = gpu.counters.dispatches
    parts = kernels.project(**tensors)
    assert gpu.counters.dispatches - before == 8
    assert all(torch.equal(getattr(whole, name), getattr(parts, name)) for name in ("means2d", "conics", "radii"))


def test_lists_that_a_card_cannot_read_at_once_are_refused(kernels, gpu, monkeypatch):
    monkeypatch.setattr(gpu, "largest_binding", 1000)
    with pytest.raises(InputError, match="The Gaussians take 2.0 kB, more than the 1.0 kB that .* reads at once"):
        run(changed(n=50), "wgpu")


def test_workgroup_memory_is_what_webgpu_allows():
    """WebGPU's rules for the sizes of types; the driver of the tests has more memory and would not complain."""
    numbers = {"f32": 1, "u32": 1, "atomic<u32>": 1, "vec2f": 2, "vec3f": 4, "vec4f": 4}
    sizes = {}
    for kernel, files in webgpu_device.STAGES.items():
        text = re.sub(r" *//.*", "", webgpu_device._source(files, True).text)
        functions = dict(re.findall(r"(?ms)^fn (\w+)([^\n]*}$|.*?^})", text))
        used = {kernel}
        for _ in functions:
            used |= {name for name in functions for other in used if re.search(rf"\b{name}\(", functions[other])}
        body = "".join(functions[name] for name in used)
        size = 0
        for name, kind in re.findall(r"(?m)^var<workgroup> (\w+): (.*);$", text):
            count = 1
            while inner := re.fullmatch(r"array<(.*), (\d+)>", kind):
                kind, count = inner[1], count * int(inner[2])
            size += 4 * numbers[kind] * count * bool(re.search(rf"\b{name}\b", body))
        sizes[kernel] = size
    assert max(sizes.values()) <= DEFAULT_LIMITS["max-compute-workgroup-storage-size"], sizes
    assert sizes["l1_ssim_backward"] == 676 * 16 + 416 * 12 and sizes["move_by_digit"] == 4 * (256 + 2048)


def test_more_groups_than_a_dimension_holds(kernels, gpu, monkeypatch):
    scene = next(clear_scenes(1, n=700, width=47, height=35, size=0.05))
    truth, _ = run(scene, "wgpu")
    monkeypatch.setitem(DEFAULT_LIMITS, "max-compute-workgroups-per-dimension", 2)
    result, _ = run(scene, "wgpu")
    assert max(relative_error(result[key], truth[key]) for key in truth) < 1e-5


def test_dispatches_and_bytes_of_an_image_are_counted(kernels, gpu):
    scene = next(clear_scenes(1, n=50, width=47, height=35))
    before = gpu.counters.dispatches, gpu.counters.downloaded
    run(scene, "wgpu")
    # project both ways 2; pack, count, fill, ranges 4; sum of counts 2; sort by depth 8 x 4, by tile 1 x 4 (9 tiles);
    # blend both ways 2, moments 1
    assert gpu.counters.dispatches - before[0] == 2 + 4 + 2 + 32 + 4 + 3
    projected, gradients, pixels = 4 * 50 * (7 + 10), 4 * 50 * (6 + 10), 4 * 47 * 35 * (4 + 2)
    assert gpu.counters.downloaded - before[1] == projected + gradients + pixels + 4


# -- adapters ----------------------------------------------------------------------------------------------------------


def test_a_card_comes_before_a_graphics_chip_and_software_comes_last(monkeypatch):
    software, chip, card = Adapter("llvm", "CPU"), Adapter("chip", "IntegratedGPU"), Adapter("card", "DiscreteGPU")
    monkeypatch.setenv(ALLOW_SOFTWARE, "1")
    adapters_are(monkeypatch, software, chip, card)
    assert request().adapter_name == "card"
    adapters_are(monkeypatch, software, chip)
    assert request().adapter_name == "chip"
    adapters_are(monkeypatch, software)
    assert request().adapter_name == "llvm" and request().software


def test_the_memory_of_a_card_is_asked_of_its_driver(driver):
    info = webgpu_device._adapters()[0].info
    assert webgpu_device._vulkan_memory(info["vendor_id"], info["device_id"]) >= 2**30
    assert webgpu_device._vulkan_memory(1, 2) is None


def test_software_is_refused_unless_asked_for(monkeypatch):
    monkeypatch.delenv(ALLOW_SOFTWARE, raising=False)
    adapters_are(monkeypatch, Adapter("llvm", "CPU"))
    monkeypatch.setitem(KERNELS, "wgpu", WebGpuKernels(CPU))
    with pytest.raises(InputError, match="llvm is not used: it computes on the processor; set SWAG_WGPU_SOFTWARE=1"):
        device_for("wgpu")
    with pytest.raises(InputError, match="The wgpu backend cannot run here: llvm is not used"):
        kernels_for("wgpu", torch.zeros(1))


def test_no_adapter_and_no_package_are_said(monkeypatch):
    adapters_are(monkeypatch)
    with pytest.raises(WebGpuUnavailable, match="no graphics adapter"):
        request()
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "wgpu", None)
    kernels = WebGpuKernels(CPU)
    assert "the package wgpu is not installed" in kernels.unavailable_reason()
    assert kernels.details() == {"device": None, "memory_gb": None, "adapters": []} and not kernels.can_run(
        torch.zeros(1)
    )


def test_drivers_that_are_known_to_be_bad_are_refused(monkeypatch):
    monkeypatch.setenv(ALLOW_SOFTWARE, "1")
    adapters_are(monkeypatch, Adapter("Mali-G715", "IntegratedGPU"), Adapter("Microsoft Basic Render Driver", "CPU"))
    with pytest.raises(WebGpuUnavailable, match="Mali-G715 is not used: its driver adds wrongly in workgroup memory."):
        request()
    adapters_are(monkeypatch, Adapter("Mali-G715", "IntegratedGPU"), Adapter("Mali-G52", "IntegratedGPU", "Mesa 25.1"))
    assert request().adapter_name == "Mali-G52"
    small = Adapter("small", "DiscreteGPU")
    small.limits = small.limits | {"max-compute-workgroup-storage-size": 8192}
    adapters_are(monkeypatch, small)
    assert [found["refused"] for found in webgpu_device.adapters()] == [
        "it has 8192 max compute workgroup storage size, and 16384 are needed"
    ]


def test_the_version_of_the_software_driver_is_checked(driver, monkeypatch):
    monkeypatch.setenv(ALLOW_SOFTWARE, "1")
    for adapter in webgpu_device._adapters():
        if adapter.info["adapter_type"] == "CPU":
            assert re.match(r"Mesa \d+\.\d+", adapter.info["description"]) and not webgpu_device._refusal(adapter)
    adapters_are(monkeypatch, Adapter("llvmpipe", "CPU", "Mesa 21.2.6 (LLVM 12.0.0)"))
    with pytest.raises(WebGpuUnavailable, match="llvmpipe is not used: Mesa 21.2 is older than 22.3, the oldest"):
        request()
    adapters_are(monkeypatch, Adapter("llvmpipe", "CPU", "Mesa 25.0.7 (LLVM 19.1.7)"))
    assert request().software


def test_an_adapter_that_vanishes_before_it_gives_a_device_is_said(monkeypatch):
    card = Adapter("card", "DiscreteGPU")
    adapters_are(monkeypatch, card)
    monkeypatch.setattr(Adapter, "request_device_sync", vanished)
    monkeypatch.setattr(hardware, "may_have_card", lambda: True)
    monkeypatch.setitem(KERNELS, "wgpu", WebGpuKernels(CPU))
    with pytest.raises(InputError, match="The wgpu backend cannot run here: card gave no device: adapter is gone"):
        device_for("wgpu")
    assert hardware_for("auto").backend == "cpu"
    settings, note = with_backend_of_run(TrainSettings(backend="wgpu"), resume=True)
    assert settings.backend == "cpu" and "card gave no device" in note


def vanished(*_, **__):
    raise RuntimeError("adapter is gone")


def test_a_device_that_sorts_wrongly_is_refused(gpu, monkeypatch):
    webgpu_tiles.check(gpu)
    run = WebGpu.run

    def without_last_sums(self, kernel, *rest, **buffers):
        if kernel != "sum_totals":
            run(self, kernel, *rest, **buffers)

    monkeypatch.setattr(WebGpu, "run", without_last_sums)
    monkeypatch.setattr(webgpu_tiles, "request", lambda: gpu)
    assert WebGpuKernels(CPU).unavailable_reason().endswith("computes wrongly: it does not sort. Update its driver.")


def test_auto_takes_cards_and_no_software(kernels, gpu, monkeypatch):
    monkeypatch.setattr(hardware, "may_have_card", lambda: True)
    monkeypatch.setattr(gpu, "software", True)  # on a machine with a card it is not
    assert kernels_for("auto", torch.zeros(1)) is CPU and hardware_for("auto").backend == "cpu"
    monkeypatch.setattr(gpu, "software", False)
    assert hardware_for("auto").backend == "wgpu"
    with monkeypatch.context() as patch:
        patch.setattr(hardware, "may_have_card", lambda: False)
        assert hardware_for("auto").backend == "cpu"
    with monkeypatch.context() as patch:
        patch.setattr(KERNELS["cuda"], "unavailable_reason", lambda: None)
        patch.setattr(KERNELS["cuda"], "device", lambda: torch.device("cuda"))
        patch.setattr(torch.cuda, "get_device_properties", lambda _: SimpleNamespace(name="H200", total_memory=9))
        patch.setattr(torch.cuda, "mem_get_info", lambda _: (7, 9))
        found = hardware_for("auto")
        assert asdict(found) == {"backend": "cuda", "card": True, "name": "H200", "memory": 9}
        assert found.free_memory() == 7
    auto = TrainSettings(backend="auto")
    assert with_backend_of_run(auto, False)[0].backend == "wgpu"
    assert with_backend_of_run(replace(auto, recipe="seasplat"), False)[0].backend == "auto"
    kernels.fail(WebGpuFailure("Lost."))
    assert hardware_for("auto").backend == "cpu"


def test_a_run_is_resumed_without_the_card_it_began_on(monkeypatch):
    adapters_are(monkeypatch)
    monkeypatch.setitem(KERNELS, "wgpu", WebGpuKernels(CPU))
    settings, note = with_backend_of_run(TrainSettings(backend="wgpu"), resume=True)
    assert settings.backend == "cpu" and note.startswith("The run was continued on the processor: no graphics adapter")


def test_the_doctor_lists_the_adapters(driver):
    software = webgpu_device._adapters()[0].info["adapter_type"] == "CPU"
    command = [sys.executable, "-m", "swag_engine", "doctor"]
    environment = {name: value for name, value in os.environ.items() if name != ALLOW_SOFTWARE}
    text = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert "backend wgpu: " in text and ", Vulkan, " in text
    assert ("not used: it computes on the processor" in text) == software


def test_constants_are_generated_from_the_reference_in_all_languages():
    header, text = constants.HEADER.read_text(encoding="utf-8"), constants.wgsl()
    assert header == constants.header(), "python -m swag_engine.kernels.constants writes it"
    for name, value in constants.values().items():
        assert f"constexpr double {name} = {float(value)!r};" in header and f"const {name} = {float(value)!r};" in text
    sources = {path: path.read_text(encoding="utf-8") for path in constants.HEADER.parent.iterdir() if path.is_file()}
    for path, source in sources.items():  # no source has a value of its own
        if path.suffix in (".cpp", ".cu", ".cuh", ".h", ".wgsl") and path != constants.HEADER:
            for name in (*constants.values(), "WINDOW", "C1", "C2"):
                own = re.findall(rf"(?m)^.*\bconst(?:expr)?\b.*\b{name}(?:\[.*\])? = (.*?);", source)
                assert all("constants::" in value for value in own), (path, name, own)


@pytest.mark.parametrize("module", [webgpu_tiles, webgpu_training])
def test_sizes_and_bits_that_python_and_wgsl_share_are_equal(module):
    found: dict[str, set[int]] = {}
    for path in constants.HEADER.parent.glob("*.wgsl"):
        for name, value in re.findall(r"(?m)^const (\w+) = (\w+?)u?;", path.read_text(encoding="utf-8")):
            found.setdefault(name, set()).add(int(value, 0))
    shared = [name for name in found if isinstance(getattr(module, name, None), int)]
    assert len(shared) >= 5
    assert all(found[name] == {getattr(module, name)} for name in shared), found
