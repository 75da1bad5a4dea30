"""Measure how well training masks moving objects, and what the masks gain.

Run: `python benchmarks/moving_objects.py [--seeds 3]`
Results: benchmarks/results/moving_objects.json

One to three fish are painted into each of four of ten training images, or into none; test images stay without. The
motion masks of the run are compared with the painted fish.
"""

import json
import os
import shutil
import sys
import tempfile
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import write_results
from benchmarks.train_scenes import SCENES
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.split import split_views
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.trainer import train

WAYS = {"planned": "", "never": "moving_objects=off"}
SETTINGS = TrainSettings(iterations=1000, width=320, max_gaussians=20_000)
FISHY = 0.4
"""Fraction of the training images that have fish."""


def fish_in(shape: tuple[int, ...], random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw fish: their mask (H, W) bool and colors (H, W, 3) uint8."""
    height, width = shape[:2]
    mask, colors = np.zeros((height, width), np.uint8), np.zeros((height, width, 3), np.uint8)
    for _ in range(random.integers(1, 4)):
        at = random.uniform(0.1, 0.9, 2) * (width, height)
        length, turn = width * random.uniform(0.03, 0.07), random.uniform(-30, 30)
        color = random.uniform((20, 60, 60), (90, 190, 200))
        shapes = ((at, (length, 0.4 * length)), (at - (1.1 * length, 0), (0.35 * length, 0.35 * length)))
        for middle, axes in shapes:
            drawn = (tuple(map(round, middle)), tuple(map(round, axes)), turn, 0, 360)
            cv2.ellipse(mask, *drawn, 1, -1)
            cv2.ellipse(colors, *drawn, color.tolist(), -1)
    return mask > 0, colors


def made(scene: Path, folder: Path, fish: bool, seed: int) -> dict[str, np.ndarray]:
    """Copy the scene to `folder`, with fish or without; return the masks (H, W) bool by training image."""
    shutil.copytree(scene, folder, ignore=shutil.ignore_patterns("plan.json", "masks", "depth"))
    names = split_views([view.name for view in load_scene(folder).views]).train
    random = np.random.default_rng(seed)
    chosen = random.permutation(names)[: round(FISHY * len(names))] if fish else []
    swimming = {}
    for view in load_scene(folder).views:
        if view.name in chosen:
            pixels = cv2.imread(str(view.path))
            swimming[view.name], colors = fish_in(pixels.shape, random)
            pixels[swimming[view.name]] = colors[swimming[view.name]]
            cv2.imwrite(str(view.path), pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return swimming


def measured(scene: Path, swimming: dict[str, np.ndarray], effects: str, seed: int) -> dict:
    """Train, and compare the motion masks with the painted fish."""
    with tempfile.TemporaryDirectory() as place:
        metrics = train(scene, Path(place) / "run", replace(SETTINGS, effects=effects, seed=seed))["metrics"]
        tensors, _ = load_checkpoint(Path(place) / "run") or ({}, {})
    both = fish = masked = pixels = 0
    for view in load_scene(scene).views:
        height, width = round(view.camera.height * SETTINGS.width / view.camera.width), SETTINGS.width
        mask = np.zeros((height, width), bool)
        if (bits := tensors.get(f"moved.{view.name}")) is not None:
            mask = np.unpackbits(bits.numpy(), count=mask.size).reshape(mask.shape).astype(bool)
        true = swimming.get(view.name, np.zeros((1, 1), bool)).astype(np.uint8)
        true = cv2.resize(true, (width, height), interpolation=cv2.INTER_AREA) > 0
        both, fish, masked = both + int((true & mask).sum()), fish + int(true.sum()), masked + int(mask.sum())
        pixels += mask.size
    return {
        "on": "moving_objects" in metrics["effects"],
        "psnr": round(metrics["psnr"], 2),
        "test_psnr": round(metrics["test_psnr"], 2),
        "fish_masked": round(both / fish, 3) if fish else None,
        "mask_is_fish": round(both / masked, 3) if masked else None,
        "masked": round(masked / pixels, 4),
    }


def main() -> None:
    """Run every scene, seed and way and write the results."""
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    asked = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as place:
        os.environ["SWAG_CACHE_DIR"] = str(Path(place) / "cache")
        for name, scene in SCENES.items():
            if not scene.is_dir():
                continue
            for fish in (True, False):
                for seed in range(asked.seeds):
                    folder = Path(place) / f"{scene.name}-{fish}-{seed}"
                    swimming = made(scene, folder, fish, seed)
                    for way, effects in WAYS.items():
                        row = {"scene": name, "fish": fish, "way": way, "seed": seed}
                        rows.append(row | measured(folder, swimming, effects, seed))
                        print(json.dumps(rows[-1]), flush=True)
    write_results("moving_objects", {"settings": SETTINGS.to_json(), "rows": rows})


if __name__ == "__main__":
    main()
