"""What each use of regions in a training is worth: held-out PSNR and floaters, three scenes, three seeds.

    python benchmarks/guidance.py            prints tables, writes benchmarks/results/guidance.json

Scenes that are not on this machine are left out. Regions are the demo's own masks, and those of `saliency` elsewhere.
Runs that the results hold already are not made again.
"""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.train_scenes import processor  # noqa: E402
from swag_engine.evaluation.metrics import floater_mass  # noqa: E402
from swag_engine.scene.colmap import load_scene  # noqa: E402
from swag_engine.scene.images import load_images  # noqa: E402
from swag_engine.scene.split import split_views  # noqa: E402
from swag_engine.strict_json import to_json  # noqa: E402
from swag_engine.training.checkpoint import load_checkpoint  # noqa: E402
from swag_engine.training.config import TrainSettings  # noqa: E402
from swag_engine.training.loop import cloud_from_tensors, median_range, train  # noqa: E402

SHARED = ROOT.parent / "shared" / "data"
SCENES = {
    "demo": ROOT / "tests" / "scenes" / "reef_wreck",
    "japanese_gardens": SHARED / "japanese_gardens",
    "aqualoc_amphorae": SHARED / "aqualoc_amphorae",
}
SWITCHES = {
    "off": "",
    "open-water": "open-water=on",
    "salient-growth": "salient-growth=on",
    "class-pruning": "class-pruning=on",
    "salient-pixels": "salient-pixels=on",
    "reallocation": "reallocation=on",
    "salient-growth, reallocation": "salient-growth=on,reallocation=on",
}
SETTINGS = TrainSettings(iterations=1000, width=320, max_gaussians=20_000)
SEEDS = 3
RESULTS = ROOT / "benchmarks" / "results" / "guidance.json"
FIGURES = {"psnr": "validation PSNR", "test_psnr": "test PSNR", "floater_mass": "floaters", "seconds": "seconds"}


def main() -> None:
    document: dict[str, Any] = {"machine": processor(), "settings": SETTINGS.to_json(), "runs": []}
    if RESULTS.exists():
        document = json.loads(RESULTS.read_text())
    known = {(run["scene"], run["switch"], run["seed"]) for run in document["runs"]}
    for seed in range(SEEDS):
        for switch in SWITCHES:
            for scene in SCENES:
                if SCENES[scene].is_dir() and (scene, switch, seed) not in known:
                    figures = figures_of(SCENES[scene], SWITCHES[switch], seed)
                    document["runs"].append({"scene": scene, "switch": switch, "seed": seed} | figures)
                    RESULTS.write_text(to_json(document, indent=1) + "\n")
                    print(document["runs"][-1], file=sys.stderr, flush=True)
    print(tables(document["runs"]))


def figures_of(scene_folder: Path, effects: str, seed: int) -> dict[str, Any]:
    """Train once; validation and test PSNR in dB, floater mass over the test views, seconds, what the run says."""
    with tempfile.TemporaryDirectory() as folder:
        metrics = train(scene_folder, Path(folder) / "run", replace(SETTINGS, effects=effects, seed=seed))["metrics"]
        loaded = load_checkpoint(Path(folder) / "run")
    assert loaded is not None
    cloud, scene = cloud_from_tensors(loaded[0]), load_scene(scene_folder)
    split = split_views([view.camera.name for view in scene.views])
    images = {image.camera.name: image for image in load_images(scene, scene.views, SETTINGS.width)}
    test = [images[name].camera for name in split.test]
    length = median_range(scene, [images[name] for name in split.train])
    kept = {name: metrics[name] for name in ("psnr", "test_psnr", "seconds", "gaussians", "notes")}
    return kept | {"floater_mass": floater_mass(cloud, test, length)}


def tables(runs: list[dict[str, Any]]) -> str:
    """A Markdown table a scene: the switch off, and what each changes against it with the same seeds."""
    lines = []
    for scene in SCENES:
        lines += [f"### {scene}", "", "| switch | " + " | ".join(FIGURES.values()) + " | seeds |"]
        lines += ["|---" * (len(FIGURES) + 2) + "|"]
        off = {run["seed"]: run for run in runs if run["scene"] == scene and run["switch"] == "off"}
        for switch in SWITCHES:
            found = [run for run in runs if run["scene"] == scene and run["switch"] == switch and run["seed"] in off]
            if not found:
                continue
            cells = []
            for name in FIGURES:
                own = np.array([run[name] for run in found])
                change = own - np.array([off[run["seed"]][name] for run in found])
                shown = own if switch == "off" else change
                spread = f" ± {shown.std(ddof=1):.2f}" if len(found) > 1 and "psnr" in name else ""
                sign = "" if switch == "off" else "+"
                unit = f"{100 * shown.mean():{sign}.1f} %" if name == "floater_mass" else f"{shown.mean():{sign}.2f}"
                cells.append(unit + spread)
            lines.append(f"| {switch} | " + " | ".join(cells) + f" | {len(found)} |")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
