"""Measure the haze in open water and what hiding it costs, on scenes whose surfaces are known (docs/water.md).

Run: `python benchmarks/haze.py FOLDER [--scenes "reef, ocean" ...]`

The scenes are those of benchmarks/restored_colors.py, rendered to FOLDER and trained there unless they are there
already; "demo" is always measured. For all of the haze and for none, without water, over the test views: mean alpha in
open water and on surfaces, each at least two pixels from the other, and delta E of surfaces.
"""

import sys
from argparse import ArgumentParser
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import DEMO
from benchmarks.restoration_limit import SETTINGS, test_images
from benchmarks.restored_colors import SCENES, make_scenes, true_range
from swag_engine.evaluation.metrics import render_image, restored_error, score_image
from swag_engine.experiments.evaluate_run import load_run, true_image
from swag_engine.formats.run_folder import RunFolder
from swag_engine.rendering.render import render
from swag_engine.training.trainer import train

SEED = 11
BORDER = np.ones((5, 5), np.uint8)
"""Pixels around an edge that are left out."""


@torch.no_grad()
def measure(out: Path, haze: float) -> tuple[float, ...]:
    """Return alpha in open water, alpha on surfaces, delta E, and PSNR through the water, means over the test views."""
    run = load_run(out)
    scene, images = test_images(out)
    rows = []
    for image in images:
        surface = (true_range(scene.folder, image.camera) > 0).astype(np.uint8)
        water, surface = (cv2.erode(mask, BORDER) > 0 for mask in (1 - surface, surface))
        alpha = render(run.through(0, haze), image.camera, 3, run.effects.medium, amount=0).alpha.numpy()
        restored, shown = (
            render_image(run.through(amount, haze), image.camera, 3, effects=run.effects, amount=amount)
            for amount in (0, 1)
        )
        truth = true_image(scene, image)
        assert truth
        delta_e = restored_error(restored.numpy(), *truth)[1]
        rows.append((alpha[water].mean(), alpha[surface].mean(), delta_e, score_image(image, shown).psnr))
    return tuple(float(value) for value in np.mean(rows, axis=0))


def main() -> None:
    """Print the rows of the table."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=["reef, ocean", "reef, coast", "street, coast"])
    options = parser.parse_args()
    for name, scene in {"demo": DEMO, **make_scenes(options.folder, options.scenes, SEED)}.items():
        out = options.folder / f"run-{scene.name}"
        if not RunFolder(out).finished():
            train(scene, out, SETTINGS)
        (*before, psnr), (*after, hidden) = (measure(out, haze) for haze in (1.0, 0.0))
        pairs = [f"{a:.3g}, {b:.3g}" for a, b in zip(before, after, strict=True)]
        print(f"| {name} | {' | '.join(pairs)} | {psnr:.2f}, {hidden:.2f} dB |", flush=True)


if __name__ == "__main__":
    main()
