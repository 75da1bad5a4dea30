"""Check and time the backends cuda and wgpu on a machine with a graphics card.

Run: `python benchmarks/gpu_check.py [--backend cuda|wgpu] [--gaussians N ...]` (under eight minutes)
Results: benchmarks/results/gpu_check.json, benchmarks/results/wgpu_check.json

cuda: runs the tests of the kernels and of the native step on the card and compute-sanitizer where the CUDA toolkit is
installed, and times at 1280x720 each stage, both steps of a scene in water, and an iteration without water beside
gsplat where that is installed and steps of wgpu where that runs.

wgpu: runs tests/engine/test_webgpu.py and test_webgpu_step.py on the card, times whole steps on the same scenes, beside
those of cuda where that runs, and counts dispatches and bytes.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import fields, replace
from importlib import metadata
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import write_results
from benchmarks.step import both_steps
from benchmarks.wgpu_scene import WgpuScene
from swag_engine.effects.exposure import Exposure
from swag_engine.effects.lamp import Lamp
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.effects.vignetting import Vignetting
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.kernels.backends import KERNELS
from swag_engine.kernels.cuda import GROUP, CudaKernels
from swag_engine.kernels.protocol import Projection
from swag_engine.kernels.webgpu import WebGpuKernels
from swag_engine.rasterize.api import contributions, rasterize
from swag_engine.rendering.native_image import NativeImage
from swag_engine.scene.cameras import Camera
from swag_engine.settings.recipes import Recipe
from swag_engine.training.native_step import compare
from swag_engine.training.targets import Target
from swag_engine.water.medium import Medium

GAUSSIANS = (100_000, 1_000_000, 3_000_000)
SIZE = 1280, 720
ROUNDS = 16
SMALL_SCENE = "--small-scene"
"""Argument with which this script runs under compute-sanitizer."""

DEVICE = torch.device("cuda")

Step = Callable[[], object]
Tensors = dict[str, torch.Tensor]


def version(package: str) -> str | None:
    """Return the version of an installed package, None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def run_tests(*files: str) -> dict[str, object]:
    """Run tests on the card."""
    command = [sys.executable, "-m", "pytest", *(f"tests/engine/{file}" for file in files), "-v"]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"SWAG_TEST_CUDA": "1"}, stdout=subprocess.PIPE, text=True
    )
    print(done.stdout)
    return {"passed": done.returncode == 0, "summary": done.stdout.strip().splitlines()[-1]}


def sanitize() -> dict[str, str]:
    """Run compute-sanitizer's tools on a small scene; return their verdicts."""
    program = shutil.which("compute-sanitizer")
    if not program:
        print("compute-sanitizer is not installed: it is left out.")
        return {}
    environment = os.environ | {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}  # so that each tensor has bounds of its own
    verdicts = {}
    for tool in ("memcheck", "racecheck"):
        command = [program, "--tool", tool, sys.executable, __file__, SMALL_SCENE]
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True)
        print(done.stdout)
        verdicts[tool] = done.stdout.strip().splitlines()[-1]
    return verdicts


def make_parameters(n: int, width: int, height: int) -> Tensors:
    """What training optimises, in front of a camera at the origin: a bumpy surface (80 %) and floaters before it.

    The more Gaussians, the smaller they are, as in trained scenes.
    """
    torch.manual_seed(0)
    u, v = (torch.rand(n) * (size + 16) - 8 for size in (width, height))
    surface = 4 + 0.7 * torch.sin(u / width * 10.7) + 0.7 * torch.cos(v / height * 8) + 0.35 * torch.rand(n)
    z = torch.where(torch.arange(n) % 5 == 0, 0.8 + 5.2 * torch.rand(n), surface)
    pixel = z / (0.8 * width)
    sigma = 1.9 * (50_000 / n * width * height / (640 * 360)) ** 0.5  # px
    log_scales = (sigma * pixel).log()[:, None] + 0.55 * torch.randn(n, 3) + torch.tensor([0.0, 0.0, -1.2])
    values = {
        "means": torch.stack([(u - width / 2) * pixel, (v - height / 2) * pixel, z], 1),
        "quats": torch.randn(n, 4),
        "log_scales": log_scales,
        "opacity_logits": 2 * torch.randn(n),
        "sh0": 0.6 * torch.randn(n, 1, 3),
        "shN": 0.05 * torch.randn(n, 15, 3),
    }
    return {name: value.to(DEVICE).requires_grad_() for name, value in values.items()}


def make_camera(width: int, height: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Viewmat and K."""
    focal = 0.8 * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return torch.eye(4).to(DEVICE), K.to(DEVICE)


def make_view(width: int, height: int) -> Camera:
    """The same camera."""
    return Camera("view", width, height, 0.8 * width, 0.8 * width, width / 2, height / 2, np.eye(4))


def make_cloud(n: int, width: int, height: int) -> GaussianCloud:
    """The parameters of `make_parameters` as a cloud."""
    values = {name: value.detach() for name, value in make_parameters(n, width, height).items()}
    return GaussianCloud(**values, background=torch.zeros(3, device=DEVICE))


def activated(p: Tensors) -> tuple[torch.Tensor, ...]:
    """Return means, quaternions, scales and opacities."""
    return p["means"], p["quats"], p["log_scales"].exp(), p["opacity_logits"].sigmoid()


def cuda_kernels() -> CudaKernels:
    """Return the CUDA backend."""
    kernels = KERNELS["cuda"]
    assert isinstance(kernels, CudaKernels)
    return kernels


def loss(picture: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return .8 L1 + .2 (1 - SSIM)."""
    l1, ssim = cuda_kernels().l1_ssim(picture, target)
    return 0.8 * l1 + 0.2 * (1 - ssim)


def iteration(n: int, width: int, height: int) -> Step:
    """Return one training iteration: project, blend, L1 + SSIM, backward, Adam."""
    cuda, p = cuda_kernels(), make_parameters(n, width, height)
    camera, background = make_camera(width, height), torch.rand(3, device=DEVICE)
    target = torch.rand(height, width, 3, device=DEVICE)
    moments = {name: (torch.zeros_like(tensor), torch.zeros_like(tensor)) for name, tensor in p.items()}

    def step() -> None:
        directions = torch.nn.functional.normalize(p["means"].detach(), dim=1)
        colors = cuda.sh_colors(p["sh0"], p["shN"], directions, 3)
        drawn = rasterize(*activated(p), colors, *camera, width, height, background, backend="cuda")
        loss(drawn.channels, target).backward()
        for name, tensor in p.items():
            assert tensor.grad is not None
            cuda.adam_step(tensor.detach(), tensor.grad, *moments[name], 1e-4, 0.9, 0.999, 1e-15, 1)
            tensor.grad = None

    return step


def gsplat_iteration(n: int, width: int, height: int) -> Step:
    """Return the same by gsplat, with our loss and torch's fused Adam."""
    from gsplat import rasterization

    p = make_parameters(n, width, height)
    viewmat, K = make_camera(width, height)
    background, target = torch.rand(1, 3, device=DEVICE), torch.rand(height, width, 3, device=DEVICE)
    adam = torch.optim.Adam(p.values(), lr=1e-4, eps=1e-15, fused=True)

    def step() -> None:
        sh = torch.cat([p["sh0"], p["shN"]], 1)
        picture, _, _ = rasterization(
            *activated(p), sh, viewmat[None], K[None], width, height, sh_degree=3, packed=False, backgrounds=background
        )
        loss(picture[0], target).backward()
        adam.step()
        adam.zero_grad(set_to_none=True)

    return step


def stages(n: int, width: int, height: int) -> dict[str, Step]:
    """Return each part of an iteration separately."""
    cuda, p = cuda_kernels(), make_parameters(n, width, height)
    camera, background = make_camera(width, height), torch.rand(3, device=DEVICE)
    sh, directions = [p["sh0"], p["shN"]], torch.nn.functional.normalize(p["means"].detach(), dim=1)
    *geometry, opacities = (tensor.detach().requires_grad_() for tensor in activated(p))
    colors = cuda.sh_colors(*sh, directions, 3)
    seen = cuda.project(*geometry, opacities, colors.detach(), *camera, width, height)
    means2d, conics, depths, radii = seen.means2d, seen.conics, seen.depths, seen.radii
    leaves = [tensor.detach().requires_grad_() for tensor in (means2d, conics, opacities, colors)]
    flat = Projection(means2d.detach(), conics.detach(), depths, radii), opacities.detach(), width, height
    pairs = cuda.tile_pairs(*flat)
    blended = Projection(leaves[0], leaves[1], depths, radii), *leaves[2:], background, width, height
    picture, _ = cuda.blend(*blended)
    image = picture.detach().requires_grad_()
    target, by_picture = torch.rand(2, height, width, 3, device=DEVICE)
    moments = [(torch.zeros_like(tensor), torch.zeros_like(tensor)) for tensor in p.values()]

    def adam() -> None:
        for tensor, pair in zip(p.values(), moments, strict=True):
            cuda.adam_step(tensor.detach(), tensor.detach(), *pair, 1e-9, 0.9, 0.999, 1e-15, 1)

    def gradient(outputs: list[torch.Tensor], inputs: list[torch.Tensor]) -> Step:
        incoming = [torch.ones_like(tensor) for tensor in outputs]
        return lambda: torch.autograd.grad(outputs, inputs, incoming, retain_graph=True)

    return {
        "project": lambda: cuda.project(*geometry, opacities, colors.detach(), *camera, width, height),
        "project, backward": gradient([means2d, conics], geometry),
        "colors": lambda: cuda.sh_colors(*sh, directions, 3),
        "colors, backward": gradient([colors], sh),
        "pairs, sorted": lambda: cuda.tile_pairs(*flat),
        "blend": lambda: cuda.blend_pairs(pairs, leaves[3].detach(), background, width, height),
        "blend, backward": gradient([picture], leaves),
        "L1 + SSIM, both ways": lambda: torch.autograd.grad(loss(image, target), image),
        "Adam": adam,
        "contributions": lambda: cuda.contributions(*blended, target, by_picture),
    }


def training_steps(n: int) -> dict[str, object]:
    """Measure milliseconds of the trainer's two steps on n Gaussians in water."""
    rows: dict[str, object] = {}
    cloud, camera = make_cloud(n, *SIZE), make_view(*SIZE)
    with tempfile.TemporaryDirectory() as folder:
        for name, step in both_steps("swag with water", cloud, camera, Path(folder) / "run", "cuda").items():
            rows[f"{name} step in water"] = milliseconds(step)
    return rows


def milliseconds(step: Step) -> float:
    """Return the median over rounds, after two of warming up."""
    times = []
    for _ in range(ROUNDS + 2):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        step()
        end.record()
        torch.cuda.synchronize()
        times.append(begin.elapsed_time(end))
    return round(statistics.median(times[2:]), 3)


def timings(n: int) -> dict[str, object]:
    """Measure milliseconds and peak memory with n Gaussians."""
    rows: dict[str, object] = {}
    try:
        rows |= {name: milliseconds(step) for name, step in stages(n, *SIZE).items()}
        made = {"iteration": iteration} | ({"iteration by gsplat": gsplat_iteration} if version("gsplat") else {})
        for name, make in made.items():
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
            rows[name] = milliseconds(make(n, *SIZE))
            rows[f"{name}, bytes a Gaussian"] = round(torch.cuda.max_memory_allocated() / n)
        rows |= training_steps(n)
    except torch.cuda.OutOfMemoryError as error:
        print(f"Timings at {n} Gaussians end early: {error}")
    return rows


def small_scene() -> None:
    """Run every kernel once."""
    n, width, height = 500, 100, 70
    iteration(n, width, height)()
    camera = make_camera(width, height)
    for channels in range(1, GROUP + 1):
        values = torch.rand(n, channels, device=DEVICE).requires_grad_()
        background = torch.rand(channels, device=DEVICE)
        inputs = *activated(make_parameters(n, width, height)), values, *camera, width, height, background
        pictures = (torch.rand(height, width, images, device=DEVICE) for images in (7, channels))
        rasterize(*inputs, backend="cuda").channels.sum().backward()
        contributions(*inputs, *pictures, backend="cuda")
    gains = Exposure.starting({"view": 0.1, "other": -0.1}), Vignetting(torch.zeros(3))
    models = Medium.starting(4.0), Lamp.starting(4.0, 8.0), *gains
    effects = SceneEffects(dict(zip(("medium", "lamp", "exposure", "vignetting"), models, strict=True))).to(DEVICE)
    for parameter in effects.parameters().values():
        parameter.requires_grad_()
    cloud = make_cloud(n, width, height)
    seen = cloud, make_view(width, height), 3, effects.medium, 2, effects.lamp, None
    pixels = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8, device=DEVICE)
    target = Target(seen[1], pixels, torch.rand(height, width, device=DEVICE) > 0.1)
    image = NativeImage(cuda_kernels(), *seen)
    _, gradients = compare(cuda_kernels(), image, effects, target, (0.8, 0.2, 0.1), Recipe(coverage=0.01))
    image.backward(*gradients, with_geometry=True)


def wgpu_timings(kernels: WebGpuKernels, n: int) -> dict[str, object]:
    """Measure milliseconds of a step with n Gaussians by wgpu, and count its dispatches."""
    gpu = kernels.gpu
    parameters = {name: value.detach().cpu() for name, value in make_parameters(n, *SIZE).items()}
    viewmat, K = (tensor.cpu() for tensor in make_camera(*SIZE))
    try:
        scene = WgpuScene.of(gpu, parameters, viewmat, K, SIZE)
        scene.step()
        scene.resident.outcomes(wait=True)
        before, begin = replace(gpu.counters), time.perf_counter()
        for _ in range(ROUNDS):
            scene.step()
            scene.resident.outcomes(wait=False)
        scene.resident.outcomes(wait=True)
        seconds = time.perf_counter() - begin
    except MemoryError as error:
        return {"does not fit": str(error)}
    asked = {field.name: getattr(gpu.counters, field.name) - getattr(before, field.name) for field in fields(before)}
    rows: dict[str, object] = {"step": round(1000 * seconds / ROUNDS, 3)}
    return rows | {f"{name} a step": count / ROUNDS for name, count in asked.items()}


def check_wgpu(gaussians: list[int]) -> None:
    """Run all checks and timings of wgpu, print and write the results."""
    global DEVICE
    kernels = KERNELS["wgpu"]
    assert isinstance(kernels, WebGpuKernels)
    if reason := kernels.unavailable_reason():
        sys.exit(f"There is no GPU to check here: {reason}")
    if cuda_kernels().unavailable_reason():
        DEVICE = torch.device("cpu")
    results: dict[str, object] = kernels.details() | {"wgpu": version("wgpu"), "torch": torch.__version__}
    results["tests"] = run_tests("test_webgpu.py", "test_webgpu_step.py")
    for n in gaussians:
        rows = wgpu_timings(kernels, n)
        if not cuda_kernels().unavailable_reason():
            rows["iteration by cuda"] = milliseconds(iteration(n, *SIZE))
        results[f"ms, {n} Gaussians at {SIZE[0]}x{SIZE[1]}"] = rows
    write_results("wgpu_check", results)
    print(json.dumps(results, indent=2))


def main() -> None:
    """Run all checks and timings, print and write the results."""
    if SMALL_SCENE in sys.argv:
        small_scene()
        torch.cuda.synchronize()
        return
    parser = argparse.ArgumentParser(description="Check and time a backend on a machine with a graphics card.")
    parser.add_argument("--backend", choices=("cuda", "wgpu"), default="cuda")
    parser.add_argument("--gaussians", type=int, nargs="+", default=list(GAUSSIANS))
    arguments = parser.parse_args()
    if arguments.backend == "wgpu":
        check_wgpu(arguments.gaussians)
    else:
        check_cuda(arguments.gaussians)


def check_cuda(gaussians: list[int]) -> None:
    """Run all checks and timings of cuda, print and write the results."""
    start = time.perf_counter()
    if reason := cuda_kernels().unavailable_reason():
        sys.exit(f"There is no GPU to check here: {reason}")
    properties = torch.cuda.get_device_properties(torch.cuda.current_device())
    results: dict[str, object] = {
        "device": properties.name,
        "architecture": f"sm_{properties.major}{properties.minor}",
        "memory_gb": round(properties.total_memory / 1e9, 1),
        "torch": torch.__version__,
        "gsplat": version("gsplat"),
        "seconds to load the kernels": round(time.perf_counter() - start, 2),
        "tests": run_tests("test_cuda.py", "test_native_step.py"),
        "compute-sanitizer": sanitize(),
    }
    wgpu = KERNELS["wgpu"]
    assert isinstance(wgpu, WebGpuKernels)
    beside = not wgpu.unavailable_reason()
    for n in gaussians:
        rows = timings(n)
        if beside:
            rows |= {f"{name}, by wgpu": value for name, value in wgpu_timings(wgpu, n).items()}
        results[f"ms, {n} Gaussians at {SIZE[0]}x{SIZE[1]}"] = rows
    write_results("gpu_check", results)
    print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
