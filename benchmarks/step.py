"""Measure the processor time of a training step over that of its rasterising: the native step and the one by autograd.

Run: `python benchmarks/step.py`
Results: benchmarks/results/step.json

The two steps and the rasterising alone alternate in one process, so that other load on the machine affects all of them.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import swag_engine.base.threads  # noqa: F401  before torch, which reads what it sets

# isort: split
import torch

from benchmarks.common import DEMO, machine, write_results
from benchmarks.raster import make_cloud, raster
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.scene.cameras import Camera
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.native_step import NativeStep
from swag_engine.training.step import AutogradStep
from swag_engine.training.targets import Target
from swag_engine.training.trainer import make_trainer

WIDTH, HEIGHT = 640, 360
OFF = "lamp=off,exposure=off,vignetting=off,caustics=off,moving_objects=off"
CASES = {
    "3dgs": ("3dgs", ""),
    "swag with water": ("swag", f"attenuation=on,backscatter=on,{OFF}"),
    "swag with water, lamp, exposure and vignetting": (
        "swag",
        "attenuation=on,backscatter=on,lamp=on,exposure=on,vignetting=on,caustics=off,moving_objects=off",
    ),
}
"""Recipe and effects by name."""
GAUSSIANS = (20_000, 50_000)
THREADS = (1, 2)
ROUNDS, WARM_UP = 15, 3


def both_steps(
    case: str, cloud: GaussianCloud, camera: Camera, folder: Path, backend: str = "auto"
) -> dict[str, Callable[[], object]]:
    """Return both steps of a case of `CASES` on the same state."""
    recipe, effects = CASES[case]
    sizes = {"iterations": 1000, "width": WIDTH, "max_gaussians": len(cloud)}
    settings = TrainSettings(**sizes, recipe=recipe, effects=effects, backend=backend)
    trainer = make_trainer(RunFolder(folder), DEMO, settings, False, lambda event: None, None, time.monotonic())
    device = trainer.inputs.device
    trainer.state.replace_free(cloud.to(device), torch.full((len(cloud),), -1, device=device))
    config = replace(trainer.step_config(), fraction=0.6, sh_degree=3, water_degree=2)
    coarse = (camera.height // 8, camera.width // 8, 3)
    pixels = torch.randint(0, 256, coarse, generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    pixels = pixels.repeat_interleave(8, 0).repeat_interleave(8, 1).to(device)
    camera = replace(camera, name=trainer.inputs.training[0].camera.name)
    target = Target(camera, pixels, torch.ones(pixels.shape[:2], dtype=torch.bool, device=device))
    autograd = AutogradStep(trainer.inputs, trainer.selection, None)
    native = NativeStep(trainer.inputs, trainer.selection, autograd)
    return {
        "autograd": lambda: autograd(trainer.state, target, config),
        "native": lambda: native(trainer.state, target, config),
    }


def processor_ms(timed: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Return the median processor time of each over rounds in which each runs once."""
    times: dict[str, list[float]] = {name: [] for name in timed}
    for number in range(WARM_UP + ROUNDS):
        for name, step in timed.items():
            started = time.process_time()
            step()
            if number >= WARM_UP:
                times[name].append(1000 * (time.process_time() - started))
    return {name: round(median(values), 1) for name, values in times.items()}


def main() -> None:
    """Time all cases, print and write the figures."""
    rows = []
    for name in CASES:
        for count in GAUSSIANS:
            with tempfile.TemporaryDirectory() as folder:
                timed = {"rasterise": raster(count, WIDTH, HEIGHT, "cpu")}
                timed |= both_steps(name, *make_cloud(count, WIDTH, HEIGHT), Path(folder) / "run")
                for threads in THREADS:
                    torch.set_num_threads(threads)
                    rows.append({"case": name, "gaussians": count, "threads": threads, **processor_ms(timed)})
                    print(rows[-1], flush=True)
    document = {"machine": machine(), "torch": torch.__version__, "width": WIDTH, "rounds": ROUNDS, "rows": rows}
    write_results("step", document)


if __name__ == "__main__":
    main()
