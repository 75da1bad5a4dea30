"""Measure long and large runs: memory, drift of the restored colors in stage 2, skipped and rolled back steps.

Run: `python benchmarks/long_runs.py [--part default|recipes|large]` (Linux)
Results: benchmarks/results/long_runs.json and large_run.json

default   The default recipe, 20 000 iterations on two scenes at 320 pixels.
recipes   Every other recipe, 5 000 iterations on the demo scene at 320 pixels.
large     2 000 iterations with up to 500 000 Gaussians on the images of japanese_gardens, 1280x845 pixels: time of an
          iteration, memory of a Gaussian, and whether the times of the parts add up.

Runs whose figures are in the file already are skipped, and scenes that are not on this machine.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np
import torch

from benchmarks.common import RESULTS, SHARED, machine, write_results
from benchmarks.train_scenes import SCENES
from swag_engine.rendering.render import render
from swag_engine.settings.recipes import RECIPES
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import Trainer
from tests.scenes.runs import train_with

DEFAULT = TrainSettings().recipe
LONG, SHORT = 20_000, 5_000
SAMPLES = 40
"""Memory measurements per run."""
LARGE = TrainSettings(iterations=2000, width=1280, max_gaussians=500_000, backend="cpu")
"""The large run."""


def resident() -> int:
    """Return the resident bytes of this process (Linux)."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmRSS")))


def restored(trainer: Trainer) -> list[torch.Tensor]:
    """Render the test views without water."""
    with torch.no_grad():
        return [
            render(trainer.state.cloud, image.camera, medium=trainer.state.effects.medium, amount=0.0).color.clamp(0, 1)
            for image in trainer.inputs.test
        ]


def one(scene: Path, recipe: str, iterations: int) -> dict[str, Any]:
    """Figures of one run, in this process."""
    memory, before, skipped = [], [], []

    def watched(trainer: Trainer, iterate: Callable[[], float]) -> float:
        if not before and trainer.step_config().stage_two:
            before.extend(restored(trainer))
        loss = iterate()
        state = trainer.state
        if state.iteration % (iterations // SAMPLES) == 0:
            memory.append([state.iteration, len(state.cloud), round(resident() / 1e6, 1)])
        if state.iteration == iterations:
            skipped.append(state.guarded.record)
            if before:
                after = restored(trainer)
                change = torch.stack([(b - a).abs().mean() for a, b in zip(before, after, strict=True)])
                shift = torch.stack([(b - a).mean((0, 1)) for a, b in zip(before, after, strict=True)]).mean(0)
                drift.update(
                    mean_change=round(float(change.mean()), 5), shift_rgb=[round(v, 5) for v in shift.tolist()]
                )
        return loss

    drift: dict[str, Any] = {}

    def watch(trainer: Trainer) -> None:
        trainer.iterate = partial(watched, trainer, trainer.iterate)  # type: ignore[method-assign]

    with tempfile.TemporaryDirectory() as folder:
        settings = TrainSettings(recipe=recipe, iterations=iterations, width=320, max_gaussians=30_000)
        metrics = train_with(scene, Path(folder) / "run", settings, watch)["metrics"]
    settled = [entry for entry in memory if entry[1] == memory[-1][1]]
    return {
        "seconds": metrics["seconds"],
        "test_psnr": metrics["test_psnr"],
        "gaussians": metrics["gaussians"],
        "skipped": skipped[0].skipped,
        "put_back": skipped[0].rollbacks,
        "MB when the number of Gaussians was settled": settled[0][2],
        "MB at the end": memory[-1][2],
        "restored colors, change in stage two (display values)": drift,
    }


def large(scene: Path) -> dict[str, Any]:
    """Figures of the large run, in this process.

    Memory of a Gaussian is the slope of the memory over the number of Gaussians while that grows.
    """
    samples, times = [], []

    def watched(trainer: Trainer, iterate: Callable[[], float]) -> float:
        started = time.perf_counter()
        loss = iterate()
        if len(trainer.state.cloud) == LARGE.max_gaussians:
            times.append(time.perf_counter() - started)
        if trainer.state.iteration % 20 == 0:
            samples.append((len(trainer.state.cloud), resident()))
        if trainer.state.iteration == LARGE.iterations:
            records.append(trainer.state.guarded.record)
        return loss

    records: list[Any] = []

    def watch(trainer: Trainer) -> None:
        trainer.iterate = partial(watched, trainer, trainer.iterate)  # type: ignore[method-assign]

    with tempfile.TemporaryDirectory() as folder:
        metrics = train_with(scene, Path(folder) / "run", LARGE, watch)["metrics"]
    growing = np.array([sample for sample in samples if sample[0] < samples[-1][0]], float)
    return {
        "machine": machine(),
        "iterations": metrics["iteration"],
        "gaussians": metrics["gaussians"],
        "test_psnr": metrics["test_psnr"],
        "seconds": metrics["seconds"],
        "seconds by parts": metrics["iteration"] * sum(metrics["ledger"].values()) / 1000,
        "iterations with all Gaussians": len(times),
        "ms of such an iteration, median": 1000 * float(np.median(times)),
        "bytes of a Gaussian": float(np.polyfit(growing[:, 0], growing[:, 1], 1)[0]),
        "MB at the end": samples[-1][1] / 1e6,
        "skipped": records[0].skipped,
        "put_back": records[0].rollbacks,
    }


def main() -> None:
    """Make the runs that are not in the results yet, each in a separate process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=("default", "recipes", "large"))
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(one(Path(options.one[0]), options.one[1], int(options.one[2]))))
        return
    scene = SHARED / "japanese_gardens"
    if options.part in (None, "large") and not (RESULTS / "large_run.json").exists() and scene.exists():
        write_results("large_run", large(scene))
    demo, *others = SCENES
    runs = [] if options.part in ("recipes", "large") else [(scene, DEFAULT, LONG) for scene in (demo, others[0])]
    runs += (
        []
        if options.part in ("default", "large")
        else [(demo, recipe, SHORT) for recipe in RECIPES if recipe != DEFAULT]
    )
    path = RESULTS / "long_runs.json"
    document = json.loads(path.read_text()) if path.exists() else {}
    document["machine"] = machine()
    for scene, recipe, iterations in runs:
        name = f"{recipe}, {scene}, {iterations} iterations"
        if name in document or not SCENES[scene].exists():
            continue
        command = [sys.executable, __file__, "--one", str(SCENES[scene]), recipe, str(iterations)]
        document[name] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        write_results("long_runs", document)
        print(
            name, {key: value for key, value in document[name].items() if not key.startswith("iteration")}, flush=True
        )


if __name__ == "__main__":
    main()
