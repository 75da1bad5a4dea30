"""Measure which pairs of photos of a large survey are matched, and the processor time it takes.

Run: `python benchmarks/camera_pairs.py`
Results: benchmarks/results/camera_pairs.json

The photos are the first 250, 500 and 1000 of a generated lawn-mower survey straight down, of lanes of 40 photos that
overlap by two thirds along a lane and by half between lanes. Pairs are judged by the true cameras.
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.cameras import processor_seconds
from benchmarks.common import machine, write_results
from swag_engine.scene.colmap_library import pycolmap
from swag_engine.sfm.features import ImageData, extract_features, match_features
from swag_engine.sfm.photos import copy_name, equalise, write_jpeg
from tests.scenes.camera_paths import CameraScene, make_camera_scene

SIZES = (250, 500, 1000)
"""Numbers of photos."""
LANE = 40
"""Photos of a lane."""
CLOSE = 1.5
"""Largest distance in metres of photos that surely overlap, of 2.7 x 1.8 m each."""
FAR = 3.3
"""Distance in metres from which on photos cannot overlap."""


def main() -> None:
    """Make the photos, detect their features once, and match each number of them."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        made = make_camera_scene("large survey", folder / "images")
        names = list(made.names)
        before = processor_seconds()
        (folder / "pictures").mkdir()
        for number, name in enumerate(names):
            grey = cv2.imread(str(made.folder / name), cv2.IMREAD_GRAYSCALE)
            write_jpeg(folder / "pictures" / copy_name(number), equalise(grey))
        images = [ImageData.read(made.folder / name) for name in names]
        extract_features(folder / "features.db", folder / "pictures", images)
        features = processor_seconds() - before
        rows = []
        for size in SIZES:
            (folder / str(size)).mkdir()
            database = Path(shutil.copy(folder / "features.db", folder / str(size) / "database.db"))
            before = processor_seconds()
            pairs = match_features(database, images[:size], lambda count: None)
            seconds = round(processor_seconds() - before, 1)
            rows.append({"images": size, "pairs": pairs, "processor_seconds": seconds} | judged(database, made, size))
            print(json.dumps(rows[-1]), flush=True)
    document = {"machine": machine(), "feature_seconds_per_image": features / len(names), "rows": rows}
    write_results("camera_pairs", document)


def judged(database: Path, made: CameraScene, size: int) -> dict[str, Any]:
    """Compare the verified pairs with the true cameras.

    Returns:
        `verified`: number of pairs with a verified geometry; `wrong`: those of them that cannot overlap;
        `lane_neighbours`: fraction of the photos with a close photo in a neighbouring lane that are matched with one.
    """
    numbers = {copy_name(number): number for number in range(size)}
    with pycolmap.Database.open(str(database)) as opened:
        of_id = {image.image_id: numbers.get(image.name) for image in opened.read_all_images()}
        ids, counts = opened.read_two_view_geometry_num_inliers()
    pairs = [pycolmap.pair_id_to_image_pair(each) for each, count in zip(ids, counts, strict=True) if count >= 15]
    verified = np.array([[of_id[a], of_id[b]] for a, b in pairs])
    distance = np.linalg.norm(made.centres[:size, None] - made.centres[None, :size], axis=2)
    lane = np.arange(size) // LANE
    across = (np.abs(lane[:, None] - lane) == 1) & (distance < CLOSE)
    matched = np.zeros((size, size), bool)
    matched[verified[:, 0], verified[:, 1]] = matched[verified[:, 1], verified[:, 0]] = True
    expected = across.any(1)
    return {
        "verified": len(verified),
        "wrong": int((distance[verified[:, 0], verified[:, 1]] > FAR).sum()),
        "lane_neighbours": float((across & matched).any(1)[expected].mean()),
    }


if __name__ == "__main__":
    main()
