"""Compare maps and changes of trained surveys with the known seabed that they show.

Run: `python benchmarks/products.py FOLDER [--iterations 1500] [--seeds 0 1 2] [--only air "same water and path"]`
Results: benchmarks/results/products.json

For each seed, photos of a seabed of known heights, labels and scale (tests/scenes/seabed.py) are written to FOLDER in
four kinds of water and trained there. The scale is measured from the coded targets, the axes from the places of their
middles. Labels are learned from masks of the training photos. Later surveys, in which three corals are gone, one has
grown by 10 % and a bank of sand has moved, are compared with the survey in ocean water, in air or under a lamp; `every
pair` compares each two surveys of a seed. Seed 0 is the seabed of the documentation; others move what lies on it and
have another texture, other noise and other initial values.

The run can be stopped at any time and started again with the same FOLDER: a training continues from its newest
checkpoint, and what is trained and labelled is not made again. Figures replace those of the same seed and name in the
results, so that seeds and surveys can be run one at a time.
"""

import json
import shutil
import sys
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import RESULTS, write_results
from swag_engine.experiments.label_run import label_run
from swag_engine.formats.run_folder import RunFolder
from swag_engine.georeference.measure import Measurements, scale_scene
from swag_engine.products.areas import make_areas
from swag_engine.products.change import make_change
from swag_engine.products.dem import make_dem, read_heights
from swag_engine.products.geotiff import read_map
from swag_engine.products.grid import MapGrid
from swag_engine.products.heights import gradients
from swag_engine.semantics.labels import read_labels
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.seabed import (
    AIR,
    CELL,
    COAST,
    EXTENT,
    LABELS,
    LAMP,
    MARGIN,
    METRES_PER_UNIT,
    OCEAN,
    TARGET_SIZE,
    WATERS,
    Seabed,
    write_survey,
)

PIXEL = 0.01
"""Edge of a pixel, metres."""
BOX = (-EXTENT[0] / 2, -EXTENT[1] / 2, EXTENT[0] / 2, EXTENT[1] / 2)
MOST_PATCH_ERROR = 0.05
"""Relative error of the area of a patch above which it counts as wrong."""
LEAST_PATCH = 400
"""Pixels of the smallest patch whose area is compared."""
LEAST_CHANGE = 20
"""Pixels of the smallest change that must be found."""
DIGITS = 4
"""Decimal places of written figures."""
SLACK = 3
"""Pixels around a true change within which a found one belongs to it."""
PAIRS: dict[str, dict[str, Any]] = {
    "same water and path": {"water": OCEAN, "seed": 1},
    "other water, light and path": {"water": COAST, "turned": True, "light": 0.8, "seed": 2},
    "nothing changed; other water, light and path": {"water": COAST, "turned": True, "light": 0.8, "seed": 3},
    "in air; other light and path": {"water": AIR, "turned": True, "light": 0.8, "seed": 4},
    "under a lamp; other path": {"water": LAMP, "turned": True, "seed": 5},
}
"""Later surveys."""
EVERY_PAIR = "every pair"
EARLIER = {"in air; other light and path": "air", "under a lamp; other path": "lamp"}
"""Surveys that later ones are compared with; "ocean" where none is given."""


def trained(folder: Path, bed: Seabed, settings: TrainSettings, **options: Any) -> tuple[Path, dict[str, Any]]:
    """Do what is left of writing, measuring, training and labelling a survey; return its run and its scale document."""
    scene, run = folder / "scene", folder / "run"
    if not (scene / "points.csv").exists():  # the last file of a survey
        shutil.rmtree(scene, ignore_errors=True)
        write_survey(scene, bed, **options)
    if not (scene / "scale.json").exists():
        known = Measurements(targets="aruco_4x4_50", size=TARGET_SIZE, points=scene / "points.csv")
        scale_scene(scene, known)
    if not RunFolder(run).finished():
        train(scene, run, settings, resume=run.exists())
    if not (run / "labels.json").exists():
        label_run(run, (), scene / "labels")
    return run, json.loads((scene / "scale.json").read_text())


def truth(bed: Seabed, grid: MapGrid) -> tuple[np.ndarray, np.ndarray]:
    """True heights (H, W) and labels (H, W) at the middles of pixels."""
    x = grid.left + grid.pixel * (np.arange(grid.width) + 0.5)
    y = grid.top - grid.pixel * (np.arange(grid.height) + 0.5)
    xs, ys = np.meshgrid(x, y)
    heights, labels, _ = bed.fields
    return bed.sample(heights, xs, ys), bed.sample(labels, xs, ys, cv2.INTER_NEAREST)


def survey_figures(run: Path, scale: dict[str, Any], bed: Seabed, out: Path) -> dict[str, Any]:
    """Compare scale, heights and areas of a survey with the truth.

    True areas are those of the cells of the seabed, which are smaller than the pixels of the map. Each patch has its
    label, its true number of pixels, and the relative error of its area.
    """
    make_dem(run, out / "dem.tif", PIXEL, BOX)
    areas = make_areas(run, out / "areas", PIXEL, BOX)
    grid = MapGrid(**areas["grid"])
    heights, labels = truth(bed, grid)
    errors = read_heights(out / "dem.tif") - heights
    errors = errors[np.isfinite(errors)]
    numbers = {entry["name"]: entry["id"] for entry in read_labels(run)}
    mapped = read_map(out / "areas" / "labels.tif").values
    found = np.zeros_like(mapped)
    for number, name in enumerate(LABELS, start=1):
        found[mapped == numbers[name]] = number
    rows = {row["name"]: row for row in areas["labels"]}
    margin = round(MARGIN / CELL)
    cells = [field[margin:-margin, margin:-margin] for field in bed.fields[:2]]
    slopes = gradients(cells[0].astype(np.float64), CELL, 1, cells[1])
    surface = np.nan_to_num(np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2), nan=1.0)
    figures: dict[str, Any] = {
        "scale_error": scale["metres_per_unit"] / METRES_PER_UNIT - 1,
        "height_median_error": float(np.median(np.abs(errors))) / PIXEL,
        "height_p95_error": float(np.quantile(np.abs(errors), 0.95)) / PIXEL,
        "agreement": float((found == labels).mean()),
        "areas": {},
        "patches": 0,
        "wrong_patches": 0,
    }
    for number, name in enumerate(LABELS, start=1):
        mine = cells[1] == number
        true = int(mine.sum()) * CELL**2
        row = rows[name]
        figures["areas"][name] = {
            "error": row["planar_area"] / true - 1,
            "surface_error": row["surface_area"] / (float(surface[mine].sum()) * CELL**2) - 1,
            "corrected_error": row["planar_corrected"] / true - 1,
            "in_interval": bool(row["planar_low"] <= true <= row["planar_high"]),
        }
    for number in range(2, len(LABELS) + 1):
        count, parts, stats, _ = cv2.connectedComponentsWithStats((cells[1] == number).astype(np.uint8))
        for part in range(1, count):
            size = int(stats[part, cv2.CC_STAT_AREA]) * (CELL / PIXEL) ** 2
            if size > LEAST_PATCH:
                near = cv2.dilate((parts == part).astype(np.uint8), np.ones((31, 31)))
                near = cv2.resize(near, found.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
                pixels = int(((found == number) & near).sum())
                figures["patches"] += 1
                figures["wrong_patches"] += abs(pixels / size - 1) > MOST_PATCH_ERROR
    return figures


def true_changes(before: Seabed, after: Seabed, grid: MapGrid) -> list[np.ndarray]:
    """Masks of the connected places whose height differs by a pixel or whose label differs."""
    (first, first_labels), (second, second_labels) = truth(before, grid), truth(after, grid)
    difference = second - first
    masks = []
    for mask in (
        difference > PIXEL,
        difference < -PIXEL,
        (first_labels != second_labels) & (np.abs(difference) <= PIXEL),
    ):
        count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
        masks += [parts == part for part in range(1, count) if stats[part, cv2.CC_STAT_AREA] > LEAST_CHANGE]
    return masks


def change_figures(first: Path, second: Path, before: Seabed, after: Seabed, out: Path) -> dict[str, Any]:
    """Compare the changes that are found between two surveys with the true ones."""
    answer = make_change(first, second, out, PIXEL, BOX)
    flags = read_map(out / "changed.tif").values
    grid = MapGrid(BOX[0], BOX[3], PIXEL, flags.shape[1], flags.shape[0])
    told = (flags > 0) & (flags != 255)
    expected = true_changes(before, after, grid)
    around = np.zeros(told.shape, np.uint8)
    for mask in expected:
        around |= cv2.dilate(mask.astype(np.uint8), np.ones((2 * SLACK + 1, 2 * SLACK + 1)))
    count, parts, stats, _ = cv2.connectedComponentsWithStats(told.astype(np.uint8), connectivity=8)
    invented = sum(
        stats[part, cv2.CC_STAT_AREA] > LEAST_CHANGE and not around[parts == part].any() for part in range(1, count)
    )
    return {
        "expected": len(expected),
        "compared": float((flags != 255).mean()),
        "found": int(sum(told[mask].sum() >= LEAST_CHANGE for mask in expected)),
        "invented": int(invented),
        "residual": answer["alignment"]["residual"] / PIXEL,
        "static": answer["alignment"]["static"],
        "scale": answer["alignment"]["scale"],
        "height_limit": answer["height_noise"] / PIXEL,
    }


def compare(
    folder: Path, seed: int, settings: TrainSettings, only: Sequence[str]
) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Write, train and compare the surveys of a seed.

    Yields:
        `surveys`, `changes` or `pairs`, a name, and the figures.
    """
    bed = Seabed.scattered(seed) if seed else Seabed()

    def survey(name: str) -> tuple[Path, dict[str, Any]]:
        return trained(folder / name, bed, replace(settings, seed=seed), water=WATERS[name], seed=10 * seed)

    for name in WATERS:
        if name in only:
            run, scale = survey(name)
            metrics = json.loads(RunFolder(run).metrics.read_text())
            figures = survey_figures(run, scale, bed, folder / name / "maps")
            yield "surveys", name, {"test_psnr": metrics["test_psnr"]} | figures
    for name, changes in PAIRS.items():
        if name in only:
            after = bed if name.startswith("nothing") else bed.changed()
            place = folder / f"later-{changes['seed']}"
            options = changes | {"seed": 10 * seed + changes["seed"]}
            run, _ = trained(place, after, replace(settings, seed=options["seed"]), **options)
            before, _ = survey(EARLIER.get(name, "ocean"))
            yield "changes", name, change_figures(before, run, bed, after, place / "change")
    if EVERY_PAIR in only:
        yield "pairs", EVERY_PAIR, compare_every_pair(folder, bed)


def compare_every_pair(folder: Path, bed: Seabed) -> dict[str, dict[str, int]]:
    """Compare each two trained surveys of a seed, those that were made after the changes as the later ones.

    Args:
        folder: Folder of the seed's surveys.
        bed: The seabed before the changes.

    Returns:
        For pairs of one kind of light, and for those of a lamp with daylight: numbers of pairs, of true changes, of
        found ones and of invented ones.
    """
    places = {name: name for name in WATERS} | {
        name: f"later-{later['seed']}" for name, later in PAIRS.items()
    }  # the folder of each survey
    unchanged = [name for name in places if name in WATERS or name.startswith("nothing")]
    changed = [name for name in places if name not in unchanged]
    kinds = ("one kind of light", "a lamp and daylight")
    totals = {kind: dict.fromkeys(("pairs", "expected", "found", "invented"), 0) for kind in kinds}
    for first, second in [*combinations(unchanged, 2), *product(unchanged, changed)]:
        lamps = ["lamp" in name for name in (first, second)]
        after = bed.changed() if second in changed else bed
        runs = [folder / places[name] / "run" for name in (first, second)]
        figures = change_figures(runs[0], runs[1], bed, after, folder / "pair")
        total = totals[kinds[lamps[0] != lamps[1]]]
        total["pairs"] += 1
        total["expected"] += figures["expected"]
        total["found"] += figures["found"]
        total["invented"] += figures["invented"]
    return totals


def main() -> None:
    """Write, train and compare the chosen surveys."""
    names = [*WATERS, *PAIRS, EVERY_PAIR]
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    options = parser.parse_args()
    settings = TrainSettings(iterations=options.iterations, width=480, max_gaussians=45_000)
    for seed in options.seeds:
        for kind, name, figures in compare(options.folder / f"seed-{seed}", seed, settings, options.only):
            document = json.loads((RESULTS / "products.json").read_text())  # other parts may run at the same time
            found = document["seeds"].setdefault(str(seed), {}).setdefault(kind, {})
            found[name] = json.loads(json.dumps(figures), parse_float=lambda text: round(float(text), DIGITS))
            print(seed, name, json.dumps(found[name]), flush=True)
            write_results("products", document | {"settings": settings.to_json(), "pixel": PIXEL})


if __name__ == "__main__":
    main()
