"""Measure what the limit of restored colors changes, on scenes whose colors without water are known.

Run: `python benchmarks/restoration_limit.py FOLDER`
Results: benchmarks/results/restoration_limit.json and docs/images/restoration_limit.webp

The scenes are rendered to FOLDER and trained there, unless they are there already. Each run is scored on its test views
twice: with the colors as trained, and with the limited ones that it writes.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import DEMO, PICTURES, WEBP_QUALITY, write_results
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.evaluation.metrics import render_image, restored_error, score_image
from swag_engine.experiments.evaluate_run import load_run, true_image
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.rendering.restoration import RESTORED_FROM, render_confidence
from swag_engine.scene.colmap import Scene, load_scene
from swag_engine.scene.images import TrainingImage, load_images
from swag_engine.scene.split import split_views
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.effect_scenes import camera_poses, rendered, settings_for
from tests.scenes.make_scene import Rendered, Water, focal_length, make_scene
from tests.scenes.reef_model import Model, Renderer

OCEAN = Water((0.35, 0.09, 0.06), (0.30, 0.11, 0.085), (0.02, 0.16, 0.30))
COAST = Water((0.45, 0.16, 0.22), (0.40, 0.18, 0.24), (0.05, 0.22, 0.16))
SCENES = {"street, ocean": ("street", OCEAN), "reef, ocean": ("reef", OCEAN), "reef, coast": ("reef", COAST)}
SEEDS = {"street": 7, "reef": 11}
SETTINGS = TrainSettings(iterations=1000, width=320, max_gaussians=20_000)
PICTURED = ("street, ocean", 1)
"""Scene and number of the test view in the picture."""


def make_scenes(folder: Path) -> dict[str, Path]:
    """Return the folders of all scenes by name, rendering those that are not there."""
    scenes, passes = {"demo": DEMO}, dict[str, Rendered]()
    for name, (place, water) in SCENES.items():
        out, seed = folder / name.replace(", ", "-"), SEEDS[place]
        scenes[name] = out
        if not (out / "truth.json").exists():
            if place not in passes:
                passes[place] = rendered(folder, "walk", seed) if place == "street" else render_reef(out, seed)
            make_scene(settings_for(out, seed=seed, water=water), passes[place])
    return scenes


def render_reef(out: Path, seed: int) -> Rendered:
    """Render the reef of a seed from an orbit, by Cycles."""
    settings = settings_for(out, seed=seed)
    factor, poses = settings.supersample, camera_poses("orbit")
    width, height, focal = (n * factor for n in (settings.width, settings.height, focal_length(settings)))
    renderer = Renderer(Model(seed), width, height, focal, settings.samples)
    still = [renderer.still(pose) for pose in poses]
    return Rendered(poses, still, still, None)


def test_images(folder: Path) -> tuple[Scene, list[TrainingImage]]:
    """Return the scene and the test images of a run."""
    scene_folder, settings, _ = RunFolder(folder).read_config()
    scene = load_scene(scene_folder)
    names = split_views([view.name for view in scene.views]).test
    return scene, load_images(scene, [view for view in scene.views if view.name in names], settings.width)


def scores(cloud: GaussianCloud, effects: SceneEffects, scene: Scene, images: list[TrainingImage]) -> dict[str, float]:
    """Return means over images: PSNR, and of the images without water delta E and the fraction of clipped pixels."""
    rows = []
    for image in images:
        shown, restored = (
            render_image(cloud, image.camera, SETTINGS.sh_degree, effects=effects, amount=amount) for amount in (1, 0)
        )
        truth = true_image(scene, image)
        assert truth
        clipped = float((restored >= 1).any(-1).float().mean())
        rows.append((score_image(image, shown).psnr, restored_error(restored.numpy(), *truth)[1], clipped))
    psnr, delta_e, clipped = np.mean(rows, axis=0).tolist()
    return {"psnr": round(psnr, 3), "delta_e": round(delta_e, 2), "clipped": round(clipped, 5)}


def main() -> None:
    """Measure every scene and write results and picture."""
    folder = Path(sys.argv[1])
    rows = {}
    for name, scene_folder in make_scenes(folder).items():
        out = folder / f"run-{scene_folder.name}"
        if not RunFolder(out).finished():
            train(scene_folder, out, SETTINGS)
        run = load_run(out)
        assert run.confidence is not None
        scene, images = test_images(out)
        maps = [render_confidence(run.cloud, run.confidence, image.camera).cpu() for image in images]
        seen = torch.cat([found[found.isfinite()] for found in maps])
        rows[name] = {
            "as trained": scores(run.trained, run.effects, scene, images),
            "limited": scores(run.cloud, run.effects, scene, images),
            "not_restored": round(float((seen < RESTORED_FROM).float().mean()), 4),
        }
        print(name, rows[name], flush=True)
        if name == PICTURED[0]:
            image, found = images[PICTURED[1]], maps[PICTURED[1]]
            shown = [render_image(of, image.camera, SETTINGS.sh_degree, effects=run.effects, amount=0).numpy()
                     for of in (run.trained, run.cloud)]  # fmt: skip
            truth = true_image(scene, image)
            assert truth
            grey = found.nan_to_num(0.5)[..., None].expand(-1, -1, 3).numpy()
            strip = np.concatenate([image.pixels / 255, *shown, grey, truth[0]], axis=1)
            pixels = (strip * 255).round().clip(0, 255).astype(np.uint8)
            cv2.imwrite(str(PICTURES / "restoration_limit.webp"), pixels[..., ::-1],
                        [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY])  # fmt: skip
    write_results("restoration_limit", {"iterations": SETTINGS.iterations, "width": SETTINGS.width, "scenes": rows})


if __name__ == "__main__":
    main()
