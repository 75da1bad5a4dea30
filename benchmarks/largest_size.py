"""Measure what the largest size of Gaussians gives and costs: novel views, heights, and colors without water.

Run: `python benchmarks/largest_size.py FOLDER [--limits "by light" 0.5 0.05] [--only seabed "street, coast"]`
Results: benchmarks/results/largest_size.json, written after each run; runs that are in it are not repeated.

The seabeds are those of benchmarks/products.py, seen from above and from the side; street and room are those of
benchmarks/restored_colors.py. Scenes are rendered to FOLDER unless they are there. aqualoc_amphorae lies in
../shared/data: its light fades, and nothing says why.
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

from benchmarks.common import RESULTS, SHARED, write_results
from benchmarks.products import BOX, PIXEL, truth
from benchmarks.restored_colors import make_scenes
from swag_engine.experiments.evaluate_run import evaluate_run
from swag_engine.gaussians import sizes
from swag_engine.georeference.measure import Measurements, scale_scene
from swag_engine.products.dem import make_dem, read_heights
from swag_engine.products.grid import MapGrid
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.seabed import AIR, OCEAN, TARGET_SIZE, Seabed, write_survey

SEABEDS = {"seabed": OCEAN, "seabed, air": AIR}
COLORS = ("street, coast", "room, coast")
REAL = "aqualoc_amphorae"
SETTINGS = {
    **dict.fromkeys(SEABEDS, TrainSettings(iterations=1500, width=480, max_gaussians=45_000)),
    **dict.fromkeys((*COLORS, REAL), TrainSettings(iterations=1000, width=320, max_gaussians=20_000)),
}
LIMITS = {
    "by light": (sizes.LARGEST, sizes.LARGEST_HIDDEN),
    "none": (1e9, 1e9),
    "0.5": (0.5, 0.5),
    "0.05": (0.05, 0.05),
}
"""Limits where all light reaches the nearest camera, and where none does."""
SEED, SEABED_SEED = 21, 1
"""Of the places."""


def scene_of(folder: Path, name: str, bed: Seabed) -> Path:
    """Return the folder of a scene."""
    if name == REAL:
        return SHARED / REAL
    if name in COLORS:
        return make_scenes(folder, [name], SEED)[name]
    scene = folder / name
    if not (scene / "scale.json").exists():
        write_survey(scene, bed, water=SEABEDS[name], seed=10 * SEABED_SEED)
        scale_scene(scene, Measurements(targets="aruco_4x4_50", size=TARGET_SIZE, points=scene / "points.csv"))
    return scene


def figures(folder: Path, name: str, limit: str, seed: int) -> dict[str, Any]:
    """Train a scene and measure its result; heights in pixels of the map."""
    bed = Seabed.scattered(SEABED_SEED)
    scene = scene_of(folder, name, bed)
    limits = dict(zip(("LARGEST", "LARGEST_HIDDEN"), LIMITS[limit], strict=True))
    with tempfile.TemporaryDirectory() as place, mock.patch.multiple(sizes, **limits):
        run = Path(place) / "run"
        metrics = train(scene, run, replace(SETTINGS[name], seed=seed))["metrics"]
        found = {"psnr": metrics["test_psnr"]}
        if name in SEABEDS:
            make_dem(run, Path(place) / "dem.tif", PIXEL, BOX)
            heights = read_heights(Path(place) / "dem.tif")
            grid = MapGrid(BOX[0], BOX[3], PIXEL, heights.shape[1], heights.shape[0])
            errors = np.abs(heights - truth(bed, grid)[0]) / PIXEL
            found["height_median_error"], found["height_p95_error"] = np.nanquantile(errors, [0.5, 0.95]).tolist()
        elif name in COLORS:
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
    parser.add_argument("--limits", nargs="+", choices=LIMITS, default=list(LIMITS))
    parser.add_argument("--only", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    options = parser.parse_args()
    for seed, name, limit in itertools.product(options.seeds, options.only, options.limits):
        key = {"scene": name, "limit": limit, "seed": seed}
        if not any(key.items() <= row.items() for row in known_runs()):
            row = key | figures(options.folder, name, limit, seed)
            write_results("largest_size", {"runs": [*known_runs(), row]})
            print(row, flush=True)


if __name__ == "__main__":
    main()
