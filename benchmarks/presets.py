"""Compare the presets with those of an earlier checkout: processor time and quality of the same scenes and seeds.

Run: `python benchmarks/presets.py EARLIER_CHECKOUT [--presets draft] [--seeds 0 1 2] [--generated FOLDER]
[--fractions .6 .8]`
Results: benchmarks/results/presets.json

Both checkouts take turns, each run in a process of its own with one thread. Runs that the results have already are not
repeated. `--fractions` also runs the present version with these fractions of its iterations: they show in which time it
has the quality of the earlier one. The kernels of the earlier checkout must be built (`python -m
swag_engine.kernels.build` there).
"""

import json
import os
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import DEMO, RESULTS, SHARED, machine, write_results

SCENES = {"demo": DEMO} | {name: SHARED / name for name in ("aqualoc_amphorae", "japanese_gardens")}
TRAIN = """
import json, sys, time
from pathlib import Path
import swag_engine.base.threads
from swag_engine.evaluation.metrics import mean_score, score_views
from swag_engine.rendering.model import SceneModel
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.settings.presets import PRESETS
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.trainer import train

try:
    from swag_engine.rendering.trained_detail import TrainedDetail
except ImportError:  # earlier versions render Gaussians as they are
    TrainedDetail = None

folder, out, preset, seed, iterations = sys.argv[1:]
settings = TrainSettings(preset=preset, seed=int(seed), iterations=int(iterations))
metrics = train(Path(folder), Path(out), settings)["metrics"]
figures = {"seconds": time.process_time(), "gaussians": metrics["gaussians"], "iterations": metrics["iterations"]}
scene, model = load_scene(Path(folder)), SceneModel.from_checkpoint(*load_checkpoint(Path(out)))
views = [view for view in scene.views if view.camera.name in metrics["views"]]
images = load_images(scene, views, PRESETS[preset].width)
cloud, width = model.cloud, json.loads((Path(out) / "config.json").read_text())["settings"]["width"]
detail = TrainedDetail and TrainedDetail.of_training(cloud.means, scene.training_cameras(width))
found = [
    score_views(detail.widened(cloud, image.camera) if detail else cloud, [image], 3, "auto", model.effects)[0]
    for image in images
]
psnr, _ = mean_score(found)
print(json.dumps(figures | {"psnr": psnr}))
"""
"""Trains a scene in whichever checkout is first on Python's path. Test images have the preset's largest width and are
rendered as a film of that width is: a run is smaller where photos resolve less, and a draft where other work slows the
machine."""


def generated_scenes(folder: Path) -> dict[str, Path]:
    """Return a survey in lanes and an orbit with fine texture by name; made in a folder unless they are there."""
    from tests.scenes.make_scene import Settings, make_scene
    from tests.scenes.seabed import OCEAN, Seabed, write_survey

    seabed, reef = folder / "seabed", folder / "reef_of_56_photos"
    if not seabed.exists():
        write_survey(seabed, Seabed(), water=OCEAN)
    if not reef.exists():  # ten minutes on two cores
        make_scene(Settings(reef, views=56, seed=31))
    return {"seabed": seabed, "reef of 56 photos": reef}


def run_once(checkout: Path, scene: Path, preset: str, seed: int, iterations: int = 0) -> dict[str, float]:
    """Train once.

    Args:
        checkout: Folder of the project.
        scene: Folder of the scene.
        preset: Name of the preset.
        seed: Seed of the run.
        iterations: Number of iterations; 0 for the preset's.

    Returns:
        Processor time of the process in seconds, test PSNR in dB, and the numbers of Gaussians and iterations.
    """
    with tempfile.TemporaryDirectory() as folder:
        arguments = (scene, Path(folder) / "run", preset, seed, iterations)
        command = [sys.executable, "-c", TRAIN, *map(str, arguments)]
        environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
        answer = subprocess.run(command, cwd=checkout, env=environment, check=True, capture_output=True, text=True)
    found = json.loads(answer.stdout.splitlines()[-1])
    return found | {"seconds": round(found["seconds"], 1), "psnr": round(found["psnr"], 3)}


def main() -> None:
    """Run what is missing, print and write the figures."""
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("earlier", type=Path)
    parser.add_argument("--presets", nargs="+", default=["draft"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--generated", type=Path, help="folder of two generated scenes, which are left out without it")
    parser.add_argument("--fractions", type=float, nargs="*", default=[])
    asked = parser.parse_args()
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=asked.earlier, check=True, capture_output=True, text=True
    ).stdout.strip()
    stored = RESULTS / "presets.json"
    scenes = SCENES | (generated_scenes(asked.generated) if asked.generated else {})
    rows: list[dict[str, Any]] = json.loads(stored.read_text("utf-8"))["rows"] if stored.exists() else []
    for seed in asked.seeds:
        for preset in asked.presets:
            for name, scene in scenes.items():
                key = {"preset": preset, "scene": name, "seed": seed}
                if any(key.items() <= row.items() for row in rows):
                    continue
                earlier, now = (run_once(root, scene, preset, seed) for root in (asked.earlier.resolve(), ROOT))
                lengths = [round(fraction * now["iterations"]) for fraction in asked.fractions]
                others = [run_once(ROOT, scene, preset, seed, iterations) for iterations in lengths]
                rows.append(key | {"earlier": earlier, "now": now} | ({"other lengths": others} if others else {}))
                print(rows[-1], flush=True)
                write_results("presets", {"machine": machine(), "earlier": commit, "rows": rows})


if __name__ == "__main__":
    main()
