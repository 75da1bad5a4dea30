"""Measure long runs: memory over time, drift of the restored colors in stage 2, skipped and rolled back steps.

Run: `python benchmarks/long_runs.py [--part default|recipes]` (Linux)
Results: benchmarks/results/long_runs.json

The default recipe runs 20 000 iterations on two scenes, every other recipe 5 000 on the demo scene, at 320 pixels.
Runs whose figures are in the file already are skipped, and scenes that are not on this machine.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch

from benchmarks.common import RESULTS, machine, write_results
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
        "iteration, Gaussians, MB": memory,
    }


def main() -> None:
    """Make the runs that are not in the results yet, each in a separate process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=("default", "recipes"))
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(one(Path(options.one[0]), options.one[1], int(options.one[2]))))
        return
    demo, *others = SCENES
    runs = [] if options.part == "recipes" else [(scene, DEFAULT, LONG) for scene in (demo, others[0])]
    runs += [] if options.part == "default" else [(demo, recipe, SHORT) for recipe in RECIPES if recipe != DEFAULT]
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
