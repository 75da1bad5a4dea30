"""Measure held-out views at half, equal and double the training width, with and without a least size of Gaussians.

Those of half and double width are scored as the rasteriser draws the Gaussians, and as films do.

Run: `python benchmarks/zoom.py [--scenes demo] [--seeds 0] [--variances 0 0.1 0.2]`
Results: benchmarks/results/zoom.json, written after each run; runs that are in it are not repeated.
"""

import argparse
import itertools
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import DEMO, RESULTS, SHARED, machine, write_results
from swag_engine.evaluation.metrics import in_8_bits, mean_score, score_image, score_views
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians import sizes
from swag_engine.rendering.trained_detail import TrainedDetail, render_as_trained
from swag_engine.scene.images import TrainingImage, load_images
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import Trainer, make_trainer

SCENES = {
    "demo": DEMO,
    "aqualoc_amphorae": SHARED / "aqualoc_amphorae",
    "japanese_gardens": SHARED / "japanese_gardens",
}
SIZE = {"iterations": 600, "width": 240, "max_gaussians": 15_000}
"""Settings of each run."""
ZOOMS = (0.5, 1.0, 2.0)
"""Width of the scored images as a factor of the training width."""


def run(scene: Path, variance: float, seed: int) -> dict[str, Any]:
    """Train once and return processor time, and PSNR of the test images at each width."""
    settings = TrainSettings(**SIZE, seed=seed, backend="cpu")
    smallest = max(variance, 1e-12)
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(sizes, "LEAST_VARIANCE", smallest):
        trainer = make_trainer(RunFolder(Path(folder) / "run"), scene, settings, False, lambda event: None, None, 0.0)
        started = time.process_time()
        while not trainer.state.clock.done:
            trainer.iterate()
        row: dict[str, Any] = {"processor_seconds": round(time.process_time() - started, 1)}
        state, inputs = trainer.state, trainer.inputs
        row["gaussians"] = len(state.cloud)
        names = {image.camera.name for image in inputs.test}
        detail = TrainedDetail.of_training(state.cloud.means, [image.camera for image in inputs.training])
        views = [view for view in inputs.scene.views if view.camera.name in names]
        for zoom in ZOOMS:
            images = load_images(inputs.scene, views, round(zoom * settings.width))
            scores = score_views(state.cloud, images, settings.sh_degree, settings.backend, state.effects)
            row[f"x{zoom:g}"] = round(mean_score(scores)[0], 3)
            if zoom != 1:
                scores = [score_image(image, film_image(trainer, image, detail)) for image in images]
                row[f"x{zoom:g} film"] = round(mean_score(scores)[0], 3)
    return row


def film_image(trainer: Trainer, image: TrainingImage, detail: TrainedDetail) -> Tensor:
    """Render the view of an image with the detail of the training images, in 8 bits."""
    effects, degree = trainer.state.effects, trainer.inputs.settings.sh_degree
    picture = render_as_trained(trainer.state.cloud, image.camera, detail, degree, effects.medium, lamp=effects.lamp)
    return in_8_bits(effects.apply_to_image(picture.color, image.camera.name))


def main() -> None:
    """Make the runs that are missing on all scenes that are on this machine."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--variances", type=float, nargs="+", default=[0.0, 0.1, 0.2])
    arguments = parser.parse_args()
    path = RESULTS / "zoom.json"
    rows = json.loads(path.read_text(encoding="utf-8"))["runs"] if path.exists() else []
    for seed, scene, variance in itertools.product(arguments.seeds, arguments.scenes, arguments.variances):
        key = {"scene": scene, "least_variance": variance, "seed": seed}
        if not SCENES[scene].exists() or any(key.items() <= row.items() for row in rows):
            continue
        rows.append(key | run(SCENES[scene], variance, seed))
        write_results("zoom", {"machine": machine(), **SIZE, "runs": rows})
        print(rows[-1], flush=True)


if __name__ == "__main__":
    main()
