"""report.html: quality, time, effects, development and settings of a run, and the command that repeats it."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from html import escape
from pathlib import Path
from typing import Any, TypeVar

from ..base.errors import InputError, reading, remedy
from ..base.files import read_text
from ..base.html_page import NONE, number, paragraph_html, table_html, write_page
from ..base.strict_json import from_json
from ..base.text import command_text
from ..evaluation.metrics import render_image
from ..formats.run_folder import RunFolder, read_json
from ..kernels.hardware import hardware_for
from ..planning.plan import STATES
from ..rendering.restoration import render_confidence
from ..scene.colmap import load_scene
from ..scene.images import load_images
from ..scene.split import split_views
from ..settings.settings import TrainSettings
from ..training.pacing.memory import TOO_LITTLE, is_shortage
from ..training.trainer import EVALUATION_STOPPED
from .color_chart import DELTA_E
from .develop_run import automatic_development
from .evaluate_run import compare_view, load_run, machine
from .evaluation_page import machine_line, metric_rows, view_table_html
from .page import BLUE, INK, ViewComparison, bars_html, new_plots, plot_html, views_html

T = TypeVar("T")
PAGE = "report.html"
"""Name of the page in the run's folder."""
SHOWN = 6
"""Test views that are shown with images, at most, so that the report takes seconds in any scene."""
OUTSIDE = "outside of iterations: validation, previews, trials of effects"
LOGGED = ("seconds", "psnr", "ssim", "gaussians")
"""Numbers that each validation in metrics.jsonl has."""


def write_report(folder: Path) -> Path:
    """Write report.html to a run's folder, from its files and from images of its newest checkpoint.

    The automatic development of the restored colors is found for that checkpoint, and kept in development.json.

    Parts whose file the run does not have are omitted.

    Args:
        folder: Folder of the run.

    Returns:
        Path of the report.

    Raises:
        InputError: Where there is no run or no checkpoint, a file is damaged, or the report cannot be written.
    """
    run = RunFolder(folder)
    scene_folder, settings, _ = run.read_config()
    loaded = load_run(folder)
    cloud, effects, state = loaded.cloud, loaded.effects, loaded.state
    metrics, forecast = _optional(run.metrics), _optional(folder / "forecast.json")
    evaluation = _optional(folder / "evaluation.json")
    if evaluation.get("iteration") != state["iteration"]:
        evaluation = {}
    views, figures = (metrics.get("views", {}), run.metrics)
    if evaluation.get("views"):
        views, figures = evaluation["views"], folder / "evaluation.json"
    log = _log(run.metrics_log)

    scene = load_scene(scene_folder)
    with reading(figures):
        held_out = _from_worst_to_best(views)
    chosen = held_out or split_views([view.name for view in scene.views]).test[:SHOWN]
    by_name = {view.name: view for view in scene.views if view.name in chosen}
    development = automatic_development(folder, cloud, effects)
    run.write_development(development)
    colors = run.color_view("auto")
    comparisons: list[ViewComparison] = []
    for image in load_images(scene, [by_name[name] for name in chosen if name in by_name], settings.width):
        if not image.valid.any():
            continue
        rendered = [
            render_image(shown, image.camera, settings.sh_degree, "auto", effects, amount, colors.at(amount))
            for shown, amount in ((loaded.through(1), 1), (cloud, 0))
        ]
        sure = None if loaded.confidence is None else render_confidence(cloud, loaded.confidence, image.camera)
        comparisons.append(compare_view(image, rendered[0], rendered[1] if effects.models else None, sure))

    where = machine(hardware_for("auto", with_wgpu=False))
    parts = [
        *_part(run.metrics, _summary, scene_folder, metrics, state, len(cloud)),
        *_curves(log, _part(folder / "forecast.json", _ranges, forecast)),
        *_part(folder / "forecast.json", _forecast, forecast),
        *_part(figures, _held_out, evaluation, views, comparisons),
        *_part(run.metrics, _ledger, metrics),
        *_part(run.plan, _effects, _optional(run.plan).get("effects", {})),
        *_part(run.water, _water, _optional(run.water)),
        *_development(development),
        *_part(run.chart, _chart, _optional(run.chart)),
        "<h2>Settings</h2>",
        table_html([(name.replace("_", " "), _shown(value)) for name, value in settings.to_json().items()]),
        "<h2>Repeat this run</h2>",
        f"<pre>{escape(command_line(scene_folder, folder, settings))}</pre>",
        paragraph_html(
            "On the same machine, the same settings and seed give exactly the same result, except with a time budget."
        ),
        paragraph_html(f"This page was written on {where['device']}: {machine_line(where)}."),
    ]
    write_page(folder / PAGE, f"Report of {folder.resolve().name}", parts)
    return folder / PAGE


def try_write_report(folder: Path) -> tuple[Path | None, str]:
    """Write the report of a run that has just ended, as `write_report` does.

    Args:
        folder: Folder of the run.

    Returns:
        Path of the report and an empty text; or None and a sentence that says why there is no report.
    """
    try:
        return write_report(folder), ""
    except InputError as error:
        problem = str(error)
    except (MemoryError, RuntimeError) as error:
        if not is_shortage(error):
            raise
        problem = TOO_LITTLE
    return None, f"The run is complete, but its report could not be written: {problem}"


def command_line(scene: Path, out: Path, settings: TrainSettings) -> str:
    """Return the command that repeats a run, with every setting that is not the default.

    Args:
        scene: Folder of the scene.
        out: Folder of the run.
        settings: Settings of the run.
    """
    words = ["swag", "train", str(scene), "--out", str(out.resolve())]
    for field in fields(TrainSettings):
        value = getattr(settings, field.name)
        if value != field.default:
            option = f"--{field.name.replace('_', '-')}"
            words += [option] if value is True else [option, str(value)]
    return command_text(words)


# Its parts ------------------------------------------------------------------------------------------------------------


def _summary(scene: Path, metrics: dict[str, Any], state: dict[str, Any], gaussians: int) -> list[str]:
    reached = f"{gaussians:,} Gaussians after {state['iteration']:,} iterations and {_time(state['seconds'])}"
    lines = [f"{reached}, trained on the photos of {scene}."]
    if metrics.get("evaluation_stopped"):
        lines.append(f"{EVALUATION_STOPPED} The command `evaluate RUN` scores the test photos.")
    elif metrics.get("views"):
        lines.append(
            f"On {len(metrics['views'])} test photos, which training does not use: PSNR "
            f"{number(metrics['test_psnr'], 2)} dB, SSIM {number(metrics['test_ssim'], 3)}. For comparison, the "
            f"median-image baseline (pixel-wise median of the training photos) has "
            f"{number(metrics['control_psnr'], 2)} dB."
        )
    elif metrics:
        lines.append("No test photos: the scene has too few photos to keep some out of training.")
    notes = []
    if metrics:
        notes = [metrics.get("water") or "No water was modelled: the colors are as photographed."]
        notes += [*filter(None, [metrics.get("overfitting")]), *metrics.get("notes", [])]
    if metrics.get("interrupted", True):
        notes.append(
            f"The run was interrupted; {remedy('train --resume', 'Continue in the panel Train')} continues it."
        )
    return [*map(paragraph_html, lines), *(paragraph_html(note, "note") for note in notes)]


def _curves(log: Sequence[dict[str, Any]], forecast: dict[str, list[float]]) -> list[str]:
    """Plot quality and number of Gaussians against seconds, as logged at each validation."""
    if not log:
        return []
    seconds = [entry["seconds"] for entry in log]
    plots = []
    for key, axis, caption in (
        ("psnr", "validation PSNR, dB", "Validation PSNR against training time"),
        ("ssim", "validation SSIM", "Validation SSIM against training time"),
        ("gaussians", "Gaussians", "Number of Gaussians against training time"),
    ):
        figure, (axes,) = new_plots("seconds", axis)
        axes.plot(seconds, [entry[key] for entry in log], "o-", color=BLUE, markersize=4)
        if key == "psnr" and {"seconds", "psnr"} <= set(forecast):
            (early, _, late), (low, _, high) = forecast["seconds"], forecast["psnr"]
            axes.fill_between([early, late], low, high, alpha=0.2, color=INK, linewidth=0)
            caption += "; grey: range of the forecast for the end of the run"
        if key == "gaussians":
            axes.set_ylim(bottom=0)
        axes.set_xlim(left=0)
        plots.append(plot_html(figure, caption))
    lines = ["<h2>Quality against time</h2>", f'<div class="plots">{"".join(plots)}</div>']
    if len(log) > 1 and (passed := seconds[-1] - seconds[-2]) > 0:
        gain = (log[-1]["psnr"] - log[-2]["psnr"]) / passed * 60
        text = f"At the end of the run, validation PSNR changed by {gain:+.2f} dB per minute."
        lines.append(paragraph_html(f"{text} Validation photos are used for decisions of the run, not for training."))
    return lines


def _ranges(forecast: dict[str, Any]) -> dict[str, list[float]]:
    """Return the values of the forecast that have a low, a likely and a high number."""
    return {
        name: value
        for name, value in forecast.get("expected", {}).items()
        if isinstance(value, list) and len(value) == 3
    }


def _forecast(forecast: dict[str, Any]) -> list[str]:
    titles = {"seconds": ("Time, s", 0), "psnr": ("Validation PSNR, dB", 2), "memory_mb": ("Memory, MB", 0)}
    ranges, rows = _ranges(forecast), []
    for name, (title, digits) in titles.items():
        likely, outcome = forecast.get("expected", {}).get(name), forecast.get("outcome", {}).get(name)
        if name in ranges:
            low, likely, high = ranges[name]
            span = f"{number(low, digits)} to {number(high, digits)}"
            inside = "" if outcome is None else "yes" if low <= outcome <= high else "no"
        elif isinstance(likely, int | float):
            span, inside = "", ""
        else:
            continue
        rows.append((title, number(likely, digits), span, number(outcome, digits), inside))
    if not rows:
        return []
    heads = ("", "forecast", "range", "outcome", "within the range")
    return ["<h2>Forecast and outcome</h2>", table_html(rows, heads, ("", *["number"] * 3))]


def _held_out(evaluation: dict[str, Any], views: dict[str, Any], comparisons: Sequence[ViewComparison]) -> list[str]:
    if not comparisons:
        return []
    lines = ["<h2>Test views</h2>"]
    if evaluation:
        lines.append(table_html(metric_rows(evaluation), styles=("", "number", "meaning")))
    if views:
        lines.append(view_table_html(views))
    if not evaluation:
        lines.append(
            paragraph_html(
                "The command line has commands that add LPIPS, floaters and color errors here: `evaluate RUN`, then "
                "`report RUN`."
            )
        )
    if len(views) > len(comparisons):
        lines.append(paragraph_html(f"{len(comparisons)} of the {len(views)} views, in ascending order of PSNR:"))
    captions = [f"{number(views[view.name]['psnr'], 2)} dB" if view.name in views else "" for view in comparisons]
    return lines + views_html(comparisons, captions)


def _ledger(metrics: dict[str, Any]) -> list[str]:
    """Show the time of each part, which together are the time of the run."""
    ledger = metrics.get("ledger", {})
    if not ledger:
        return []
    whole = 1000 * metrics.get("seconds", 0.0) / max(1, metrics.get("iteration", 0))
    parts = ledger | {OUTSIDE: max(0.0, whole - sum(ledger.values()))}
    return ["<h2>Time by part</h2>", bars_html(parts, "part", "ms per iteration")]


def _effects(effects: dict[str, Any]) -> list[str]:
    """Show the plan: state, reason, evidence with thresholds, and cost of each effect."""
    rows = [
        (
            name.replace("_", " "),
            STATES[effect["state"]],
            effect.get("reason", ""),
            evidence_text(effect.get("evidence") or {}),
            number(effect.get("cost_ms"), 2),
        )
        for name, effect in effects.items()
    ]
    heads = ("effect", "state", "reason", "evidence", "ms per iteration")
    styles = ("", "", "text", "meaning", "number")
    shown = (
        table_html(rows, heads, styles)
        if rows
        else paragraph_html(
            remedy(
                "This run has no plan. Run `plan SCENE --out RUN` and then `report RUN` to add it.",
                "This run has no plan. Press Plan in Effects before the next training.",
            )
        )
    )
    return ["<h2>Effects</h2>", shown]


def evidence_text(evidence: dict[str, Any]) -> str:
    """Format evidence as text, each value with its threshold.

    Args:
        evidence: Values by name; a threshold is stored as NAME_least or NAME_most.

    Returns:
        One line.
    """
    words = []
    for name, value in evidence.items():
        if name.endswith(("_least", "_most")):
            continue
        text = f"{name.replace('_', ' ')} {_shown(value)}"
        for suffix, title in (("_least", "at least"), ("_most", "at most")):
            if name + suffix in evidence:
                text += f" ({title} {_shown(evidence[name + suffix])})"
        words.append(text)
    return "; ".join(words)


def _water(water: dict[str, Any]) -> list[str]:
    """Show the coefficients of water.json that have a value for each channel."""
    titles = {"beta_D": "attenuation", "beta_B": "backscatter", "B_inf": "background light"}
    per = "metre" if water.get("per") == "metre" else "scene unit"
    rows = []
    for name, title in titles.items():
        values = water.get(name)
        if isinstance(values, list) and len(values) == 3:
            unit = "" if name == "B_inf" else f" per {per}"
            rows.append((title + unit, *(number(value, 4) for value in values)))
    heads = ("", "red", "green", "blue")
    return ["<h2>Water</h2>", table_html(rows, heads, ("", *["number"] * 3))] if rows else []


def _development(development: dict[str, Any]) -> list[str]:
    """Show the automatic development, and what it does to clipped pixels."""
    if "clipped" not in development:
        return []
    sentence = f"{development['note']} Images without water are shown with this development; scores are without it."
    rows = [
        (title, *(f"{fraction:.2%}" for fraction in development[name]))
        for title, name in (("without development", "clipped_before"), ("with development", "clipped"))
    ]
    heads = ("clipped pixels of all training views", "red", "green", "blue")
    return ["<h2>Development</h2>", paragraph_html(sentence), table_html(rows, heads, ("", *["number"] * 3))]


def _chart(chart: dict[str, Any]) -> list[str]:
    """Show the color chart: delta E before and after the correction, and the water that the chart says."""
    try:
        names = ", ".join(photo["name"] for photo in chart["photos"])
        delta_e = [(title, number(chart["delta_e"].get(name), 1)) for name, title in DELTA_E.items()]
        from_chart, error, of_run = (chart["beta_D"][name] for name in ("chart", "error", "run"))
        per, notes = chart["beta_D"]["per"], chart["notes"]
    except (KeyError, TypeError, AttributeError):
        return []
    lines = [
        "<h2>Color chart</h2>",
        paragraph_html(f"Mean CIE delta E 2000 of the patches from their known colors, in {names}."),
        table_html(delta_e, ("colors", "delta E"), ("", "number")),
    ]
    rows = [
        (title, *(number(value, 4) for value in values))
        for title, values in (("from the chart", from_chart), ("its standard error", error), ("of the run", of_run))
        if values
    ]
    if rows:
        lines.append(table_html(rows, (f"attenuation per {per}", "red", "green", "blue"), ("", *["number"] * 3)))
    return lines + [paragraph_html(note, "note") for note in notes]


def _from_worst_to_best(views: dict[str, Any]) -> list[str]:
    """Return the names of at most SHOWN views, evenly spaced in ascending order of PSNR."""
    order = sorted((name for name in views if views[name]["psnr"] is not None), key=lambda name: views[name]["psnr"])
    count = min(SHOWN, len(order))
    return [order[round(i * (len(order) - 1) / max(1, count - 1))] for i in range(count)]


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} minutes"


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(map(_shown, value))
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(entry)}" for name, entry in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "not known" if value is None else str(value) or NONE


def _part(path: Path, make: Callable[..., T], *arguments: Any) -> T:
    """Return what a function makes of a file; raises InputError where the file is damaged."""
    with reading(path):
        return make(*arguments)


def _optional(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file, an empty one without the file."""
    return read_json(path, "") if path.exists() else {}


def _log(path: Path) -> list[dict[str, Any]]:
    """Return the validations in metrics.jsonl, without lines that cannot be read: the last one may be cut short."""
    entries = []
    for line in read_text(path, errors="replace").splitlines() if path.exists() else ():
        try:
            entries.append(from_json(line))
        except ValueError:
            continue
    return [
        entry
        for entry in entries
        if isinstance(entry, dict) and all(type(entry.get(key)) in (int, float) for key in LOGGED)
    ]
