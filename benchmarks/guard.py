"""Measure the cost of the guard's checks as a fraction of a training iteration, within one process.

Run: `python benchmarks/guard.py`
Results: benchmarks/results/guard.json
"""

import json
import math
import sys
import time
from dataclasses import asdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torch

from benchmarks.common import processor, write_results
from benchmarks.raster import MAIN, make_cloud
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.rendering.render import render
from swag_engine.training.guard import MOST_INTERVAL, Guard, GuardedState, step_problem
from swag_engine.training.losses import photometric
from swag_engine.training.optimizer import Optimizer
from swag_engine.training.schedule import LearningRates

ROUNDS = 40


def main() -> None:
    """Time the guard beside the iteration, print and write the results."""
    n, width, height = MAIN
    cloud, camera = make_cloud(n, width, height)
    optimizer, rates, target = Optimizer(cloud, SceneEffects()), asdict(LearningRates()), torch.rand(height, width, 3)
    guard, guarded = Guard(10_000), GuardedState()
    guarded.keep(optimizer)
    loss = torch.zeros(())

    def whole() -> None:
        nonlocal loss
        optimizer.clear_gradients()
        loss = photometric(render(cloud, camera, 3).color, target, None)
        loss.backward()

    def check() -> None:
        guarded.record_step(*step_problem(loss, optimizer.parameters()), "view", "phase")

    def adam() -> None:
        gradients = {name: parameter.grad for name, parameter in optimizer.parameters().items()}
        optimizer.step(rates)
        for name, parameter in optimizer.parameters().items():
            parameter.grad = gradients[name]

    def full() -> None:
        guard.roll_back_if_bad(guarded, optimizer, MOST_INTERVAL)

    steps = {"picture and gradients": whole, "every iteration": check, "Adam": adam, "full": full}
    times = {name: math.inf for name in steps}
    for _ in range(ROUNDS):  # the best of many, so that other work on the machine counts little
        for name, step in steps.items():
            start = time.perf_counter()
            step()
            times[name] = min(times[name], 1000 * (time.perf_counter() - start))
    iteration = times["picture and gradients"] + times["Adam"]
    checking = times["every iteration"] + times["full"] / MOST_INTERVAL
    document = {
        "machine": f"{processor()}, {torch.get_num_threads()} threads",
        "what": f"{n} Gaussians at {width}x{height}, ms",
        "iteration": round(iteration, 1),
        "guard, every iteration": round(times["every iteration"], 3),
        f"guard, every {MOST_INTERVAL} iterations": round(times["full"], 1),
        "guard, per cent of an iteration": round(100 * checking / iteration, 2),
    }
    write_results("guard", document)
    print(json.dumps(document, indent=2))


if __name__ == "__main__":
    main()
