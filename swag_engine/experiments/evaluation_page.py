"""evaluation.html: the metrics of an evaluation, and the images of every test view."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.html_page import NONE, number, paragraph_html, table_html, write_page
from ..evaluation.lpips import BACKBONES
from .page import ViewComparison, views_html


def write_evaluation_page(path: Path, evaluation: dict[str, Any], comparisons: Sequence[ViewComparison]) -> None:
    """Write the page of an evaluation.

    Args:
        path: The page.
        evaluation: What `evaluate_run` returned.
        comparisons: Comparison of each test view.

    Raises:
        InputError: When the page cannot be written.
    """
    parts = [
        paragraph_html(
            f"{evaluation['gaussians']:,} Gaussians after {evaluation['iteration']:,} iterations, compared with the "
            f"{len(comparisons)} test photos of {evaluation['scene']}, which training does not use."
        ),
        table_html(metric_rows(evaluation), styles=("", "number", "meaning")),
        *(paragraph_html(note, "note") for note in evaluation["notes"]),
        "<h2>View by view</h2>",
        view_table_html(evaluation["views"]),
        *views_html(comparisons),
    ]
    write_page(path, f"Evaluation of {Path(evaluation['run']).name}", parts)


def metric_rows(evaluation: dict[str, Any]) -> list[tuple[str, str, str]]:
    """List the metrics of a run.

    Args:
        evaluation: What `evaluate_run` returned.

    Returns:
        Label, value and explanation of each.
    """
    control, restored = evaluation["control_psnr"], evaluation["restored"]
    rows = [
        ("PSNR, mean of views", number(evaluation["test_psnr"], 2, " dB"), "higher is better"),
        ("PSNR, joint", number(evaluation["test_psnr_joint"], 2, " dB"),
         "of the mean square error of all views together, so that views with large errors weigh more"),
        ("PSNR, median-image baseline", number(control, 2, " dB"),
         "of the pixel-wise median of the training photos, for comparison"),
        ("SSIM, mean of views", number(evaluation["test_ssim"], 3), "1 means equal"),
    ]  # fmt: skip
    for name, backbone in BACKBONES.items():
        value = number(evaluation["test_lpips"][name], 3)
        rows.append((f"LPIPS, {backbone.title}", value, "perceptual distance; 0 means equal"))
    if number(restored["psnr"], 0) != NONE:
        rows += [
            ("Without water, PSNR", number(restored["psnr"], 2, " dB"), "against the true image without water"),
            ("Without water, color error", number(restored["delta_e"], 1),
             "CIE ΔE 2000; about 1 is the smallest that people see"),
        ]  # fmt: skip
    files = ", ".join(f"{name} {size:.1f} MB" for name, size in evaluation["megabytes"].items())
    return [
        *rows,
        ("Floater mass", number(100 * evaluation["floater_mass"], 1, " %"),
         "part of the Gaussians' weight that lies more than 5 % of the median range in front of the surface"),
        ("Photos with a camera", f"{evaluation['registered']} of {evaluation['images']}", ""),
        ("Gaussians", f"{evaluation['gaussians']:,}", files),
        ("Training time", number(evaluation["seconds"], 0, " s"), ""),
        ("Evaluated on", evaluation["machine"]["device"], machine_line(evaluation["machine"])),
    ]  # fmt: skip


def machine_line(machine: dict[str, Any]) -> str:
    """Format engine, backend, system and versions as one line."""
    versions = (f"{name} {version}" for name, version in machine["packages"].items() if version)
    engine = f"engine {machine['engine']}, backend {machine['backend']}"
    return ", ".join([engine, machine["system"], f"Python {machine['python']}", *versions])


def view_table_html(views: dict[str, Any]) -> str:
    """Make an HTML table of the metrics of each view, without those that no view has.

    Args:
        views: Metrics by name of the view.

    Returns:
        HTML.
    """
    columns: list[tuple[str, tuple[str, ...], int]] = [("PSNR, dB", ("psnr",), 2), ("SSIM", ("ssim",), 3)]
    columns += [(f"LPIPS, {backbone.title}", ("lpips", name), 3) for name, backbone in BACKBONES.items()]
    columns += [("Without water: PSNR, dB", ("restored", "psnr"), 2), ("ΔE 2000", ("restored", "delta_e"), 1)]
    columns = [column for column in columns if any(_at(view, column[1]) is not None for view in views.values())]
    rows = ([name, *(number(_at(view, keys), digits) for _, keys, digits in columns)] for name, view in views.items())
    heads = ["Photo", *(label for label, _, _ in columns)]
    return table_html(rows, heads, ["", *["number"] * len(columns)])


def _at(view: dict[str, Any], keys: tuple[str, ...]) -> float | None:
    found: Any = view
    for key in keys:
        found = (found or {}).get(key)
    return found
