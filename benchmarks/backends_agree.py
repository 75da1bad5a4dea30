"""Measure the largest differences between the backends over thousands of random scenes.

Run: `python benchmarks/backends_agree.py [--scenes 3000] [--seed 0]`; exit code 1 where backends disagree
Results: benchmarks/results/backends_agree.json

Each scene has 1 to 60 Gaussians and 1 to 40 pixels a side. It is rendered by torch in float64 (the truth), by torch in
float32, by the CPU kernels and by the CUDA kernels (on simulated threads, or with SWAG_TEST_CUDA=1 on the card).
"blended" compares any channels, the gradients of every optimised tensor, and the sums of contributions; "trained" a
cloud in water with its range, its restored colors, and SSIM, as training does. An error is the largest difference
divided by the largest value of that tensor of the truth. A scene may exceed the tolerance only where rounding decides
a comparison (alpha at 1/255 or .99, transmittance at 1e-4, the order of depths); the truth tells how close it was.
"""

import argparse
import json
import random
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch
from torch import Tensor

from benchmarks.common import write_results
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.kernels.backends import KERNELS
from swag_engine.kernels.cuda import CudaKernels
from swag_engine.rasterize.api import contributions, rasterize
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.training.losses import photometric
from swag_engine.water.medium import Medium
from tests.engine.cuda_fibres import DEVICE, ON_CARD, Fibres
from tests.engine.raster_scenes import GRADIENTS, blend_by_definition, make_scene, relative_error

TOLERANCE = 1e-4
"""Largest relative error of everything but gradients through SSIM."""
TRAINED_GRADIENTS = 5e-3
"""Largest relative error of gradients through SSIM, whose variances cancel in float32, in plain torch too."""
NEAR_A_COMPARISON = 1e-5
"""Distance of a value from a threshold below which rounding may decide the comparison."""
BACKENDS = {"torch": torch.device("cpu"), "cpu": torch.device("cpu"), "cuda": torch.device(DEVICE)}

Scene = dict[str, Tensor | int]
Results = dict[str, Tensor]


def random_scene(number: int) -> Scene:
    """Make the random scene of this number."""
    draw = random.Random(number)
    sides = {"width": draw.randint(1, 40), "height": draw.randint(1, 40)}
    size = 10 ** draw.uniform(-2, 0.3)
    return make_scene(draw.randint(1, 60), draw.randint(1, 8), seed=number, size=size, **sides)


def weighted(values: list[Tensor], seed: int) -> Tensor:
    """Return a random linear functional of the tensors."""
    generator = torch.Generator().manual_seed(seed)
    weights = (1 + torch.randn(v.shape, generator=generator, dtype=torch.float64) for v in values)
    return sum((v * w.to(v)).sum() for v, w in zip(values, weights, strict=True))


def blended(scene: Scene, backend: str, dtype: torch.dtype, device: torch.device) -> Results:
    """Render channels; return them, their gradients and the sums of contributions."""
    tensors = {k: v.to(device, dtype, copy=True) for k, v in scene.items() if isinstance(v, Tensor)}
    for name in GRADIENTS:
        tensors[name].requires_grad_()
    drawn = rasterize(**{**scene, **tensors}, backend=backend)
    weighted([drawn.channels, drawn.alpha], 1).backward()
    results = {"picture": drawn.channels, "alpha": drawn.alpha, "gradient by means2d": drawn.means2d.grad}
    results |= {f"gradient by {name}": tensors[name].grad for name in GRADIENTS}
    generator = torch.Generator().manual_seed(2)
    size = drawn.alpha.shape
    pictures = {"weights": torch.rand(*size, 2, generator=generator, dtype=torch.float64)}
    pictures["image_gradient"] = torch.randn(drawn.channels.shape, generator=generator, dtype=torch.float64)
    still = {k: v.detach() for k, v in tensors.items()} | {k: v.to(device, dtype) for k, v in pictures.items()}
    found = contributions(**{**scene, **still}, backend=backend)
    return results | {name: getattr(found, name) for name in ("weighted", "importance", "error")}


def trained(scene: Scene, backend: str, dtype: torch.dtype, device: torch.device) -> Results:
    """Render a cloud in water, with range and restored colors; return them and the gradients through SSIM."""
    generator = torch.Generator().manual_seed(3)
    n, width, height = len(scene["means"]), scene["width"], scene["height"]

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    cloud = GaussianCloud(
        means=scene["means"].float(),
        quats=scene["quats"].float(),
        log_scales=scene["scales"].log().float(),
        opacity_logits=scene["opacities"].logit().float(),
        sh0=normal(n, 1, 3),
        shN=0.2 * normal(n, 15, 3),
        background=normal(3),
    )
    medium = Medium(normal(3), normal(3), 0.5 * normal(9, 3), 3.0, "linear" if n % 2 else "srgb")
    leaves = {}
    for owner in (cloud, medium):
        for name, tensor in owner.parameters().items():
            leaves[name] = tensor.to(device, dtype, copy=True).requires_grad_()
            setattr(owner, name, leaves[name])
    K = scene["K"]
    pinhole = [float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
    camera = Camera("random", width, height, *pinhole, scene["viewmat"].numpy())
    picture = render(cloud, camera, 3, medium, with_range=True, with_restored=True, backend=backend)
    target = torch.rand(height, width, 3, generator=generator).to(device, dtype)
    loss = photometric(picture.color, target, None, 0.0, 1.0, backend=backend)
    outputs = {"picture": picture.color, "alpha": picture.alpha, "restored": picture.restored}
    (loss + 0.01 * weighted([*outputs.values(), picture.range], 4)).backward()
    gradients = {f"gradient by {name}": leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    return outputs | {"range": picture.range, "loss": loss} | gradients


def tolerance(backend: str, way: str, name: str) -> float:
    """Return the tolerance of a tensor."""
    return TRAINED_GRADIENTS if way == "trained" and name.startswith("gradient") else TOLERANCE


def errors(scene: Scene) -> dict[tuple[str, str, str], float]:
    """Measure the relative errors by backend, way and tensor."""
    found = {}
    for way in (blended, trained):
        truth = way(scene, "torch", torch.float64, torch.device("cpu"))
        for backend, device in BACKENDS.items():
            result = way(scene, backend, torch.float32, device)
            assert result.keys() == truth.keys()
            for name, value in result.items():
                found[backend, way.__name__, name] = relative_error(value.detach().double().cpu(), truth[name].detach())
    return found


def main() -> int:
    """Compare all scenes, print and write the largest errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0, help="number of the first scene")
    options = parser.parse_args()
    torch.set_num_threads(1)
    begun, worst, ties, wrong = time.perf_counter(), {}, [], []
    with tempfile.TemporaryDirectory() as folder:
        if not ON_CARD:
            fibres = Fibres(Path(folder))
            KERNELS["cuda"] = CudaKernels(lambda: fibres)
        for number in range(options.seed, options.seed + options.scenes):
            scene = random_scene(number)
            found = errors(scene)
            over = {" ".join(key): error for key, error in found.items() if not error <= tolerance(*key)}
            if over and blend_by_definition(scene)[2] < NEAR_A_COMPARISON:
                ties.append(number)
                continue
            if over:
                wrong.append(number)
                print(f"scene {number}: {over}", file=sys.stderr)
            for key, error in found.items():
                worst[key] = max(worst.get(key, 0.0), error)
    table: dict[str, dict[str, dict[str, float]]] = {}
    for (backend, way, name), error in worst.items():
        table.setdefault(backend, {}).setdefault(way, {})[name] = float(f"{error:.2g}")
    result = {
        "scenes": options.scenes,
        "first": options.seed,
        "cuda": "on the card" if ON_CARD else "on simulated threads",
        "tolerance": {"of gradients, trained": TRAINED_GRADIENTS, "of all others": TOLERANCE},
        "scenes decided by rounding": ties,
        "scenes over the tolerance": wrong,
        "largest error": table,
        "seconds": round(time.perf_counter() - begun),
    }
    write_results("backends_agree", result)
    print(json.dumps(result, indent=2))
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
