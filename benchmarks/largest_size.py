"""Measure what the largest size of Gaussians gives and costs: novel views, heights, and colors without water.

Run: `python benchmarks/largest_size.py FOLDER [--sizes 1e9 0.5 0.1] [--only seabed "street, coast" "room, coast"]`
Results: benchmarks/results/largest_size.json, written after each run; runs that are in it are not repeated.

The seabed in ocean water is that of benchmarks/products.py, seen from above and from the side; street and room are
those of benchmarks/restored_colors.py. Scenes are rendered to FOLDER unless they are there.
"""

import itertools
import json
import sys
import tempfile
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import RESULTS, write_results
from benchmarks.products import BOX, PIXEL, truth
from benchmarks.restored_colors import make_scenes
from swag_engine.experiments.evaluate_run import evaluate_run
from swag_engine.gaussians import sizes
from swag_engine.georeference.measure import Measurements, scale_scene
from swag_engine.products.dem import make_dem, read_heights
from swag_engine.products.grid import MapGrid
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.seabed import OCEAN, TARGET_SIZE, Seabed, write_survey

SEABED, COLORS = "seabed", ("street, coast", "room, coast")
SETTINGS = {
    SEABED: TrainSettings(iterations=1500, width=480, max_gaussians=45_000),
    **dict.fromkeys(COLORS, TrainSettings(iterations=1000, width=320, max_gaussians=20_000)),
}
SEED, SEABED_SEED = 21, 1
"""Of the places; trainings have the seed 0 and that of the seabed."""


def scene_of(folder: Path, name: str, bed: Seabed) -> Path:
    """Return the folder of a scene."""
    if name != SEABED:
        return make_scenes(folder, [name], SEED)[name]
    scene = folder / name
    if not (scene / "scale.json").exists():
        write_survey(scene, bed, water=OCEAN, seed=10 * SEABED_SEED)
        scale_scene(scene, Measurements(targets="aruco_4x4_50", size=TARGET_SIZE, points=scene / "points.csv"))
    return scene


def figures(folder: Path, name: str, largest: float) -> dict[str, Any]:
    """Train a scene and measure its result; heights in pixels of the map."""
    bed = Seabed.scattered(SEABED_SEED)
    scene = scene_of(folder, name, bed)
    with tempfile.TemporaryDirectory() as place, mock.patch.object(sizes, "LARGEST", largest):
        run = Path(place) / "run"
        metrics = train(scene, run, replace(SETTINGS[name], seed=SEABED_SEED if name == SEABED else 0))["metrics"]
        found = {"psnr": metrics["test_psnr"], "psnr_by_view": [view["psnr"] for view in metrics["views"].values()]}
        if name == SEABED:
            make_dem(run, Path(place) / "dem.tif", PIXEL, BOX)
            heights = read_heights(Path(place) / "dem.tif")
            grid = MapGrid(BOX[0], BOX[3], PIXEL, heights.shape[1], heights.shape[0])
            errors = np.abs(heights - truth(bed, grid)[0]) / PIXEL
            found["height_median_error"], found["height_p95_error"] = np.nanquantile(errors, [0.5, 0.95]).tolist()
        else:
            found["delta_e"] = evaluate_run(run)["restored"]["delta_e"]
    return json.loads(json.dumps(found), parse_float=lambda text: round(float(text), 2))


def known_runs() -> list[dict[str, Any]]:
    """Return the runs that are in the results; other parts may run at the same time."""
    path = RESULTS / "largest_size.json"
    return json.loads(path.read_text(encoding="utf-8"))["runs"] if path.exists() else []


def main() -> None:
    """Make the runs that are missing."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sizes", type=float, nargs="+", default=[1e9, 0.5, 0.1])
    parser.add_argument("--only", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    options = parser.parse_args()
    for name, largest in itertools.product(options.only, options.sizes):
        key = {"scene": name, "largest": largest}
        if not any(key.items() <= row.items() for row in known_runs()):
            row = key | figures(options.folder, name, largest)
            write_results("largest_size", {"seeds": [SEED, SEABED_SEED], "runs": [*known_runs(), row]})
            print(row, flush=True)


if __name__ == "__main__":
    main()
