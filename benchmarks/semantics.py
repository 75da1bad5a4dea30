"""Measure the accuracy and the cost of labels.

Run: `python benchmarks/semantics.py [RUN]`, with nothing else on the machine (RUN: a finished run of the demo scene)
Results: benchmarks/results/semantics.json

Trains the demo scene, labels its Gaussians from the true masks of the training images, and compares rendered labels
with the truth of the held-out views. The region provider `saliency` is compared with the class masks of SUIM images,
where they are on this machine.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import DEMO, SHARED, machine, write_results
from swag_engine.rendering.model import cloud_from_checkpoint
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import TrainingImage, load_images, read_image
from swag_engine.scene.split import split_views
from swag_engine.semantics.assign import assign, label_weights, render_labels, semantic_loss, targets_in_view
from swag_engine.semantics.embed import Descriptor
from swag_engine.semantics.masks import MaskFolder
from swag_engine.semantics.regions import RegionProvider, SceneRegions, find_regions
from swag_engine.semantics.saliency import Saliency
from swag_engine.training.checkpoint import load_checkpoint
from swag_engine.training.losses import photometric

SUIM = SHARED / "suim"
ITERATIONS, WIDTH, GAUSSIANS = 1500, 480, 60000


def main() -> None:
    """Measure the demo run and SUIM, print and write the results."""
    document: dict[str, Any] = {"machine": machine()}
    with tempfile.TemporaryDirectory() as folder:
        run = Path(sys.argv[1]) if len(sys.argv) > 1 else train(Path(folder) / "run")
        document["demo"] = demo(run)
    if SUIM.is_dir():
        document["suim"] = suim(Saliency())
    print(json.dumps(document, indent=2))
    write_results("semantics", document)


def train(run: Path) -> Path:
    """Train the demo scene in a separate process."""
    command = [sys.executable, "-m", "swag_engine", "train", DEMO, "--out", run, "--iterations", ITERATIONS]
    command += ["--width", WIDTH, "--max-gaussians", GAUSSIANS]
    subprocess.run([str(part) for part in command], cwd=ROOT, check=True)
    return run


def demo(run: Path) -> dict[str, Any]:
    """Measure the IoU of rendered labels on held-out and validation views, and the cost of labelling."""
    scene = load_scene(DEMO)
    width = json.loads((run / "config.json").read_text())["settings"]["width"]
    split = split_views([view.name for view in scene.views])
    images = {image.camera.name: image for image in load_images(scene, scene.views, width)}
    training = [images[name] for name in split.train]
    masks = MaskFolder(DEMO / "labels", scene)
    loaded = load_checkpoint(run)
    assert loaded is not None
    cloud = cloud_from_checkpoint(loaded[0])

    start = time.process_time()
    regions = find_regions(training, masks, Descriptor())
    found = time.process_time()
    cameras = {image.camera.name: image.camera for image in training}
    assignment = assign(cloud, regions, cameras)
    assigned = time.process_time()
    behind = regions.labels.index("open water") + 1
    truth = {name: truth_of(masks, images[name], regions) for name in (*split.test, *split.validation)}
    shown = {
        name: render_labels(cloud, assignment.labels, len(regions.labels), images[name].camera, behind)
        for name in truth
    }
    aside = {name: np.roll(truth[name], 1, axis=1) for name in split.test}
    labelled = assignment.labels > 0
    return {
        "gaussians": len(cloud),
        "width": width,
        "held-out": ious(regions, truth, shown, split.test),
        "validation": ious(regions, truth, shown, split.validation),
        "truth one pixel aside": ious(regions, truth, aside, split.test),
        "views": {name: ious(regions, truth, shown, [name]) for name in truth},
        "agreement": round(float(assignment.agreement[labelled].mean()), 4),
        "consistent_views": consistency(cloud, regions, cameras, assignment.labels),
        "unlabelled": round(float((~labelled).float().mean()), 4),
        "cpu_seconds": {"regions": round(found - start, 2), "assignment": round(assigned - found, 2)},
        **cost(cloud, regions, {name: images[name] for name in split.train}),
    }


def truth_of(masks: MaskFolder, image: TrainingImage, regions: SceneRegions) -> np.ndarray:
    """Return the labels (H, W) that the masks give, as indices into the regions' labels plus one."""
    truth = np.zeros(image.valid.shape, int)
    for region in masks.regions(image, []):
        if region.label in regions.labels:
            truth[region.mask] = regions.labels.index(region.label) + 1
    return truth


def ious(
    regions: SceneRegions, truth: dict[str, np.ndarray], shown: dict[str, np.ndarray], names: Sequence[str]
) -> dict[str, float]:
    """Measure IoU by label over all pixels of these views together, and their mean as `miou`."""
    found = {}
    for number, label in enumerate(regions.labels, 1):
        common = sum(((truth[name] == number) & (shown[name] == number)).sum() for name in names)
        union = sum(((truth[name] == number) | (shown[name] == number)).sum() for name in names)
        if union:
            found[label] = round(float(common / union), 4)
    return {"miou": round(float(np.mean(list(found.values()))), 4)} | found


def consistency(cloud: Any, regions: SceneRegions, cameras: dict[str, Camera], labels: torch.Tensor) -> float:
    """Return the fraction of the Gaussians' contributions that falls on pixels of their own label."""
    right = total = 0.0
    for name, drawn in regions.maps.items():
        here, weights, _ = label_weights(cloud, cameras[name], drawn)
        right += float((weights * (here[None] == labels[:, None])).sum())
        total += float(weights.sum())
    return round(right / total, 4)


def cost(cloud: Any, regions: SceneRegions, images: dict[str, TrainingImage]) -> dict[str, float]:
    """Measure processor milliseconds of an iteration and of its semantics, and the memory of the features."""
    features = torch.zeros(len(cloud), 32, requires_grad=True)
    for parameter in cloud.parameters().values():
        parameter.requires_grad_()
    name, image = next(iter(images.items()))
    target = torch.from_numpy(image.pixels).float() / 255
    times = []
    for _ in range(7):
        marks = [time.process_time()]
        photometric(render(cloud, image.camera).color, target, None).backward()
        marks.append(time.process_time())
        targets, assigned = targets_in_view(cloud, image.camera, regions)
        semantic_loss(features, targets, assigned).backward()
        marks.append(time.process_time())
        times.append(np.diff(marks) * 1000)
    iteration, semantics = np.median(times, axis=0)
    return {
        "cpu_ms_iteration": round(iteration, 1),
        "cpu_ms_semantics": round(semantics, 1),
        # The feature, its gradient and Adam's two moments, float32.
        "mb_per_100000": 4 * 32 * 4 * 1e5 / 1e6,
    }


def suim(provider: RegionProvider) -> dict[str, Any]:
    """Measure, per image, the IoU of open water with SUIM's background and of everything else with its objects."""
    scores = {}
    for path in sorted((SUIM / "images").iterdir()):
        pixels = read_image(path)[0]
        height, width = pixels.shape[:2]
        drawn = read_image(SUIM / "masks" / f"{path.stem}.png")[0]
        truth = cv2.resize(drawn, (width, height), interpolation=cv2.INTER_NEAREST).max(-1) > 127
        camera = Camera(path.name, width, height, width, width, width / 2, height / 2, np.eye(4))
        found = provider.regions(TrainingImage(camera, pixels, np.ones((height, width), bool)), [])
        water, salient = found[0].mask, found[1].mask
        scores[path.name] = {
            "open water": iou_of(water, ~truth),
            "all else": iou_of(~water, truth),
            "salient alone": iou_of(salient, truth),
        }
    means = {kind: round(float(np.mean([score[kind] for score in scores.values()])), 4) for kind in scores[path.name]}
    return {"provider": provider.name, "mean": means, "images": scores}


def iou_of(a: np.ndarray, b: np.ndarray) -> float:
    """Return the intersection over union of two masks (H, W) bool."""
    return round(float((a & b).sum() / max(1, (a | b).sum())), 4)


if __name__ == "__main__":
    main()
