"""Compare our densification with gsplat's DefaultStrategy and MCMCStrategy, all on our rasteriser.

Run: `pip install --no-deps gsplat==1.5.3 jaxtyping wadler-lindig rich`, then
`python benchmarks/strategies.py [--iterations 1000 4000] [--seeds 0 1 2] [--scenes demo]`
Results: benchmarks/results/strategies.json, written after each run; runs that are in it are not repeated, so that the
script can be stopped and started again.

The recipe is `3dgs` everywhere, so that nothing but the strategy and its rates differs; one scene is trained once more
with the exposure of its photos. gsplat's strategies get what they ask for: parameters, optimisers with their moments,
gradients on screen and radii of each step. They run with gsplat's published rates, schedule and weights (its
simple_trainer.py), whose 30 000 iterations are scaled to the run's length.

DefaultStrategy has no limit of the number of Gaussians: the limit of all others is what it ends with. Ours takes no
more than one for each pixel of the surface; where that is fewer, MCMCStrategy runs once more with that number. One run
has the number that the preset `standard` takes for the photos at this width.
"""

import argparse
import contextlib
import itertools
import json
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import DEMO, RESULTS, SHARED, machine, write_results
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.gaussians.densify import MAX_SHARERS, rotation_matrices, share_opacity
from swag_engine.gaussians.init import gaussians_from_points
from swag_engine.scene.colmap import Scene, load_scene
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.densification import Densification
from swag_engine.training.pacing.preset_size import fit_preset
from swag_engine.training.schedule import STANDARD, LearningRates, Schedule
from swag_engine.training.state import RunState
from swag_engine.training.step import Step, StepConfig, StepResult
from swag_engine.training.targets import Target
from swag_engine.training.trainer import Trainer, make_trainer

SCENES = {
    "demo": DEMO,
    "aqualoc_amphorae": SHARED / "aqualoc_amphorae",
    "japanese_gardens": SHARED / "japanese_gardens",
    "aqualoc_amphorae, exposure": SHARED / "aqualoc_amphorae",
}
EFFECTS = {"aqualoc_amphorae, exposure": "exposure=on"}
"""Effects that recipe `3dgs` does not model and that a scene is trained with, in all runs alike."""
WIDTH = 320
"""Width of the images, pixels."""
MOST = 50_000
"""Limit of the initial Gaussians of DefaultStrategy, which heeds none later."""
PUBLISHED = 30_000
"""Iterations of gsplat's simple_trainer.py, from which its schedule is scaled."""
NAMES = {
    "means": "means", "quats": "quats", "log_scales": "scales", "opacity_logits": "opacities",
    "sh0": "sh0", "shN": "shN",
}  # fmt: skip
"""gsplat's name of each parameter of a cloud."""


def published_rates(scale: float, median_range: float) -> LearningRates:
    """Learning rates of gsplat's simple_trainer.py; those of the means are per scene scale there, per range here."""
    means = 1.6e-4 * scale / median_range
    return LearningRates(
        means=means, means_end=0.01 * means, quats=1e-3, log_scales=5e-3, opacity_logits=5e-2, sh0=2.5e-3,
        shN=2.5e-3 / 20,
    )  # fmt: skip


def published_schedule(rates: LearningRates) -> Schedule:
    """Whole images from the start, a degree of spherical harmonics more every thirtieth of the run, Adam undamped."""
    degrees = (1 / 30, 2 / 30, 3 / 30)
    return replace(STANDARD, coarse=(), sh_degrees=degrees, learning_rates=rates, hardly_shown=0.0)


class RecordingStep:
    """A step that keeps its last result and target, and adds what a strategy adds to the loss."""

    def __init__(self, step: Step) -> None:
        self.step = step

    def __call__(self, state: RunState, target: Target, config: StepConfig) -> StepResult:
        """Make one step; see `Step`."""
        self.target, self.result = target, self.step(state, target, config)
        return self.result


class GsplatDensification(Densification):
    """Lets a strategy of gsplat change the cloud of a trainer."""

    def __init__(self, trainer: Trainer, strategy: Any, strategy_state: dict[str, Any]) -> None:
        self.strategy, self.strategy_state, self.count = strategy, strategy_state, len(trainer.state.cloud)
        trainer.step = self.recorded = RecordingStep(trainer.step)
        trainer.densification = self

    def due(self, state: RunState) -> bool:
        """Return that a strategy is given every step; it decides itself when to act."""
        return True

    def after_step(self, state: RunState, means_rate: float, sh_degree: int, water_degree: int) -> None:
        """Give the strategy the step that was made; see `Densification.after_step`."""
        with torch.no_grad():
            count = len(state.cloud)
            if count != self.count:  # after a rollback the strategy's own counts do not fit
                self.strategy_state |= {name: None for name in ("grad2d", "count") if name in self.strategy_state}
            parameters, optimizers = to_gsplat(state)
            self._call(parameters, optimizers, state.iteration, means_rate)
            take_back(state, parameters, optimizers, count)
            self.count = len(state.cloud)

    def _call(self, parameters: dict[str, Any], optimizers: dict[str, Any], step: int, rate: float) -> None:
        if hasattr(self.strategy, "cap_max"):
            self.strategy.step_post_backward(parameters, optimizers, self.strategy_state, step, {}, lr=rate)
            return
        target, result = self.recorded.target, self.recorded.result
        means2d = torch.zeros(1, len(result.radii), 2)
        means2d.grad = result.means2d_gradient[None]
        camera = target.camera
        info = {
            "width": camera.width, "height": camera.height, "n_cameras": 1, "gaussian_ids": None,
            "radii": result.radii[None, :, None].expand(1, -1, 2).float(), "means2d": means2d,
        }  # fmt: skip
        self.strategy.step_post_backward(parameters, optimizers, self.strategy_state, step, info)


def to_gsplat(state: RunState) -> tuple[dict[str, Any], dict[str, Any]]:
    """Parameters and Adam optimisers as gsplat has them; they share the state's memory."""
    parameters, optimizers = {}, {}
    for ours, theirs in NAMES.items():
        parameter = torch.nn.Parameter(getattr(state.cloud, ours).detach())
        optimizer = torch.optim.Adam([parameter])
        mean, square = state.optimizer.moments[ours]
        optimizer.state[parameter] = {"step": torch.tensor(0.0), "exp_avg": mean, "exp_avg_sq": square}
        parameters[theirs], optimizers[theirs] = parameter, optimizer
    return parameters, optimizers


def take_back(state: RunState, parameters: dict[str, Any], optimizers: dict[str, Any], count: int) -> None:
    """Give the state the parameters and moments that a strategy of gsplat has changed."""
    cloud = state.cloud
    if len(parameters["means"]) != count:
        cloud.features = cloud.features.new_zeros(len(parameters["means"]), cloud.features.shape[1])
        state.optimizer.moments["features"] = (cloud.features.clone(), cloud.features.clone())
    for ours, theirs in NAMES.items():
        setattr(cloud, ours, parameters[theirs].detach().contiguous().requires_grad_())
        moments = optimizers[theirs].state[parameters[theirs]]
        state.optimizer.moments[ours] = (moments["exp_avg"], moments["exp_avg_sq"])
    if len(cloud) != count:
        state.reset_statistics()


def as_mcmc_starts(*arguments: Any) -> GaussianCloud:
    """The initial Gaussians as gsplat's MCMC runs have them: opacity .5, a tenth of the width."""
    cloud = gaussians_from_points(*arguments)
    return replace(
        cloud, opacity_logits=torch.zeros_like(cloud.opacity_logits), log_scales=cloud.log_scales + math.log(0.1)
    )


def gsplat_strategy(name: str, iterations: int, most: int, scale: float) -> tuple[Any, dict[str, Any]]:
    """A strategy of gsplat with its published values, whose iterations are scaled to the run's length, and its state.

    DefaultStrategy decides by gradients that are averaged between two refinements: there are at least ten steps.
    """
    from gsplat.strategy import DefaultStrategy, MCMCStrategy

    def scaled(published: int, least: int = 1) -> int:
        return max(least, round(published * iterations / PUBLISHED))

    if name == "gsplat default":
        strategy = DefaultStrategy(
            refine_start_iter=scaled(500), refine_stop_iter=scaled(15_000), refine_every=scaled(100, 10),
            reset_every=scaled(3000),
        )  # fmt: skip
        return strategy, strategy.initialize_state(scene_scale=scale)
    strategy = MCMCStrategy(
        cap_max=most, refine_start_iter=scaled(500), refine_stop_iter=scaled(25_000), refine_every=scaled(100)
    )
    return strategy, strategy.initialize_state()


@contextlib.contextmanager
def without_cuda() -> Iterator[None]:
    """Give gsplat's strategies the two functions that it has only for CUDA."""
    import gsplat.strategy.ops as ops

    def covariances(quats: Tensor, scales: Tensor, **_: bool) -> tuple[Tensor, None]:
        axes = rotation_matrices(quats) * scales[:, None]
        return axes @ axes.mT, None

    def relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
        opacity, factor = share_opacity(opacities, ratios.clamp(1, MAX_SHARERS))
        return opacity, scales * factor[:, None]

    with mock.patch.multiple(ops, quat_scale_to_covar_preci=covariances, compute_relocation=relocation):
        yield


def camera_extent(scene: Scene) -> float:
    """Return gsplat's scene scale: 1.1 times the largest distance of a camera from the cameras' mean."""
    centres = np.array([view.camera.centre for view in scene.views])
    return 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def run(scene_name: str, name: str, iterations: int, most: int, seed: int) -> dict[str, Any]:
    """Train once and return test PSNR, number of Gaussians and processor time."""
    scene, effects = SCENES[scene_name], EFFECTS.get(scene_name, "")
    settings = TrainSettings(
        recipe="3dgs", effects=effects, width=WIDTH, max_gaussians=most, iterations=iterations, seed=seed, backend="cpu"
    )
    loaded = load_scene(scene)
    scale = camera_extent(loaded)
    theirs = name.startswith("gsplat")
    torch.manual_seed(seed)  # gsplat draws from torch's own generator
    with tempfile.TemporaryDirectory() as folder, without_cuda() if theirs else contextlib.nullcontext():
        initial = as_mcmc_starts if name == "gsplat mcmc" else gaussians_from_points

        def trainer_with(schedule: Schedule, out: str) -> Trainer:
            return make_trainer(
                RunFolder(Path(folder) / out), scene, settings, False, lambda event: None, None, 0.0, schedule, initial
            )

        trainer = trainer_with(STANDARD, "ours")
        if theirs:
            trainer = trainer_with(published_schedule(published_rates(scale, trainer.inputs.median_range)), "theirs")
            GsplatDensification(trainer, *gsplat_strategy(name, iterations, most, scale))
        if name == "gsplat mcmc":
            trainer.state.recipe = replace(trainer.state.recipe, densification="mcmc")
        started = time.process_time()
        while not trainer.state.clock.done:
            trainer.iterate()
        seconds = time.process_time() - started
        metrics = trainer.run_to_end(lambda: False, False)["metrics"]
    return {"psnr": round(metrics["test_psnr"], 3), "gaussians": metrics["gaussians"], "seconds": round(seconds, 1)}


def earlier_runs() -> list[dict[str, Any]]:
    """Return the runs of the results file, none where there is no such file."""
    path = RESULTS / "strategies.json"
    return json.loads(path.read_text(encoding="utf-8"))["runs"] if path.exists() else []


def compare(scene: str, iterations: int, seed: int, rows: list[dict[str, Any]]) -> None:
    """Train with all strategies: equal iterations, then ours in the processor time that the slower of gsplat's took.

    Args:
        scene: Name of the scene.
        iterations: Iterations of each run but that of equal processor time.
        seed: Seed of all runs.
        rows: Runs that were made; those that are missing are made and added.
    """

    def add(name: str, planned: int, most: int, equal: str, limit: str) -> dict[str, Any]:
        key = {"scene": scene, "strategy": name, "length": iterations, "seed": seed, "equal": equal, "limit": limit}
        for row in rows:
            if key.items() <= row.items():
                return row
        rows.append(key | {"iterations": planned} | run(scene, name, planned, most, seed))
        write_results("strategies", {"machine": machine(), "width": WIDTH, "runs": rows})
        print(rows[-1], flush=True)
        return rows[-1]

    settings = TrainSettings(preset="standard", width=WIDTH, iterations=iterations, backend="cpu")
    add("ours", iterations, fit_preset(load_scene(SCENES[scene]), settings).max_gaussians, "iterations", "preset")
    default = add("gsplat default", iterations, MOST, "iterations", "gsplat default")
    most = default["gaussians"]
    mcmc = add("gsplat mcmc", iterations, most, "iterations", "gsplat default")
    ours = add("ours", iterations, most, "iterations", "gsplat default")
    slowest = max(default["seconds"], mcmc["seconds"])
    longer = round(iterations * slowest / ours["seconds"])
    add("ours", longer, most, "processor time", "gsplat default")
    if ours["gaussians"] < most:
        add("gsplat mcmc", iterations, ours["gaussians"], "iterations", "ours")


def main() -> None:
    """Compare on all scenes that are on this machine and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, nargs="+", default=[1000, 4000])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    arguments = parser.parse_args()
    rows = earlier_runs()
    for iterations, seed, scene in itertools.product(arguments.iterations, arguments.seeds, arguments.scenes):
        if SCENES[scene].exists():
            compare(scene, iterations, seed, rows)
        else:
            print(f"{scene} is not on this machine.")


if __name__ == "__main__":
    main()
