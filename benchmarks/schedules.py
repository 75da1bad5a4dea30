"""Compare schedules of image size, number of Gaussians and opacities with the standard, at equal processor time.

Run: `python benchmarks/schedules.py GENERATED [--scenes demo] [--seeds 0 1 2]`; GENERATED is the folder of the
generated scenes of benchmarks/presets.py, which are made if they are missing
Results: benchmarks/results/schedules.json, written after each change; what is in it is not repeated.

A change first runs with as many iterations as the standard, with one seed, then with more or fewer until the processor
times are equal. Everything is trained on one thread.
"""

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from unittest import mock

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import RESULTS, machine, write_results
from benchmarks.presets import SCENES, generated_scenes
from swag_engine.evaluation.metrics import mean_score, score_views
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians import sizes
from swag_engine.gaussians.densify import MIN_OPACITY
from swag_engine.rendering.importance import scores
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.splats import LEAST_VARIANCE
from swag_engine.training.densification import Densification
from swag_engine.training.schedule import STANDARD, Schedule
from swag_engine.training.state import RunState
from swag_engine.training.trainer import Trainer, make_trainer

ITERATIONS, WIDTH = 1000, 320
TOLERANCE = 0.05
"""Fraction by which the time of a run may differ from that of the standard."""
VIEWS = 10
"""Images by whose errors Gaussians are chosen."""
RESETS = 5
"""Opacities are reset so often in a run, but not after Gaussians are added. 3DGS does it ten times, which would leave
too few iterations between two resets here."""


class ByResolution(Densification):
    """Allows fewer Gaussians while images are reduced, as DashGaussian (arXiv 2503.18402)."""

    def _densify(self, state: RunState, random: torch.Generator) -> None:
        share = self.targets.factor ** (state.clock.fraction - 2)
        most = state.start_count + round((self.inputs.settings.max_gaussians - state.start_count) * share)
        with mock.patch.object(state.relief, "most", most):
            super()._densify(state, random)


class ByErrors(Densification):
    """Splits Gaussians by their part in the errors of several images, and removes those that these hardly need.

    The idea of FastGS (arXiv 2511.04283).
    """

    def _densify(self, state: RunState, random: torch.Generator) -> None:
        if state.iteration % self.inputs.schedule.densify_every or state.clock.fraction > state.recipe.densify_until:
            return
        targets = self.targets.at(state, state.clock.fraction)
        drawn = [targets[i] for i in torch.randperm(len(targets), generator=random)[:VIEWS]]
        views = [(target.camera, lambda color, target=target: (color - target.color).abs().mean()) for target in drawn]
        effects = state.effects
        importance, error = scores(state.cloud, views, 3, effects.medium, 2, "cpu", effects.lamp)
        with torch.no_grad():
            state.cloud.opacity_logits[(importance > 0) & (importance < 0.1 / self.targets.factor**2)] = -10.0
        weights = error / error.mean()
        with mock.patch.object(self, "guidance", mock.Mock(densification_weights=lambda cloud: weights)):
            super()._densify(state, random)


class WithResets(Densification):
    """Resets opacities as 3DGS (arXiv 2308.04079)."""

    def _densify(self, state: RunState, random: torch.Generator) -> None:
        super()._densify(state, random)
        every = self.inputs.schedule.densify_every
        every *= max(1, round(state.clock.iterations / RESETS / every))
        if not state.iteration % every and state.clock.fraction < state.recipe.densify_until:
            with torch.no_grad():
                state.cloud.opacity_logits.clamp_(max=torch.logit(torch.tensor(2 * MIN_OPACITY)).item())
            for moment in state.optimizer.moments["opacity_logits"]:
                moment.zero_()


CHANGES: dict[str, tuple[type[Densification], Schedule, float]] = {
    "standard": (Densification, STANDARD, LEAST_VARIANCE),
    "images of full size throughout": (Densification, replace(STANDARD, coarse=()), LEAST_VARIANCE),
    "fewer Gaussians while images are reduced (DashGaussian)": (ByResolution, STANDARD, LEAST_VARIANCE),
    "split and removed by errors of 10 images (FastGS)": (ByErrors, STANDARD, LEAST_VARIANCE),
    "opacities reset every fifth of a run": (WithResets, STANDARD, LEAST_VARIANCE),
    "no least size": (Densification, STANDARD, 1e-12),
}
"""What densifies, the schedule and the least variance of Gaussians."""


def run(scene: Path, change: str, seed: int, iterations: int) -> tuple[float, float]:
    """Train once and return test PSNR in dB and processor time in seconds."""
    settings = TrainSettings(preset="standard", iterations=iterations, width=WIDTH, seed=seed, backend="cpu")
    densification, schedule, variance = CHANGES[change]
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(sizes, "LEAST_VARIANCE", variance):
        out = RunFolder(Path(folder) / "run")
        trainer: Trainer = make_trainer(out, scene, settings, False, lambda event: None, None, 0.0, schedule)
        trainer.densification = densification(trainer.inputs, trainer.selection, trainer.targets, None)
        started = time.process_time()
        while not trainer.state.clock.done:
            trainer.iterate()
        seconds = time.process_time() - started
        state = trainer.state
        found = score_views(state.cloud, trainer.inputs.test, 3, "cpu", state.effects)
    return round(mean_score(found)[0], 3), round(seconds, 1)


def main() -> None:
    """Make the runs that are missing on all scenes that are on this machine."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("generated", type=Path)
    parser.add_argument("--scenes", nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    path = RESULTS / "schedules.json"
    results = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for name, scene in (SCENES | generated_scenes(arguments.generated)).items():
        if not scene.exists() or (arguments.scenes and name not in arguments.scenes):
            continue
        rows = results.setdefault(name, {})
        for change in CHANGES:
            if change in rows:
                continue
            iterations = ITERATIONS
            first, took = run(scene, change, arguments.seeds[0], iterations)
            row = rows[change] = {"seconds": took}
            while abs(took / rows["standard"]["seconds"] - 1) > TOLERANCE:
                iterations = round(iterations * rows["standard"]["seconds"] / took)
                first, took = run(scene, change, arguments.seeds[0], iterations)
            row["iterations"] = iterations
            row["psnr"] = [first, *(run(scene, change, seed, iterations)[0] for seed in arguments.seeds[1:])]
            write_results("schedules", {**results, "machine": machine()})
            print(name, change, row, flush=True)


if __name__ == "__main__":
    main()
