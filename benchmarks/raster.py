"""Measure milliseconds of rasterising and of a whole training iteration on the CPU, and ratios within one process.

Run: `python benchmarks/raster.py` (Linux), with nothing else on the machine
Results: benchmarks/results/raster.json

Compared are the CPU kernels, the torch backend, and, where gsplat is installed, the torch reference inside gsplat. The
reference has no CPU code for the lists of pixel-Gaussian pairs and for the scan along rays: it gets the lists for free,
and a scan in torch. gsplat's own kernels need a GPU and are not part of this comparison.

The kernels are also compared with the prototypes in ../shared/prototypes, where that folder and g++ are. Processor time
is taken there, since it does not count waiting for other processes.
"""

import json
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import types
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import swag_engine.base.threads  # noqa: F401, I001  before torch, which reads what it sets

import numpy as np
import torch

from benchmarks.common import processor, write_results
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.kernels.backends import KERNELS
from swag_engine.kernels.build import host_targets
from swag_engine.kernels.cpu import blend, blend_backward
from swag_engine.kernels.cpu_library import CpuLibrary, supported_level
from swag_engine.kernels.protocol import Projection
from swag_engine.kernels.reference.blending import Samples, tiles_of
from swag_engine.kernels.reference.kernels import REFERENCE
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.training.losses import photometric
from swag_engine.training.optimizer import Optimizer
from swag_engine.training.schedule import LearningRates

MAIN = (50_000, 640, 360)
ROUNDS = 7
PROTOTYPES = ROOT.parent / "shared" / "prototypes"
"""C++ files of which each rasterises the scene of scene.py through driver.py; not part of the repository."""
TILE_HEIGHTS = {"raster2": 32, "raster3": 64}
"""Prototypes, and the height of tiles for which each was tuned, in pixels."""
PROTOTYPE_FLAGS = "-O3 -std=c++17 -march=x86-64-v3 -DVW=8 -DTS=32 -ffp-contract=fast -fno-math-errno -fno-trapping-math"
PROTOTYPE_ROUNDS = 25
PROTOTYPE_RESULTS = "processor ms on 1 thread, kernels and prototypes, 50 000 at 640x360"


def make_cloud(n: int, width: int, height: int) -> tuple[GaussianCloud, Camera]:
    """Make a cloud like a trained scene: a bumpy surface (80 %), floaters in front; median sigma 1.9 px at 640 px."""
    r = np.random.default_rng(0)
    focal = 0.8 * width
    u, v = r.uniform(-8, width + 8, n), r.uniform(-8, height + 8, n)
    z = 4 + 0.7 * np.sin(u / width * 10.7) + 0.7 * np.cos(v / height * 8) + r.exponential(0.35, n)
    z = np.where(np.arange(n) % 5 == 0, r.uniform(0.8, 6, n), z)
    long = np.exp(r.normal(np.log(1.9), 0.55, n)).clip(0.3, 40)
    sigmas = np.stack([long, (long * np.exp(r.normal(0, 0.5, n))).clip(0.3, 40), 0.3 * long], 1) * (z / focal)[:, None]
    turn = r.uniform(0, np.pi, n)
    means = np.stack([(u - width / 2) * z / focal, (v - height / 2) * z / focal, z], 1)
    opacities = r.beta(0.9, 1.4, n).clip(0.006, 0.995)

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array.astype(np.float32))

    cloud = GaussianCloud(
        means=tensor(means),
        quats=tensor(np.stack([np.cos(turn / 2), 0 * turn, 0 * turn, np.sin(turn / 2)], 1)),
        log_scales=tensor(np.log(sigmas)),
        opacity_logits=tensor(np.log(opacities / (1 - opacities))),
        sh0=tensor(r.normal(0, 0.6, (n, 1, 3))),
        shN=tensor(r.normal(0, 0.05, (n, 15, 3))),
        background=torch.tensor([-1.0, 0.0, 0.5]),
    )
    camera = Camera("benchmark", width, height, focal, focal, width / 2, height / 2, np.eye(4))
    return cloud, camera


def iteration(n: int, width: int, height: int, backend: str) -> Callable[[], None]:
    """Return one training iteration: project, blend, L1 + SSIM, backward, Adam."""
    cloud, camera = make_cloud(n, width, height)
    optimizer, rates = Optimizer(cloud, SceneEffects(), backend), asdict(LearningRates())
    target = torch.rand(height, width, 3)

    def step() -> None:
        picture = render(cloud, camera, 3, backend=backend)
        photometric(picture.color, target, None, backend=backend).backward()
        optimizer.step(rates)

    return step


def raster(n: int, width: int, height: int, backend: str) -> Callable[[], None]:
    """Return binning, sorting and blending of projected Gaussians, forward and backward."""
    cloud, camera = make_cloud(n, width, height)
    viewmat, K = torch.eye(4), torch.from_numpy(camera.K).float()
    channels = cloud.colors(torch.zeros(3), 3).detach()
    inputs = cloud.means, cloud.quats, cloud.scales, cloud.opacities, channels
    projected = REFERENCE.project(*inputs, viewmat, K, width, height)
    leaves = [t.detach().clone() for t in (projected.means2d, projected.conics, cloud.opacities, channels)]
    leaves = [leaf.requires_grad_() for leaf in leaves]
    background, gradient = torch.tensor([0.1, 0.2, 0.3]), torch.randn(height, width, 3)

    def step() -> None:
        means2d, conics, opacities, values = leaves
        seen = Projection(means2d, conics, projected.depths, projected.radii)
        picture, _ = KERNELS[backend].blend(seen, opacities, values, background, width, height)
        torch.autograd.grad((picture * gradient).sum(), leaves)

    def gsplat_step() -> None:
        colors, _ = accumulate(*[leaf[None] for leaf in leaves], *pairs, width, height)
        torch.autograd.grad((colors[0] * gradient).sum(), leaves)

    if backend != "gsplat":
        return step
    sys.modules["nerfacc"] = types.SimpleNamespace(  # type: ignore[assignment]
        render_weight_from_alpha=weights_along_rays, accumulate_along_rays=sums_along_rays
    )
    from gsplat.cuda._torch_impl import accumulate

    pairs = accepted_pairs(leaves, projected, width, height)
    return gsplat_step


def accepted_pairs(
    leaves: list[torch.Tensor], projected: Projection, width: int, height: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """List Gaussian, pixel and image of all blended pairs, by pixel and depth."""
    means2d, conics, opacities, _ = (leaf.detach() for leaf in leaves)
    gaussians, pixels = [], []
    for _, meets, at in tiles_of(projected, width, height):
        samples = Samples(means2d[meets], conics[meets], opacities[meets], at)
        pixel, which = (samples.alpha > 0).T.nonzero(as_tuple=True)
        gaussians.append(meets[which])
        pixels.append(at[pixel, 1].long() * width + at[pixel, 0].long())
    pixel, order = torch.sort(torch.cat(pixels), stable=True)
    return torch.cat(gaussians)[order], pixel, torch.zeros_like(pixel)


def weights_along_rays(alphas: torch.Tensor, ray_indices: torch.Tensor, n_rays: int) -> tuple[torch.Tensor, ...]:
    """Return T alpha and T of samples sorted by ray and depth; replaces nerfacc's function, which needs CUDA."""
    logs = torch.log1p(-alphas).double()
    before = logs.cumsum(0) - logs
    first = torch.searchsorted(ray_indices, torch.arange(n_rays)).clamp(max=len(logs) - 1)
    transmittance = (before - before[first][ray_indices]).exp().float()
    return transmittance * alphas, transmittance


def sums_along_rays(
    weights: torch.Tensor, values: torch.Tensor | None, ray_indices: torch.Tensor, n_rays: int
) -> torch.Tensor:
    """Sum weights, or weighted values, by ray."""
    terms = weights[:, None] if values is None else weights[:, None] * values
    return torch.zeros(n_rays, terms.shape[1]).index_add(0, ray_indices, terms)


def prototype_milliseconds() -> dict[str, float]:
    """Return the median processor time of the kernels' builds and of the prototypes, on one thread.

    Each round runs each once: binning, blending forward and backward, and summing gradients of 50 000 Gaussians.
    """
    sys.path.insert(0, str(PROTOTYPES))
    import driver
    import scene

    splats = scene.make()
    gradient = scene.gout(splats)
    torch.set_num_threads(1)  # waiting threads of torch would count as processor time
    steps = {}
    for target in host_targets():
        if target.level <= supported_level():
            steps[f"kernels, x86-64-v{target.level}"] = prototype_scene(CpuLibrary(target.path), splats, gradient)
    with tempfile.TemporaryDirectory() as folder:
        for name in TILE_HEIGHTS:
            library = compile_prototype(name, Path(folder))
            steps[name] = prototype_step(driver.Cpp(str(library), 1), splats, gradient)
        return milliseconds(steps, PROTOTYPE_ROUNDS, time.process_time)


def compile_prototype(name: str, folder: Path) -> Path:
    """Compile a prototype with the flags for which it was measured."""
    library = folder / f"{name}.so"
    flags = [*PROTOTYPE_FLAGS.split(), f"-DTH={TILE_HEIGHTS[name]}", "-shared", "-fPIC", "-fvisibility=hidden"]
    subprocess.run(["g++", *flags, str(PROTOTYPES / f"{name}.cpp"), "-o", str(library)], check=True)
    return library


def prototype_step(rasteriser: Any, splats: dict[str, Any], gradient: np.ndarray) -> Callable[[], None]:
    """Return a prototype's binning and blending, forward and backward."""

    def step() -> None:
        rasteriser.forward(splats)
        rasteriser.backward(gradient)

    return step


def prototype_scene(library: CpuLibrary, splats: dict[str, Any], gradient: np.ndarray) -> Callable[[], None]:
    """Return the same work of a build of the kernels; the prototypes know no gradient by alpha."""
    means2d, conics, opacities, channels = (torch.from_numpy(splats[name]) for name in ("xy", "conic", "op", "col"))
    depths, background, by_image = (torch.from_numpy(array) for array in (splats["z"], splats["bg"], gradient))
    projected = Projection(means2d, conics, depths, torch.ones_like(depths))

    def step() -> None:
        image = blend(library, projected, opacities, channels, background, splats["W"], splats["H"])
        blend_backward(library, image.saved(channels, background), by_image, None)

    return step


def milliseconds(
    steps: dict[str, Callable[[], None]], rounds: int = ROUNDS, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Return medians over rounds in which each step runs once, in any order, after one round of warming up."""
    times: dict[str, list[float]] = {name: [] for name in steps}
    order = random.Random(0)
    for number in range(rounds + 1):
        for name, step in order.sample(list(steps.items()), len(steps)):
            start = clock()
            step()
            if number:
                times[name].append(1000 * (clock() - start))
    return {name: round(statistics.median(values), 1) for name, values in times.items()}


def with_threads(count: int, step: Callable[[], None]) -> Callable[[], None]:
    """Run a step with this number of threads."""

    def run() -> None:
        torch.set_num_threads(count)
        step()

    return run


def peak_bytes(n: int, width: int, height: int) -> int:
    """Return the peak bytes that training N Gaussians adds to a separate process."""
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import raster; "
        f"print(raster.peak_of_three_iterations({n}, {width}, {height}))"
    )
    return int(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout)


def peak_of_three_iterations(n: int, width: int, height: int) -> int:
    """Return the bytes by which three iterations raise this process' peak."""
    iteration(1000, 64, 48, "cpu")()
    before = peak_resident()
    step = iteration(n, width, height, "cpu")
    for _ in range(3):
        step()
    return peak_resident() - before


def peak_resident() -> int:
    """Return the peak resident bytes (Linux); getrusage would count the parent process."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM")))


def main() -> None:
    """Time everything, print and write the results."""
    threads = torch.get_num_threads()
    counts = [1 << k for k in range(threads.bit_length()) if 1 << k <= threads]
    rivals = {"kernels": raster(*MAIN, "cpu"), "torch": raster(*MAIN, "torch")}
    try:
        rivals["gsplat, torch implementation"] = raster(*MAIN, "gsplat")
    except ImportError:
        print("gsplat is not installed: it is left out.")
    results: dict[str, object] = {"machine": f"{processor()}, {threads} threads", "torch": torch.__version__}
    results["rasterise 50 000 at 640x360, ms"] = ours = milliseconds(rivals, 3)
    results["ratio"] = {name: round(value / ours["kernels"], 1) for name, value in ours.items()}
    results["iteration 50 000 at 640x360, ms"] = milliseconds(
        {"kernels": iteration(*MAIN, "cpu"), "torch": iteration(*MAIN, "torch")}, 3
    )
    if PROTOTYPES.is_dir() and shutil.which("g++"):
        results[PROTOTYPE_RESULTS] = prototype_milliseconds()
        torch.set_num_threads(threads)
    else:
        print(f"{PROTOTYPES} or g++ is missing: the comparison with the prototypes is left out.")
    large = 500_000, 1280, 720
    results["500 000 at 1280x720, ms"] = milliseconds(
        {"rasterise": raster(*large, "cpu"), "iteration": iteration(*large, "cpu")}, 3
    )
    few, many = (peak_bytes(n, *large[1:]) for n in (250_000, 1_000_000))
    results["peak bytes of a further Gaussian at 1280x720"] = round((many - few) / 750_000)
    results["peak MB at 250 000 and 1 000 000 Gaussians"] = [round(few / 1e6), round(many / 1e6)]
    gaussians = [12_500, 25_000, 50_000, 100_000, 200_000, 400_000]
    widths = [320, 640, 960, 1280, 1920]
    results["ms by Gaussians at 640x360"] = {
        str(n): milliseconds({"rasterise": raster(n, 640, 360, "cpu"), "iteration": iteration(n, 640, 360, "cpu")}, 5)
        for n in gaussians
    }
    results["ms by width, 100 000 Gaussians"] = {
        str(w): milliseconds(
            {
                "rasterise": raster(100_000, w, w * 9 // 16, "cpu"),
                "iteration": iteration(100_000, w, w * 9 // 16, "cpu"),
            },
            5,
        )
        for w in widths
    }
    step, whole = raster(*MAIN, "cpu"), iteration(*MAIN, "cpu")
    results["ms by threads, 50 000 at 640x360"] = {
        str(count): milliseconds({"rasterise": with_threads(count, step), "iteration": with_threads(count, whole)}, 5)
        for count in counts
    }
    write_results("raster", results)
    print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
