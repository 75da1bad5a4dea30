"""What each effect costs in a training, beside what the plan says it costs; and a planned run against all effects on.

    python benchmarks/effects_training.py [SCENE ...]    prints a table, writes benchmarks/results/effects_training.json

Runs of ITERATIONS at 320 pixels with 20 000 Gaussians at most, all rows in turns, ROUNDS times; milliseconds are of
the four iterations in turn that took least in the last thirds, so that another process' load weighs little. Without
SCENE: the demo scene. At the end a street in air, of which the plan says that it has no effects: planned and all on in
turns, three seeds, processor time of whole runs of AIR_ITERATIONS (those of draft) by their iterations.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "scenes")]

from benchmarks.effects_matrix import SKY
from swag_engine.experiments.ablate import ALL
from swag_engine.planning.plan import measured_costs
from swag_engine.scene.colmap import load_scene
from swag_engine.semantics.assign import EVERY
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import Trainer, train
from tests.scenes.effect_scenes import rendered, settings_for
from tests.scenes.make_scene import Water, make_scene
from tests.scenes.runs import train_with

ITERATIONS, ROUNDS, AIR_ITERATIONS = 300, 3, 1500
OFF = "water=off,lamp=off,exposure=off,caustics=off,moving_objects=off"
ROWS = {
    "planned": "moving_objects=off",
    "nothing": OFF,
    "attenuation": OFF.replace("water=off", "attenuation=on,backscatter=off"),
    "attenuation, backscatter": OFF.replace("water=off", "water=on"),
    "lamp": OFF.replace("lamp=off", "lamp=on"),
    "exposure": OFF.replace("exposure=off", "exposure=on"),
    "caustics": OFF.replace("caustics=off", "caustics=on"),
    "moving objects": OFF.replace("moving_objects=off", "moving_objects=on"),
    "all": f"water=on,{ALL}",
    "all, and names": f"water=on,{ALL},semantics=on",
}
AIR = {"planned": "", "all": ROWS["all"]}


def measured(scene: Path, effects: str) -> dict[str, float]:
    """Least milliseconds of an iteration, mean of EVERY in turn (names are learned in one of them), and test PSNR."""
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
    last = np.array(times[-(len(times) // 3 // EVERY * EVERY) :])
    milliseconds = float(last.reshape(-1, EVERY).mean(1).min())
    return {"ms": round(milliseconds, 2), "test_psnr": round(metrics["test_psnr"], 2)}


def in_air() -> dict[str, dict[str, float]]:
    """Milliseconds of processor time an iteration and test PSNR, planned and with all effects, where there are none."""
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
    scenes = [Path(name) for name in sys.argv[1:]] or [ROOT / "tests" / "scenes" / "reef_wreck"]
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
    path = ROOT / "benchmarks" / "results" / "effects_training.json"
    path.write_text(json.dumps(lengths | {"scenes": document, "street in air": air}, indent=1) + "\n")


if __name__ == "__main__":
    main()
