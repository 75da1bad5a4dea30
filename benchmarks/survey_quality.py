"""Quality of a merged survey against one run of the same scene: whole images, pixels at seams, and density of splats.

benchmarks/survey.py calls it.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import save_figure
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.evaluation.metrics import mask_invalid, mean_score, psnr_from_mse, render_image, score_image
from swag_engine.experiments.evaluate_run import load_newest
from swag_engine.formats.ply import read_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.formats.survey_folder import Block
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.scene.cameras import Camera
from swag_engine.scene.images import TrainingImage, load_images
from swag_engine.survey.merged_model import MergedModel
from swag_engine.survey.report import SEAM_BAND
from swag_engine.survey.seams import distance_to_seams, seam_distances

BANDS = (SEAM_BAND, 0.5, 1.0, 2.0, np.inf)
"""Upper ends of the bands of distance from a border, median ranges. The first is the seam, the others the interior."""
STRIP = 0.25
"""Width on each side of a border in which the density of splats is compared, as a fraction of the margin."""
CELLS = 400
"""Cells along each side of the survey's bounds, by which areas are measured."""


@dataclass
class Scores:
    """Scores of a model on test images, and its squared errors by band."""

    views: list[Any] = field(default_factory=list)
    sums: np.ndarray = field(default_factory=lambda: np.zeros(len(BANDS)))

    def add(self, image: TrainingImage, color: Tensor, band: np.ndarray) -> None:
        """Add a view; `band` (H, W) is the number of the band of each pixel, -1 for those that do not count."""
        self.views.append(score_image(image, color))
        shown, target, _ = mask_invalid(image, color)
        square = ((shown - target) ** 2).mean(-1).numpy()
        chosen = band >= 0
        self.sums += np.bincount(band[chosen], square[chosen], len(BANDS))

    def figures(self, pixels: np.ndarray) -> dict[str, Any]:
        """Return PSNR and SSIM of the images, and PSNR at the seam, elsewhere, and in each band."""
        psnr, ssim = mean_score(self.views)
        return {
            "test_psnr": psnr,
            "test_ssim": ssim,
            "seam_psnr": psnr_from_mse(float(self.sums[0] / pixels[0])) if pixels[0] else None,
            "interior_psnr": psnr_from_mse(float(self.sums[1:].sum() / pixels[1:].sum())),
            "bands": [psnr_from_mse(float(sum_ / count)) if count else None
                      for sum_, count in zip(self.sums, pixels, strict=True)],
        }  # fmt: skip


def compare_survey(single: Path, survey: Path) -> dict[str, Any]:
    """Score a merged survey and a run of the whole scene on the same test images and pixels.

    Args:
        single: Folder of the run.
        survey: Folder of the survey.

    Returns:
        `single` and `survey`, the figures of `Scores`, the number of Gaussians and `density`, the density of splats
        beside borders over that elsewhere; `pixels`, the numbers in each band; `bands`, their ends (scene units).
    """
    model = MergedModel.load(survey)
    cloud, effects, _ = load_newest(single)
    blocks = [model.folder.read_block(name) for name in model.survey.blocks]
    degree, ends = model.survey.settings.sh_degree, np.array(BANDS) * model.survey.median_range
    pixels = np.zeros(len(BANDS))
    scores = {"single": Scores(), "survey": Scores()}
    for image in test_images(model):
        merged = model.in_view(image.camera)
        distance = seam_distances(merged, model.effects, image.camera, model.survey.ground, blocks)
        counted = np.isfinite(distance) & image.valid
        band = np.where(counted, np.searchsorted(ends, np.where(counted, distance, 0)), -1)
        pixels += np.bincount(band[counted], minlength=len(BANDS))
        for name, gaussians, known in (("single", cloud, effects), ("survey", merged, model.effects)):
            color = render_image(gaussians, image.camera, degree, effects=known)
            scores[name].add(image, color, band)
    positions = {
        "single": read_ply(RunFolder(single).ply).positions,
        "survey": np.concatenate(
            [read_ply(model.tiles.path(tile)).positions for tile in model.tiles.of_level(0)]
        ),
    }  # fmt: skip
    return {
        "bands": [float(end) if np.isfinite(end) else None for end in ends],
        "pixels": pixels.astype(int).tolist(),
        **{
            name: scores[name].figures(pixels)
            | {
                "gaussians": len(positions[name]),
                "density": density_at_borders(model, blocks, positions[name]),
            }
            for name in scores
        },
    }


def test_images(model: MergedModel) -> list[TrainingImage]:
    """Return the test images at the training size."""
    test = set(model.views.split.test)
    return load_images(
        model.views, [view for view in model.views.views if view.name in test], model.survey.settings.width
    )


def density_at_borders(model: MergedModel, blocks: Sequence[Block], positions: np.ndarray) -> float:
    """Return the number of splats for an area beside borders between blocks, over that elsewhere in the bounds.

    Args:
        model: The merged survey.
        blocks: Its blocks.
        positions: Positions (N, 3) of the splats of any model of the scene.
    """
    left, bottom, right, top = model.survey.bounds
    x, y = (low + (np.arange(CELLS) + 0.5) / CELLS * (high - low) for low, high in ((left, right), (bottom, top)))
    cells = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    # Places that no photo shows have no splats, whether they are near a border or not.
    on_ground = model.survey.ground.on_ground(positions)[:, :2]
    inside = ((on_ground >= [left, bottom]) & (on_ground < [right, top])).all(1)
    counts, _, _ = np.histogram2d(
        on_ground[inside, 1], on_ground[inside, 0], bins=CELLS // 10, range=[[bottom, top], [left, right]]
    )
    shown = np.kron(counts > 0, np.ones((10, 10), bool)).ravel()
    strip = STRIP * margin_of(blocks)
    beside_cells = distance_to_seams(cells, blocks) <= strip
    beside_splats = distance_to_seams(on_ground[inside], blocks) <= strip
    beside = beside_splats.sum() / (beside_cells & shown).sum()
    elsewhere = (~beside_splats).sum() / (~beside_cells & shown).sum()
    return float(beside / elsewhere)


def margin_of(blocks: Sequence[Block]) -> float:
    """Return the smallest distance from a core to the end of its extended box, scene units."""
    distances = [
        abs(edge - end)
        for block in blocks
        for edge, end in zip(block.core, block.extended, strict=True)
        if np.isfinite(edge)
    ]
    return min(distances)


def draw_seam(single: Path, survey: Path) -> None:
    """Draw a test photo across a border, rendered from one run and from the survey, to docs/images/survey_seam.webp."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    model = MergedModel.load(survey)
    cloud, effects, _ = load_newest(single)
    blocks = [model.folder.read_block(name) for name in model.survey.blocks]
    image, distance = max(
        (
            (
                image,
                seam_distances(model.in_view(image.camera), model.effects, image.camera, model.survey.ground, blocks),
            )
            for image in test_images(model)
        ),
        key=lambda pair: _border_in_middle(pair[1], pair[0].camera, model.survey.median_range),
    )
    degree = model.survey.settings.sh_degree
    panels: dict[str, np.ndarray] = {
        "photo": image.pixels / 255,
        "one run": render_image(cloud, image.camera, degree, effects=effects).numpy(),
        f"survey of {len(blocks)} blocks": _rendered(model, image.camera, model.effects, degree),
    }
    figure, all_axes = plt.subplots(1, len(panels), figsize=(3.6 * len(panels), 3.0), layout="constrained")
    for axes, (title, panel) in zip(all_axes, panels.items(), strict=True):
        axes.imshow(panel, interpolation="lanczos")
        axes.set_title(title, fontsize=9)
        axes.axis("off")
    # Where the distance from the border is small; a hair's breadth beside it, so that the seam itself stays visible.
    width = model.survey.median_range / image.camera.fx
    all_axes[-1].contour(np.nan_to_num(distance, nan=1e9), levels=[2 * width], colors="white", linewidths=0.6)
    save_figure("survey_seam", figure, 120)
    plt.close(figure)


def _border_in_middle(distance: np.ndarray, camera: Camera, reach: float) -> int:
    """Number of pixels beside a border in the middle half of an image."""
    rows, columns = (slice(side // 4, side - side // 4) for side in distance.shape)
    return int((distance[rows, columns] < 6 * reach / camera.fx).sum())


def _rendered(model: MergedModel, camera: Camera, effects: SceneEffects, degree: int) -> np.ndarray:
    cloud: GaussianCloud = model.in_view(camera)
    with torch.no_grad():
        return render_image(cloud, camera, degree, effects=effects).numpy()
