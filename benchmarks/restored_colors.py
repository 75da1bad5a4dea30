"""Compare restored colors with methods for single photos, on scenes whose colors without water are known.

Run: `python benchmarks/restored_colors.py FOLDER [--seeds 11 21] [--scenes "demo" "reef, ocean" ...]`
Results: benchmarks/results/restored_colors.json and docs/images/restored_colors.webp

The scenes are rendered to FOLDER and trained there, unless they are there already. Rows of other scenes and seeds stay
in the results. Methods for single photos restore the photos of the test views, which training does not see, and so does
ours, with the water and the colors of the run; its renders of these views do not know the photo. All are compared where
the truth has a surface that a training view saw. How bright a place is that a lamp at the camera lights has no true
value: there each method gets the one exposure that suits its images best. Scenes without compression have PNG files as
photos, the others JPEG files of the same size.
"""

import json
import sys
from argparse import ArgumentParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.color_methods import best_gain, clahe, grey_world, hue_error, sea_thru, true_water
from benchmarks.common import DEMO, PICTURES, RESULTS, write_results
from benchmarks.restoration_limit import COAST, OCEAN, SETTINGS, render_reef
from swag_engine.base.transfer import linear_to_srgb, srgb_to_linear
from swag_engine.evaluation.metrics import render_image, restored_error
from swag_engine.evidence.noise import estimate_noise
from swag_engine.experiments.develop_run import color_view
from swag_engine.experiments.evaluate_run import LoadedRun, load_run, true_image
from swag_engine.formats.run_folder import RunFolder
from swag_engine.rendering.model import SceneModel
from swag_engine.rendering.render import render
from swag_engine.rendering.restored_photo import restored_photo
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import Scene, load_scene
from swag_engine.scene.images import TrainingImage, load_images
from swag_engine.scene.split import split_views
from swag_engine.training.trainer import train
from tests.scenes.effect_scenes import rendered, settings_for
from tests.scenes.make_scene import make_scene

PATTERNS = {"reef": "orbit", "street": "walk", "room": "around"}
"""Cameras over each place."""
SCENES: dict[str, dict[str, Any]] = {
    "reef, ocean": {"water": OCEAN},
    "reef, coast": {"water": COAST},
    "street, ocean": {"water": OCEAN},
    "street, coast": {"water": COAST},
    "room, coast": {"water": COAST},
    "room, coast, lamp": {"water": COAST, "lamp": 1.0},
    "reef, ocean, not compressed": {"water": OCEAN, "lossless": True},
    "reef, coast, not compressed": {"water": COAST, "lossless": True},
    "street, ocean, not compressed": {"water": OCEAN, "lossless": True},
    "street, coast, not compressed": {"water": COAST, "lossless": True},
    "room, coast, not compressed": {"water": COAST, "lossless": True},
}
"""Place and effects of the generated scenes; the demo has a seed of its own, 0."""
METHODS = (
    "photo", "grey world", "CLAHE", "grey world + CLAHE", "Sea-thru", "best gain", "true water",
    "render, not developed", "render", "restored photo, not developed", "restored photo",
)  # fmt: skip
OURS = "restored photo"
PICTURED = tuple(name for name in SCENES if "not compressed" not in name)
"""Scenes in the picture, after the demo."""
KNOW_TRUTH = ("best gain", "true water")
HIDDEN = 0.95
"""A point is hidden from a view whose surface is nearer than this fraction of its distance."""
PICTURED_VIEW = 1
"""Number of the test view in the picture."""
LABEL = 20
"""Height of the line above each row of the picture, pixels."""
EXPOSURES = np.arange(-5, 3.01, 0.25)
"""Exposures that are tried under a lamp, stops."""
PICTURE_SCALE = 0.56
"""Size of the picture over that of the views."""
MOST_BYTES = 44_000
"""Of the picture: it is compressed as much as this needs."""


def make_scenes(folder: Path, names: list[str], seed: int) -> dict[str, Path]:
    """Return the folders of generated scenes by name, rendering those that are not there."""
    folders = {name: folder / f"{name.replace(', ', '-')}-{seed}" for name in names}
    for place, pattern in PATTERNS.items():
        missing = {
            name: out
            for name, out in folders.items()
            if name.split(", ")[0] == place and not (out / "truth.json").exists()
        }
        if missing:
            first = next(iter(missing.values()))
            passes = render_reef(first, seed) if place == "reef" else rendered(folder, pattern, seed)
            for name, out in missing.items():
                make_scene(settings_for(out, seed=seed, **SCENES[name]), passes)
    return folders


@torch.no_grad()
def rendered_range(run: LoadedRun, camera: Camera) -> np.ndarray:
    """Return the range (H, W) of the surface that a run has in a view, 0 where most is background."""
    picture = render(run.cloud, camera, 0, run.effects.medium, with_range=True)
    assert picture.range is not None
    return torch.where(picture.alpha > 0.5, picture.range, 0).cpu().numpy()


def seen_points(points: np.ndarray, camera: Camera, ranges: np.ndarray) -> np.ndarray:
    """Find the points that a view sees.

    Args:
        points: (N, 3) in the world.
        camera: The camera.
        ranges: (H, W) range of its surface, 0 where there is none.

    Returns:
        (N,) bool.
    """
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = np.maximum(local[:, 2], 1e-6)
    column = np.floor(camera.fx * local[:, 0] / depth + camera.cx)
    row = np.floor(camera.fy * local[:, 1] / depth + camera.cy)
    inside = (local[:, 2] > 1e-6) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    surface = np.zeros(len(points))
    surface[inside] = ranges[row[inside].astype(int), column[inside].astype(int)]
    return inside & ((surface == 0) | (surface >= HIDDEN * np.linalg.norm(local, axis=1)))


def world_points(camera: Camera, ranges: np.ndarray) -> np.ndarray:
    """Return the points (H, W, 3) at ranges (H, W) of the pixels' centres."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return rays * ranges[..., None] @ camera.world_to_camera[:3, :3] + camera.centre


def true_range(scene_folder: Path, camera: Camera) -> np.ndarray:
    """Return the true range (H, W) of a view, metres, which are the scene's units; 0 in open water."""
    path = (scene_folder / "range" / camera.name).with_suffix(".png")
    millimetres = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    return cv2.resize(millimetres, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST) / 1000


def images_of(
    run: LoadedRun, scene: Scene, image: TrainingImage, truth: np.ndarray, valid: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the image (H, W, 3) that each method makes of a test view, without development."""
    water = json.loads((scene.folder / "truth.json").read_text("utf-8"))["water"]
    photo = image.pixels.astype(np.float32) / 255
    made = {
        "photo": photo,
        "grey world": grey_world(photo),
        "CLAHE": clahe(photo),
        "grey world + CLAHE": clahe(grey_world(photo)),
        "Sea-thru": sea_thru(photo, rendered_range(run, image.camera)),
        "best gain": best_gain(photo, truth, valid),
        "true water": true_water(photo, true_range(scene.folder, image.camera), water),
        "render, not developed": render_image(
            run.cloud, image.camera, SETTINGS.sh_degree, effects=run.effects, amount=0
        ).numpy(),
        "restored photo, not developed": linear_to_srgb(
            restored_photo(
                SceneModel(run.trained, run.effects),
                run.limit,
                image,
                estimate_noise([image], scene.views),
                SETTINGS.sh_degree,
            )
        ).clip(0, 1),
    }
    return {name: np.asarray(picture, np.float64) for name, picture in made.items()}


def compare(scene_folder: Path, out: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Compare all methods on the test views of a run.

    Returns:
        The means over views by method, with the fraction of the surface that a training view saw; and the images of
        the pictured view by method, and the "truth".
    """
    run, scene = load_run(out), load_scene(scene_folder)
    development = color_view(out, "auto", run.cloud, run.effects).at(0)
    split = split_views([view.name for view in scene.views])
    images = load_images(scene, scene.views, SETTINGS.width)
    training = [image.camera for image in images if image.camera.name in split.train]
    surfaces = [rendered_range(run, camera) for camera in training]
    lamp = json.loads((scene_folder / "truth.json").read_text("utf-8"))["lamp"]
    test = [image for image in images if image.camera.name in split.test]
    fractions, truths, masks = [], [], []
    made: dict[str, list[np.ndarray]] = {name: [] for name in METHODS}
    for image in test:
        found = true_image(scene, image)
        assert found
        truth, valid = found
        points = world_points(image.camera, true_range(scene_folder, image.camera))[valid]
        seen = np.zeros(len(points), bool)
        for camera, ranges in zip(training, surfaces, strict=True):
            seen |= seen_points(points, camera, ranges)
        fractions.append(seen.mean())
        compared = valid.copy()
        compared[valid] = seen
        pictures = images_of(run, scene, image, truth, compared)
        for name in ("render", OURS):
            pictures[name] = development.apply(pictures[f"{name}, not developed"])
        for name in METHODS:
            made[name].append(pictures[name])
        truths.append(truth)
        masks.append(compared)
    row: dict[str, Any] = {"seen": round(float(np.mean(fractions)), 4)}
    for name in METHODS:
        if lamp:
            row[name], made[name] = best_exposure(made[name], truths, masks)
        else:
            row[name] = score(made[name], truths, masks)
    return row, {name: images[PICTURED_VIEW] for name, images in (made | {"truth": truths}).items()}


def score(images: list[np.ndarray], truths: list[np.ndarray], masks: list[np.ndarray]) -> dict[str, float]:
    """Return the means over views of delta E and of the hue error, of images (H, W, 3) where masks (H, W) are True."""
    views = list(zip(images, truths, masks, strict=True))
    delta_e = np.nanmean([restored_error(*view)[1] for view in views])
    return {
        "delta_e": round(float(delta_e), 2),
        "hue": round(float(np.nanmean([hue_error(*view) for view in views])), 1),
    }


def best_exposure(
    images: list[np.ndarray], truths: list[np.ndarray], masks: list[np.ndarray]
) -> tuple[dict[str, float], list[np.ndarray]]:
    """Give all images of a method the one exposure of least delta E.

    Returns:
        The scores with the exposure in stops, and the images.
    """
    light = [srgb_to_linear(image.clip(0)) for image in images]
    best: tuple[dict[str, float], list[np.ndarray]] | None = None
    for stops in EXPOSURES:
        exposed = [linear_to_srgb(np.clip(each * 2**stops, 0, 1)) for each in light]
        found = score(exposed, truths, masks) | {"stops": float(stops)}
        if best is None or found["delta_e"] < best[0]["delta_e"]:
            best = found, exposed
    assert best
    return best


def keep_row(name: str, seed: int, row: dict[str, Any]) -> None:
    """Add a row to the results, in the order of the scenes and their seeds."""
    stored = RESULTS / "restored_colors.json"
    rows: dict[str, dict[str, Any]] = json.loads(stored.read_text("utf-8"))["scenes"] if stored.exists() else {}
    rows.setdefault(name, {})[str(seed)] = row
    ordered = {
        scene: dict(sorted(rows[scene].items(), key=lambda item: int(item[0])))
        for scene in ("demo", *SCENES)
        if scene in rows
    }
    write_results("restored_colors", {"iterations": SETTINGS.iterations, "width": SETTINGS.width, "scenes": ordered})


def next_best(row: dict[str, Any]) -> str:
    """Return the method of least delta E among those that are not ours and do not know the truth."""
    others = [name for name in METHODS if name not in KNOW_TRUTH and not name.startswith(("render", OURS))]
    return min(others, key=lambda name: row[name]["delta_e"])


def labelled(scene: str, row: dict[str, Any], pictured: dict[str, np.ndarray]) -> np.ndarray:
    """Return a row of the picture (H, W, 3) uint8: photo, next best method, ours, truth, and what they are."""
    names = ["photo", next_best(row), "render", OURS, "truth"]
    strip = np.concatenate([pictured[name] for name in names], axis=1)
    pixels = (strip * 255).round().clip(0, 255).astype(np.uint8)
    line = np.full((LABEL, pixels.shape[1], 3), 255, np.uint8)
    for number, name in enumerate(names):
        title = f"{scene}: photo" if name == "photo" else name
        text = title if name == "truth" else f"{title} ({row[name]['delta_e']:.1f})"
        at = (number * pictured["truth"].shape[1] + 4, LABEL - 6)
        cv2.putText(line, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([line, pixels])


def write_picture(folder: Path) -> None:
    """Write the picture, of the first seed of each scene, once the rows of all scenes are in the folder."""
    strips = [sorted(folder.glob(f"picture {name} [0-9]*.png")) for name in ("demo", *PICTURED)]
    if not all(strips):
        print(f"{PICTURES / 'restored_colors.webp'} stays as it is: {folder} does not have all scenes yet.")
        return
    picture = np.concatenate([cv2.imread(str(paths[0])) for paths in strips])
    picture = cv2.resize(picture, None, fx=PICTURE_SCALE, fy=PICTURE_SCALE, interpolation=cv2.INTER_AREA)
    for quality in range(85, 10, -5):
        packed = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, quality])[1]
        if len(packed) <= MOST_BYTES:
            break
    (PICTURES / "restored_colors.webp").write_bytes(packed.tobytes())


def main() -> None:
    """Compare on the chosen scenes and write results and picture."""
    parser = ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 21])
    parser.add_argument("--scenes", nargs="+", choices=["demo", *SCENES], default=["demo", *SCENES])
    chosen = parser.parse_args()
    for seed in chosen.seeds:
        folders = make_scenes(chosen.folder, [name for name in chosen.scenes if name in SCENES], seed)
        if "demo" in chosen.scenes and seed == chosen.seeds[0]:
            folders = {"demo": DEMO} | folders
        for name, scene_folder in folders.items():
            out = chosen.folder / f"run-{scene_folder.name}"
            if not RunFolder(out).finished():
                train(scene_folder, out, SETTINGS)
            row, pictured = compare(scene_folder, out)
            print(name, seed, row, flush=True)
            keep_row(name, 0 if name == "demo" else seed, row)
            strip = labelled(name, row, pictured)
            cv2.imwrite(str(chosen.folder / f"picture {name} {seed}.png"), strip[..., ::-1])
    write_picture(chosen.folder)


if __name__ == "__main__":
    main()
