"""Measure levels of detail: PSNR against the number of splats, and what other ways of making fewer splats reach.

Run: `python benchmarks/survey_levels.py [--runs FOLDER]`; runs in FOLDER/demo and FOLDER/japanese_gardens are used
Results: benchmarks/results/survey_levels.json

Each scene is trained once. Each way makes levels of a quarter of the splats of the one before, which are scored on the
test images against the photos, and against pictures of level 0.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np

from benchmarks.common import DEMO, SHARED, machine, write_results
from swag_engine.evaluation.metrics import mean, psnr_from_mse, render_image, score_image
from swag_engine.experiments.evaluate_run import load_run
from swag_engine.formats.ply import ply_size
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.scene.split import split_views
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.splats import Splats
from swag_engine.survey.levels import GROUP, coarser, merged
from swag_engine.training.trainer import train

SCENES = {"demo": (DEMO, 40_000), "japanese_gardens": (SHARED / "japanese_gardens", 60_000)}
"""Scenes, and the largest number of Gaussians of their runs."""
ITERATIONS, WIDTH = 800, 320
LEVELS = 3
"""Levels besides level 0."""

Grouping = Callable[[Splats, int], np.ndarray]


def halves(splats: Splats, count: int) -> np.ndarray:
    """Group splats by halving them at the median of the longest axis of their positions, again and again."""
    groups = np.zeros(len(splats), np.int64)
    waiting, found = [(np.arange(len(splats)), count)], 0
    while waiting:
        part, wanted = waiting.pop()
        if wanted == 1:
            groups[part] = found
            found += 1
            continue
        axis = np.ptp(splats.positions[part], axis=0).argmax()
        part = part[np.argsort(splats.positions[part, axis], kind="stable")]
        middle = len(part) * (wanted // 2) // wanted
        waiting += [(part[:middle], wanted // 2), (part[middle:], wanted - wanted // 2)]
    return groups


def cells(splats: Splats, count: int) -> np.ndarray:
    """Group splats by the cubes of the grid that has about `count` cubes with splats."""
    low, high = 1e-6, 1e6
    for _ in range(40):
        edge = np.sqrt(low * high)
        groups = np.unique(np.floor(splats.positions / edge), axis=0, return_inverse=True)[1].ravel()
        low, high = (edge, high) if groups.max() + 1 > count else (low, edge)
    return groups


def grouped(grouping: Grouping) -> Callable[[Splats], Splats]:
    """Return a function that makes the next level by a grouping."""
    return lambda splats: merged(splats, grouping(splats, -(-len(splats) // GROUP)))


def dropped(size: float) -> Callable[[Splats], Splats]:
    """Return a function that keeps a random quarter of splats, of which the scales are multiplied by `size`."""

    def drop(splats: Splats) -> Splats:
        kept = splats.subset(np.random.default_rng(0).permutation(len(splats))[: -(-len(splats) // GROUP)])
        return replace(kept, scales=(kept.scales * size).astype(np.float32))

    return drop


WAYS: dict[str, Callable[[Splats], Splats]] = {
    "nearest in position and color": coarser,
    "halves along the longest axis": grouped(halves),
    "cubes of a grid": grouped(cells),
    "random dropping, twice the size": dropped(2.0),
    "random dropping": dropped(1.0),
}


def measure(run: Path) -> dict[str, Any]:
    """Score the levels of a run."""
    scene_folder, settings, _ = RunFolder(run).read_config()
    model = load_run(run)
    scene = load_scene(scene_folder)
    test = split_views([view.name for view in scene.views]).test
    images = load_images(scene, [view for view in scene.views if view.name in test], settings.width)
    background = model.cloud.background.sigmoid().tolist()

    def pictures(splats: Splats) -> list[Any]:
        cloud = GaussianCloud.from_splats(splats, background)
        return [render_image(cloud, image.camera, settings.sh_degree, effects=model.effects) for image in images]

    def psnr(shown: list[Any]) -> float:
        return mean([score_image(image, picture).psnr for image, picture in zip(images, shown, strict=True)])

    finest = model.cloud.to_splats()
    first = pictures(finest)
    row = {"splats": len(finest), "bytes": ply_size(run, finest), "psnr": psnr(first)}
    result: dict[str, Any] = {"level_0": row, "ways": {}}
    for name, make in WAYS.items():
        started, splats, rows = time.process_time(), finest, []
        for _ in range(LEVELS):
            splats = make(splats)
            shown = pictures(splats)
            against = mean([psnr_from_mse(float(((a - b) ** 2).mean())) for a, b in zip(shown, first, strict=True)])
            size = ply_size(run, splats)
            rows.append({"splats": len(splats), "bytes": size, "psnr": psnr(shown), "psnr_level_0": against})
        result["ways"][name] = {"levels": rows, "processor_seconds": round(time.process_time() - started, 1)}
        print(f"{name}: " + ", ".join(f"{row['splats']} splats {row['psnr']:.2f} dB" for row in rows), flush=True)
    return result


def main() -> None:
    """Train where there is no run, measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path)
    with tempfile.TemporaryDirectory() as scratch:
        runs = parser.parse_args().runs or Path(scratch)
        result = {}
        for name, (scene, gaussians) in SCENES.items():
            if not scene.exists():
                continue
            if not (runs / name / "metrics.json").exists():
                settings = TrainSettings(iterations=ITERATIONS, width=WIDTH, max_gaussians=gaussians)
                train(scene, runs / name, settings)
            print(name, flush=True)
            result[name] = measure(runs / name)
    write_results("survey_levels", {"machine": machine(), "iterations": ITERATIONS, "width": WIDTH, "scenes": result})


if __name__ == "__main__":
    main()
