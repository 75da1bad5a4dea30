"""Report of a survey: quality of the merged model, at the seams and elsewhere, blocks, and cost."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.html_page import number, paragraph_html, table_html, write_page
from ..base.text import time_text
from ..evaluation.metrics import mask_invalid, mean, psnr_from_mse, render_image, score_image
from ..experiments.evaluate_run import compare_view
from ..experiments.page import BLUE, INK, ViewComparison, new_plots, plot_html, views_html
from ..formats.run_folder import write_json
from ..formats.survey_folder import COARSE, Block, SurveyFolder
from ..scene.images import load_images
from .merged_model import MergedModel
from .seams import seam_distances

SEAM_BAND = 0.25
"""Distance from a border up to which a pixel belongs to the seam, median ranges."""
SHOWN = 6
"""Test views of which the report shows images: the worst, the best, and others between."""
FEWEST_PIXELS = 500
"""Pixels of a view's seam, or of the rest of it, from which their PSNR counts."""
Progress = Callable[[str, float], None]


def report_survey(folder: Path, progress: Progress = lambda stage, fraction: None) -> dict[str, Any]:
    """Score a merged survey on its test images, and write merged/report.json and merged/report.html.

    Args:
        folder: Folder of the survey.
        progress: Gets the stage and its fraction (0..1).

    Returns:
        The document in report.json: `test_psnr` (dB) and `test_ssim`, means over the test images; `seam_psnr` and
        `interior_psnr`, of the pixels nearer to a border between blocks than `seam_band` (scene units), and of the
        others, over all test images together; `levels`, the number of splats, bytes and `test_psnr` of each level;
        `left_out`, names of test images without a valid pixel; `blocks` and `coarse`, the figures of their done.json;
        `processor_seconds` and `peak_memory` (bytes, the largest of all jobs); `views`, figures of each test image.
        Figures that are not known are NaN.

    Raises:
        InputError: If the survey is not merged, or a file is damaged.
    """
    model = MergedModel.load(folder)
    survey, files = model.survey, SurveyFolder(folder)
    blocks = [files.read_block(name) for name in survey.blocks]
    done = {name: files.read_done(name) for name in survey.jobs if files.done(name).exists()}
    band = SEAM_BAND * survey.median_range
    views, comparisons, errors = {}, [], SeamErrors()
    test = [view for view in model.views.views if view.name in set(model.views.split.test)]
    development = files.coarse.color_view("auto").at(0)
    for place, view in enumerate(test):
        progress("Scoring test photos", place / len(test))
        (image,) = load_images(model.views, [view], survey.settings.width)
        if not image.valid.any():
            continue
        cloud, degree = model.in_view(image.camera), survey.settings.sh_degree
        color = render_image(cloud, image.camera, degree, effects=model.effects)
        score = score_image(image, color)
        shown, target, valid = mask_invalid(image, color)
        square = ((shown - target) ** 2).mean(-1).numpy()
        distance = seam_distances(cloud, model.effects, image.camera, survey.ground, blocks)
        of_view = errors.add(square, distance <= band, valid.numpy() & np.isfinite(distance))
        views[view.name] = {"psnr": score.psnr, "ssim": score.ssim, **of_view}
        restored = None
        if model.effects.models:
            restored = render_image(
                cloud, image.camera, degree, effects=model.effects, amount=0, development=development
            )
        comparisons.append(compare_view(image, color, restored))
    document = {
        "images": survey.images,
        "test_psnr": mean([view["psnr"] for view in views.values()]),
        "test_ssim": mean([view["ssim"] for view in views.values()]),
        "seam_band": band,
        "seam_psnr": errors.psnr(True),
        "interior_psnr": errors.psnr(False),
        "levels": score_levels(model, list(views), progress),
        "processor_seconds": sum(each["processor_seconds"] for each in done.values()),
        "peak_memory": max((each["peak_memory"] for each in done.values()), default=0),
        "coarse": done.get(COARSE),
        "blocks": {name: done.get(name) for name in survey.parts},
        "views": views,
        "left_out": [view.name for view in test if view.name not in views],
    }
    write_json(files.merged / "report.json", document)
    _write_page(files, document, model, blocks, comparisons)
    return document | {"report": str(files.report)}


class SeamErrors:
    """Mean square errors of the pixels at seams, and of the others."""

    def __init__(self) -> None:
        self.sums, self.counts = np.zeros(2), np.zeros(2)

    def add(self, square: np.ndarray, at_seam: np.ndarray, counted: np.ndarray) -> dict[str, float]:
        """Add a view.

        Args:
            square: (H, W) mean square error over the channels.
            at_seam: (H, W) bool.
            counted: (H, W) bool, pixels that count.

        Returns:
            PSNR at the seam and elsewhere in this view, NaN where there are too few pixels.
        """
        found = {}
        for place, name in enumerate(("interior_psnr", "seam_psnr")):
            chosen = counted & (at_seam == bool(place))
            self.sums[place] += square[chosen].sum(dtype=np.float64)
            self.counts[place] += chosen.sum()
            enough = chosen.sum() >= FEWEST_PIXELS
            found[name] = psnr_from_mse(float(square[chosen].mean())) if enough else float("nan")
        return found

    def psnr(self, at_seam: bool) -> float:
        """Return the PSNR of all pixels at seams, or of the others; NaN without any."""
        count = self.counts[int(at_seam)]
        return psnr_from_mse(float(self.sums[int(at_seam)] / count)) if count else float("nan")


def score_levels(model: MergedModel, names: Sequence[str], progress: Progress) -> list[dict[str, Any]]:
    """Score each level of detail on test images, and keep the scores in tiles.json.

    Args:
        model: The merged model.
        names: Names of the test images.
        progress: Gets the stage and its fraction.

    Returns:
        Splats, bytes and `test_psnr` of each level.
    """
    views = [view for view in model.views.views if view.name in set(names)]
    levels = []
    for level in model.tiles.levels:
        scores = []
        for place, view in enumerate(views):
            progress(f"Scoring level {level.level}", place / len(views))
            (image,) = load_images(model.views, [view], model.survey.settings.width)
            cloud = model.in_view(image.camera, level.level)
            color = render_image(cloud, image.camera, model.survey.settings.sh_degree, effects=model.effects)
            scores.append(score_image(image, color).psnr)
        levels.append(replace(level, psnr=mean(scores) if scores else None))
    replace(model.tiles, levels=tuple(levels)).write()
    return [
        {"level": each.level, "splats": each.splats, "bytes": each.bytes, "test_psnr": each.psnr} for each in levels
    ]


def describe(document: dict[str, Any]) -> str:
    """Format a report as the lines that `survey report` prints."""
    lines = [
        f"Test photos: PSNR {number(document['test_psnr'], 2, ' dB')}, SSIM {number(document['test_ssim'], 3)}.",
        *([f"Left out, without a valid pixel: {', '.join(document['left_out'])}."] if document["left_out"] else []),
        f"At seams between blocks: {number(document['seam_psnr'], 2, ' dB')}, elsewhere "
        f"{number(document['interior_psnr'], 2, ' dB')}.",
        *(
            f"Level {each['level']}: {each['splats']:,} splats, {each['bytes'] / 1e6:.1f} MB, "
            f"{number(each['test_psnr'], 2, ' dB')}"
            for each in document["levels"]
        ),
        f"Processor time of all jobs: {time_text(document['processor_seconds'])}; most memory of one: "
        f"{document['peak_memory'] / 1e9:.1f} GB.",
        f"Report: {document['report']}",
    ]
    return "\n".join(lines)


def _write_page(
    files: SurveyFolder,
    document: dict[str, Any],
    model: MergedModel,
    blocks: Sequence[Block],
    comparisons: Sequence[ViewComparison],
) -> None:
    rows = []
    for name in model.survey.parts:
        block = files.read_block(name)
        done = document["blocks"][block.name]
        if done is None:
            rows.append([block.name, f"{len(block.images)}", "not done", "", "", "", ""])
            continue
        rows.append([
            block.name, f"{len(block.images)}", number(done["test_psnr"], 2), f"{done['gaussians_in_core']:,}",
            f"{done['iterations']:,}", time_text(done["processor_seconds"]), f"{done['peak_memory'] / 1e9:.1f}",
        ])  # fmt: skip
    heads = ("block or seam", "photos", "test PSNR, dB", "splats in core", "iterations", "processor time", "memory, GB")
    order = sorted(range(len(comparisons)), key=lambda place: list(document["views"].values())[place]["psnr"])
    chosen = (
        sorted({order[round(at)] for at in np.linspace(0, len(order) - 1, min(SHOWN, len(order)))}) if order else []
    )
    names = list(document["views"])
    captions = [f"PSNR {number(document['views'][names[place]]['psnr'], 2, ' dB')}" for place in chosen]
    levels = [
        [f"{each['level']}", f"{each['splats']:,}", f"{each['bytes'] / 1e6:.1f}", number(each["test_psnr"], 2)]
        for each in document["levels"]
    ]
    parts = [
        paragraph_html(
            f"{survey_title(model)} in {len(blocks)} blocks. Figures are of the {len(comparisons)} test photos, which "
            "no block uses."
        ),
        table_html(
            [
                ("PSNR", number(document["test_psnr"], 2, " dB"), "mean of the test photos"),
                ("SSIM", number(document["test_ssim"], 3), "1 means equal"),
                ("PSNR at seams", number(document["seam_psnr"], 2, " dB"),
                 f"of pixels up to {document['seam_band']:.3g} units from a border between blocks"),
                ("PSNR elsewhere", number(document["interior_psnr"], 2, " dB"), "of all other pixels with a surface"),
            ],
            styles=("", "number", "meaning"),
        ),
        "<h2>Blocks, and seams, whose splats replace those of two blocks along a border</h2>",
        _map(model, blocks, document),
        table_html(rows, heads, ["", *["number"] * 6]),
        "<h2>Levels of detail</h2>",
        table_html(levels, ("level", "splats", "MB", "test PSNR, dB"), ["number"] * 4),
        "<h2>Test photos</h2>",
        *views_html([comparisons[place] for place in chosen], captions),
    ]  # fmt: skip
    write_page(files.report, f"Survey {files.path.resolve().name}", parts)


def survey_title(model: MergedModel) -> str:
    """Return a line about a survey: its photos and its splats."""
    return f"{model.survey.images:,} photos, {model.tiles.levels[0].splats:,} splats"


def _map(model: MergedModel, blocks: Sequence[Block], document: dict[str, Any]) -> str:
    """Draw the blocks on the ground with their PSNR, and the cameras."""
    figure, (axes,) = new_plots("x on the ground, units", "y")
    left, bottom, right, top = model.survey.bounds
    ground = model.survey.ground.on_ground(np.stack([view.camera.centre for view in model.views.views]))
    axes.plot(ground[:, 0], ground[:, 1], ".", markersize=2, color="#888888", label="photos")
    for block in blocks:
        x = [max(block.core[0], left), min(block.core[2], right)]
        y = [max(block.core[1], bottom), min(block.core[3], top)]
        axes.plot([x[0], x[1], x[1], x[0], x[0]], [y[0], y[0], y[1], y[1], y[0]], color=BLUE, linewidth=1.2)
        done = document["blocks"][block.name]
        text = block.name if done is None else f"{block.name}\n{number(done['test_psnr'], 1, ' dB')}"
        axes.text(sum(x) / 2, sum(y) / 2, text, ha="center", va="center", color=INK, fontsize=8)
    axes.set_aspect("equal")
    return plot_html(figure, "Blocks on the ground, with the PSNR of their test photos; points are photos")
