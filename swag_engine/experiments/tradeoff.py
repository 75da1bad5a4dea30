"""Tradeoff of quality against time: runs of many sizes on one scene, scored at one width, and their Pareto front."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path, write_csv
from ..base.html_page import number, paragraph_html, table_html, write_page
from ..evaluation.lpips import BACKBONES, Lpips, load_lpips
from ..evaluation.metrics import ViewScore, mask_invalid, mean, mean_score, median_image_psnr, render_image, score_image
from ..formats.run_folder import RunFolder, write_json
from ..kernels.hardware import hardware_for
from ..scene.colmap import load_scene
from ..scene.images import TrainingImage, load_images
from ..scene.split import split_views
from .ablate import metrics_of_run, settings_of_run
from .evaluate_run import load_run, machine
from .grid import Grid
from .page import BLUE, INK, new_plots, plot_html

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Quality:
    """A metric that is compared with time.

    Attributes:
        title: Label with unit.
        sign: 1 where higher is better, -1 where lower is.
        digits: Digits after the decimal point.
    """

    title: str
    sign: int
    digits: int


QUALITIES = {"psnr": Quality("PSNR, dB", 1, 2), "ssim": Quality("SSIM", 1, 3)} | {
    f"lpips_{name}": Quality(f"LPIPS, {backbone.title}", -1, 3) for name, backbone in BACKBONES.items()
}


def tradeoff(
    scene_folder: Path,
    out: Path,
    grid: Grid,
    score_width: int = 0,
    weights_dir: Path | None = None,
    on_run: Callable[[str, dict[str, Any]], None] = lambda name, figures: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Train every run of a grid and score all on the test views at one width, so that they can be compared.

    Writes tradeoff.json, .csv, .png and .html after each run. A run that exists is not trained again, and one that was
    stopped is continued.

    Args:
        scene_folder: Folder of the scene.
        out: Folder of the runs and of the files.
        grid: The runs.
        score_width: Width in pixels at which runs are scored, 0 for the largest training width.
        weights_dir: Folder where networks are searched first.
        on_run: Gets the name and the row of each run.
        should_stop: Asked between two iterations.

    Returns:
        The document in tradeoff.json: `rows` with name, settings, seconds of training, Gaussians, each of QUALITIES
        (None where it is not known), `gain` (PSNR above the median-image baseline, as a fraction of the largest) and
        `dominated` (by quality, the name of a run that is no slower, no worse, and better in one of both; None on the
        Pareto front); `control_psnr` of the median-image baseline, `machine`, `interrupted`, `notes`.

    Raises:
        InputError: As `train`, where the scene has no test views, and where `out` has runs of another scene or of
            other settings.
    """
    asked, scene = grid.runs(), load_scene(scene_folder)
    runs = [replace(run, settings=settings_of_run(scene, out / run.folder, run.settings)) for run in asked]
    width = score_width or max(run.settings.width for run in runs)
    split = split_views([view.name for view in scene.views])
    if not split.test:
        raise InputError(f"{scene_folder} has too few photos to keep some as test views, which a tradeoff needs.")
    images = load_images(scene, [view for view in scene.views if view.name not in split.validation], width)
    test = [image for image in images if image.camera.name in split.test and image.valid.any()]
    control = median_image_psnr([image for image in images if image.camera.name in split.train], test)
    lpips, notes = load_lpips(weights_dir)
    document: dict[str, Any] = {"scene": str(scene_folder), "score_width": max(image.camera.width for image in test)}
    document |= {
        "machine": machine(hardware_for("auto")),
        "control_psnr": control,
        "notes": notes,
        "rows": [],
        "interrupted": False,
    }
    for run in runs:
        metrics = metrics_of_run(scene_folder, out / run.folder, run.settings, weights_dir, should_stop)
        if metrics is None:
            document["interrupted"] = True
            break
        row: dict[str, Any] = {"name": run.name, "folder": run.folder, "settings": run.settings.to_json()}
        row |= {"seconds": metrics["seconds"], "gaussians": metrics["gaussians"]}
        row |= score_run(out / run.folder, test, lpips)
        document["rows"].append(row)
        mark_dominated(document["rows"], control)
        write_tradeoff(out, document)
        on_run(run.name, row)
    return document


def score_run(folder: Path, images: Sequence[TrainingImage], lpips: dict[str, Lpips]) -> dict[str, float | None]:
    """Score the newest checkpoint of a run at the size of given images.

    Args:
        folder: Folder of the run.
        images: Test images.
        lpips: LPIPS by backbone.

    Returns:
        Mean of each of QUALITIES over the images, None where it is not known.
    """
    run = load_run(folder)
    cloud, effects = run.through(1), run.effects
    _, settings, _ = RunFolder(folder).read_config()
    scores: list[ViewScore] = []
    distances: dict[str, list[float]] = {name: [] for name in lpips}
    for image in images:
        color = render_image(cloud, image.camera, settings.sh_degree, effects=effects)
        scores.append(score_image(image, color))
        shown, target, _ = mask_invalid(image, color)
        for name, network in lpips.items():
            distances[name].append(network(shown, target))
    psnr, ssim = mean_score(scores)
    known = {f"lpips_{name}": mean(distances[name]) if name in lpips else None for name in BACKBONES}
    return {"psnr": psnr, "ssim": ssim} | known


def mark_dominated(rows: Sequence[dict[str, Any]], control: float) -> None:
    """Fill in `gain` and `dominated` of every row.

    Args:
        rows: The rows, which are changed.
        control: PSNR of the median-image baseline, dB.
    """
    best = max(row["psnr"] for row in rows) - control
    for row in rows:
        row["gain"] = (row["psnr"] - control) / best if best > 0 else None
        row["dominated"] = {}
    for name, quality in QUALITIES.items():
        points = [(row["seconds"], quality.sign * row[name] if _known(row[name]) else -np.inf) for row in rows]
        for row, by in zip(rows, find_dominating(points), strict=True):
            row["dominated"][name] = None if by is None else rows[by]["name"]


def find_dominating(points: Sequence[tuple[float, float]]) -> list[int | None]:
    """Find for each point one that dominates it: no slower, no worse, and better in one of both.

    Args:
        points: Seconds and quality, where higher is better.

    Returns:
        For each point the index of the best point that dominates it, None on the Pareto front.
    """
    found: list[int | None] = []
    for seconds, quality in points:
        better = [
            (other[1], -other[0], index)
            for index, other in enumerate(points)
            if other[0] <= seconds and other[1] >= quality and other != (seconds, quality)
        ]
        found.append(max(better)[2] if better else None)
    return found


def _known(value: float | None) -> bool:
    return value is not None and bool(np.isfinite(value))


# Files ----------------------------------------------------------------------------------------------------------------


def write_tradeoff(out: Path, document: dict[str, Any]) -> None:
    """Write tradeoff.json, .csv, .png and .html.

    Args:
        out: Folder of the files.
        document: The document in tradeoff.json.

    Raises:
        InputError: When a file cannot be written.
    """
    rows = document["rows"]
    shown = [name for name in QUALITIES if any(_known(row[name]) for row in rows)]
    write_json(out / "tradeoff.json", document)
    sizes, figures = ("preset", "effects", "iterations", "width", "max_gaussians"), (*QUALITIES, "gain")
    columns = ["name", *sizes, "seconds", "gaussians", *figures]
    table = [
        [row["name"], *(row["settings"][size] for size in sizes), *(row[name] for name in columns[len(sizes) + 1 :])]
        + [row["dominated"][name] or "" for name in shown]
        for row in rows
    ]
    write_csv(out / "tradeoff.csv", [*columns, *(f"{name}_dominated" for name in shown)], table)
    figure, plots = new_plots("seconds of training", *(QUALITIES[name].title for name in shown))
    for axes, name in zip(plots, shown, strict=True):
        draw_front(axes, rows, name)
    key = "\n".join("  ".join([str(index + 1), row["name"], _by(row, shown)]) for index, row in enumerate(rows))
    figure.set_size_inches(figure.get_figwidth(), figure.get_figheight() + 0.16 * len(rows))
    figure.supxlabel(key, x=0.01, ha="left", fontsize=8, color=INK)
    with atomic_path(out / "tradeoff.png") as temporary:
        figure.savefig(temporary, format="png", dpi=130, facecolor="white")
    _write_html(out / "tradeoff.html", document, shown)


def draw_front(axes: "Axes", rows: Sequence[dict[str, Any]], name: str) -> None:
    """Draw every run as a numbered point, and a line along the Pareto front.

    Args:
        axes: The plot.
        rows: The runs.
        name: Name of the quality.
    """
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    known = [(index, row) for index, row in enumerate(rows) if _known(row[name])]
    front = sorted((row["seconds"], row[name]) for _, row in known if row["dominated"][name] is None)
    axes.step(*zip(*front, strict=True), where="post", color=BLUE, linewidth=1.2)
    for index, row in known:
        color = BLUE if row["dominated"][name] is None else "#888888"
        axes.plot(row["seconds"], row[name], "o", color=color, markersize=5)
        axes.annotate(str(index + 1), (row["seconds"], row[name]), (4, 4), textcoords="offset points", fontsize=8,
                      color=color)  # fmt: skip
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())


def _by(row: dict[str, Any], shown: Sequence[str]) -> str:
    """Return the runs that dominate a run, and in which qualities, as text."""
    by: dict[str, list[str]] = {}
    for name in shown:
        if row["dominated"][name]:
            by.setdefault(row["dominated"][name], []).append(QUALITIES[name].title.partition(",")[0])
    texts = (f"{other} in {' and '.join(dict.fromkeys(titles))}" for other, titles in by.items())
    return f"dominated by {'; '.join(texts)}" if by else ""


def _write_html(path: Path, document: dict[str, Any], shown: Sequence[str]) -> None:
    rows, where = document["rows"], document["machine"]
    plots = []
    for name in shown:
        figure, (axes,) = new_plots("seconds of training", QUALITIES[name].title)
        draw_front(axes, rows, name)
        better = "higher" if QUALITIES[name].sign > 0 else "lower"
        plots.append(
            plot_html(figure, f"{QUALITIES[name].title} against time; {better} is better; grey: dominated runs")
        )
    heads = ["", "run", "seconds", "Gaussians", *(QUALITIES[name].title for name in shown), "gain", "dominated"]
    lines = [
        [str(index + 1), row["name"], number(row["seconds"], 1), number(row["gaussians"], 0)]
        + [number(row[name], QUALITIES[name].digits) for name in shown]
        + [number(row["gain"] and 100 * row["gain"], 0, " %"), _by(row, shown) or "no"]
        for index, row in enumerate(rows)
    ]
    styles = ("number", "", *["number"] * (3 + len(shown)), "meaning")
    parts = [
        paragraph_html(
            f"Runs of different sizes on {document['scene']}, all scored on the test photos at "
            f"{document['score_width']} pixels width. A run is dominated if another run is no slower, no worse, and "
            "better in one of both. The line joins the runs that are not dominated."
        ),
        f'<div class="plots">{"".join(plots)}</div>',
        "<h2>Runs</h2>",
        table_html(lines, heads, styles),
        paragraph_html(
            f"Gain: PSNR above the median-image baseline (pixel-wise median of the training photos, "
            f"{number(document['control_psnr'], 2)} dB), as a percentage of the best run's."
        ),
        *(paragraph_html(note, "note") for note in document["notes"]),
        paragraph_html(f"{where['device']}, {where['system']}, engine {where['engine']}, backend {where['backend']}."),
    ]
    write_page(path, f"Quality against time: {Path(document['scene']).resolve().name}", parts)


def describe(document: dict[str, Any]) -> str:
    """Format the result of `tradeoff` as a Markdown table, the fastest run first."""
    shown = [name for name in QUALITIES if any(_known(row[name]) for row in document["rows"])]
    heads = ["run", "seconds", "Gaussians", *(QUALITIES[name].title for name in shown), "gain"]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for row in sorted(document["rows"], key=lambda row: row["seconds"]):
        marks = ["" if row["dominated"][name] else " *" for name in shown]
        figures = [number(row[name], QUALITIES[name].digits) + mark for name, mark in zip(shown, marks, strict=True)]
        gain = number(row["gain"] and 100 * row["gain"], 0, " %")
        cells = [row["name"], number(row["seconds"], 1), number(row["gaussians"], 0), *figures, gain]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "* not dominated: no other run is as fast and better", *document["notes"]])
