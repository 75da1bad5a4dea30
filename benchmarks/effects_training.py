"""What each effect costs in a training, beside what the plan says it costs; and a planned run against all effects on.

    python benchmarks/effects_training.py [SCENE ...]    prints a table, writes benchmarks/results/effects_training.json

Runs of ITERATIONS at 320 pixels with 20 000 Gaussians at most, one after the other in one process; milliseconds are the
least of an iteration in the last third, so that another process' load weighs little. Without SCENE: the demo scene.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from swag_engine.effects.plan import measured_costs  # noqa: E402
from swag_engine.evaluation.ablate import ALL  # noqa: E402
from swag_engine.scene.colmap import load_scene  # noqa: E402
from swag_engine.training.config import TrainSettings  # noqa: E402
from swag_engine.training.loop import Trainer, train  # noqa: E402

ITERATIONS = 300
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
}


def measured(scene: Path, effects: str) -> dict[str, float]:
    """Least milliseconds of an iteration, and test PSNR."""
    times: list[float] = []
    step = Trainer.step

    def timed(trainer: Trainer) -> float:
        started = time.perf_counter()
        loss = step(trainer)
        times.append(1000 * (time.perf_counter() - started))
        return loss

    settings = TrainSettings(iterations=ITERATIONS, width=320, max_gaussians=20_000, effects=effects)
    Trainer.step = timed  # type: ignore[method-assign]
    try:
        with tempfile.TemporaryDirectory() as folder:
            metrics = train(scene, Path(folder) / "run", settings)["metrics"]
    finally:
        Trainer.step = step  # type: ignore[method-assign]
    milliseconds = min(times[len(times) * 2 // 3 :])
    return {"ms": round(milliseconds, 2), "test_psnr": round(metrics["test_psnr"], 2)}


def main() -> None:
    scenes = [Path(name) for name in sys.argv[1:]] or [ROOT / "tests" / "scenes" / "reef_wreck"]
    document = {}
    for scene in scenes:
        camera = load_scene(scene).views[0].camera.resized(320)
        rows = {name: measured(scene, effects) for name, effects in ROWS.items()}
        costs = measured_costs(camera.width, camera.height)
        document[scene.name] = {"rows": rows, "plan_ms": {name: round(cost, 2) for name, cost in costs.items()}}
        for name, row in rows.items():
            print(f"{scene.name}  {name:<26} {row['ms']:7.2f} ms  {row['test_psnr']:.2f} dB", flush=True)
        print({name: round(cost, 2) for name, cost in costs.items() if cost})
    path = ROOT / "benchmarks" / "results" / "effects_training.json"
    path.write_text(json.dumps({"iterations": ITERATIONS, "scenes": document}, indent=1) + "\n")


if __name__ == "__main__":
    main()
