"""Measure what each effect costs in training, beside the cost that the plan predicts.

Run: `python benchmarks/effects_training.py [SCENE ...]` (without SCENE: the demo scene)
Results: benchmarks/results/effects_training.json

Each row is a run of ITERATIONS at 320 pixels with at most 20 000 Gaussians. The rows take turns, ROUNDS times; a
row's figure is the least mean of four consecutive iterations in the last third of its runs, which limits the influence
of other processes. At the end a street in air, where the plan switches every effect off, is trained as planned and
with all effects on: three seeds, processor time of whole runs of AIR_ITERATIONS.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import DEMO, write_results
from benchmarks.effects_matrix import SKY
from swag_engine.experiments.ablate import ALL
from swag_engine.planning.costs import measured_costs
from swag_engine.scene.colmap import load_scene
from swag_engine.semantics.assign import FEATURES_EVERY
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import Trainer, train
from tests.scenes.effect_scenes import rendered, settings_for
from tests.scenes.make_scene import Water, make_scene
from tests.scenes.runs import train_with

ITERATIONS, ROUNDS, AIR_ITERATIONS = 300, 3, 1500
OFF = "water=off,lamp=off,exposure=off,vignetting=off,caustics=off,moving_objects=off"
ROWS = {
    "planned": "moving_objects=off",
    "nothing": OFF,
    "attenuation": OFF.replace("water=off", "attenuation=on,backscatter=off"),
    "attenuation, backscatter": OFF.replace("water=off", "water=on"),
    "lamp": OFF.replace("lamp=off", "lamp=on"),
    "exposure": OFF.replace("exposure=off", "exposure=on"),
    "vignetting": OFF.replace("vignetting=off", "vignetting=on"),
    "caustics": OFF.replace("caustics=off", "caustics=on"),
    "moving objects": OFF.replace("moving_objects=off", "moving_objects=on"),
    "all": f"water=on,{ALL}",
    "all and semantics": f"water=on,{ALL},semantics=on",
}
AIR = {"planned": "", "all": ROWS["all"]}


def measured(scene: Path, effects: str) -> dict[str, float]:
    """Return the least mean milliseconds of FEATURES_EVERY iterations (features are learned in one) and test PSNR."""
    times: list[float] = []

    def watch(trainer: Trainer) -> None:
        iterate = trainer.iterate

        def timed() -> float:
            started = time.perf_counter()
            loss = iterate()
            times.append(1000 * (time.perf_counter() - started))
            return loss

        trainer.iterate = timed  # type: ignore[method-assign]

    settings = TrainSettings(iterations=ITERATIONS, width=320, max_gaussians=20_000, effects=effects)
    with tempfile.TemporaryDirectory() as folder:
        metrics = train_with(scene, Path(folder) / "run", settings, watch)["metrics"]
    last = np.array(times[-(len(times) // 3 // FEATURES_EVERY * FEATURES_EVERY) :])
    milliseconds = float(last.reshape(-1, FEATURES_EVERY).mean(1).min())
    return {"ms": round(milliseconds, 2), "test_psnr": round(metrics["test_psnr"], 2)}


def in_air() -> dict[str, dict[str, float]]:
    """Measure processor ms per iteration and test PSNR on the street in air, as planned and with all effects."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in AIR}
    with tempfile.TemporaryDirectory() as folder:
        settings = settings_for(Path(folder) / "street", seed=7, water=Water(**SKY))
        make_scene(settings, rendered(Path(folder), "walk", 7))
        for seed in range(3):
            for name, runs in found.items():
                wanted = TrainSettings(
                    iterations=AIR_ITERATIONS, width=320, max_gaussians=20_000, effects=AIR[name], seed=seed
                )
                started = time.process_time()
                metrics = train(settings.out, Path(folder) / f"{name}-{seed}", wanted)["metrics"]
                runs.append((1000 * (time.process_time() - started) / AIR_ITERATIONS, metrics["test_psnr"]))
    means = {name: [sum(column) / len(runs) for column in zip(*runs, strict=True)] for name, runs in found.items()}
    return {name: {"cpu_ms": round(ms, 2), "test_psnr": round(psnr, 2)} for name, (ms, psnr) in means.items()}


def main() -> None:
    """Measure every scene and write the results."""
    scenes = [Path(name) for name in sys.argv[1:]] or [DEMO]
    document = {}
    for scene in scenes:
        camera = load_scene(scene).views[0].camera.resized(320)
        rounds = [{name: measured(scene, effects) for name, effects in ROWS.items()} for _ in range(ROUNDS)]
        rows = {name: min((runs[name] for runs in rounds), key=lambda run: run["ms"]) for name in ROWS}
        costs = measured_costs(camera.width, camera.height)
        document[scene.name] = {"rows": rows, "plan_ms": {name: round(cost, 2) for name, cost in costs.items()}}
        for name, row in rows.items():
            print(f"{scene.name}  {name:<26} {row['ms']:7.2f} ms  {row['test_psnr']:.2f} dB", flush=True)
        print({name: round(cost, 2) for name, cost in costs.items() if cost})
    air = in_air()
    print("street in air", air)
    lengths = {"iterations": ITERATIONS, "air_iterations": AIR_ITERATIONS}
    write_results("effects_training", lengths | {"scenes": document, "street in air": air})


if __name__ == "__main__":
    main()
