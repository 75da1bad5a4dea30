"""Runs and sizes of the backend wgpu that take long on a driver that runs its kernels on the processor."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks import gpu_check
from benchmarks.wgpu_scene import WgpuScene
from swag_engine.kernels.backends import CPU, KERNELS
from swag_engine.kernels.webgpu import WebGpuKernels
from swag_engine.kernels.webgpu_device import ALLOW_SOFTWARE
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.trainer import train
from tests.engine.webgpu_devices import software_device

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "tests" / "scenes" / "reef_wreck"
SETTINGS = TrainSettings(recipe="swag", iterations=24, width=32, max_gaussians=150, backend="wgpu")

KILLED = """
import os, sys
from dataclasses import replace
from pathlib import Path
from swag_engine.training.schedule import STANDARD
from tests.engine.test_webgpu_runs import SETTINGS
from tests.scenes.runs import train_with

asked = iter(range(10**9))

def kill_itself():
    if next(asked) == 13:
        os.kill(os.getpid(), 9)

scene, run = map(Path, sys.argv[1:])
train_with(scene, run, SETTINGS, schedule=replace(STANDARD, checkpoint_seconds=0.0), should_stop=kill_itself)
"""


@pytest.fixture(scope="module")
def gpu(missing):
    return software_device(missing)


@pytest.fixture
def kernels(gpu, monkeypatch):
    """The backend, registered as such."""
    monkeypatch.setitem(KERNELS, "wgpu", WebGpuKernels(CPU, lambda: gpu))
    return KERNELS["wgpu"]


def test_a_run_whose_process_was_killed_resumes(kernels, tiny_scene, tmp_path):
    """A process of its own, and two runs."""
    command = [sys.executable, "-c", KILLED, str(tiny_scene), str(tmp_path / "run")]
    environment = os.environ | {ALLOW_SOFTWARE: "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True)
    assert done.returncode == -9, done.stderr
    stored = load_checkpoint(tmp_path / "run")[1]
    assert 0 < stored["iteration"] <= 13  # asked in trials too
    metrics = train(tiny_scene, tmp_path / "run", SETTINGS, resume=True)["metrics"]
    expected = train(tiny_scene, tmp_path / "cpu", replace(SETTINGS, backend="cpu"))["metrics"]
    assert metrics["iteration"] == 24 and not kernels.failure
    assert metrics["gaussians"] == pytest.approx(expected["gaussians"], rel=0.02)
    assert metrics["test_psnr"] == pytest.approx(expected["test_psnr"], abs=0.1)


def test_the_demo_is_as_good_as_on_the_processor(gpu, kernels, tmp_path):
    """At 160 pixels; half a minute, most of it on the driver that runs on the processor."""
    settings = TrainSettings(recipe="swag", iterations=60, width=160, max_gaussians=1500, backend="cpu")
    before, metrics = gpu.counters.dispatches, {}
    for backend in ("cpu", "wgpu"):
        metrics[backend] = train(DEMO, tmp_path / backend, replace(settings, backend=backend))["metrics"]
    assert not kernels.failure and gpu.counters.dispatches - before > 60 * 60
    assert "backscatter" in metrics["wgpu"]["effects"]  # it has water
    assert metrics["wgpu"]["test_psnr"] > metrics["wgpu"]["control_psnr"] + 1
    assert abs(metrics["wgpu"]["test_psnr"] - metrics["cpu"]["test_psnr"]) < 0.1  # measured: .0002 dB


@pytest.mark.parametrize(
    "count, binding", [(30_000, 2**27 // 100), pytest.param(3_000_000, 2**27, marks=pytest.mark.search)]
)
def test_3_million_gaussians_of_degree_3_are_in_parts_of_128_mib(gpu, monkeypatch, count, binding):
    """A hundredth of the Gaussians and of a binding, or all: that takes minutes and 7 GB.

    All but a few Gaussians are behind the camera, so that the gradients of those say whether each has its own.
    """
    monkeypatch.setattr(gpu_check, "DEVICE", torch.device("cpu"))
    monkeypatch.setattr(gpu, "largest_binding", binding)
    size = 16, 16
    parameters = {name: values.detach() for name, values in gpu_check.make_parameters(count, *size).items()}
    parameters["means"][:, 2] = -1
    of_part = binding // 180 // 64 * 64  # Gaussians whose higher SH a binding holds
    few = torch.tensor([0, of_part - 1, of_part, 2 * of_part, count // 2, count - 1])
    parameters["means"][few] = torch.tensor([0.0, 0.0, 4.0])
    parameters["log_scales"][few] = -1.0
    parameters["opacity_logits"][few] = -1.0
    scene = WgpuScene.of(gpu, parameters, *gpu_check.make_camera(*size), size)
    alone = WgpuScene.of(
        gpu, {name: values[few] for name, values in parameters.items()}, *gpu_check.make_camera(*size), size
    )
    assert [chunk.first for chunk in scene.resident.chunks] == [of_part * number for number in range(5)]
    for each in (scene, alone):
        each.step()
    (outcome,), (expected,) = (each.resident.outcomes(wait=True) for each in (scene, alone))
    assert not outcome.problem and outcome.loss == pytest.approx(expected.loss, rel=1e-6)
    for name, values in parameters.items():
        got = scene.resident.fetch(f"by.{name}", tuple(values.shape)).reshape(count, -1)
        wanted = alone.resident.fetch(f"by.{name}", (len(few), *values.shape[1:])).reshape(len(few), -1)
        torch.testing.assert_close(got[few], wanted, rtol=1e-4, atol=1e-6 * float(wanted.abs().max()))
        assert set(got.any(1).nonzero()[:, 0].tolist()) <= set(few.tolist()), name
