"""An evaluation as a page that a browser shows without a network: figures, and every held-out view in pictures."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..files import atomic_path
from .lpips import BACKBONES

FULL_ERROR = 51
"""Difference in 8-bit values (a fifth of all) from which on the error map is brightest."""

STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; margin: 0 auto; padding: 1.5rem; max-width: 90rem; }
h1, h2, h3 { line-height: 1.2; }
h2 { margin-top: 2.5rem; }
h3 { margin: 1.5rem 0 .5rem; font-size: 1rem; }
p { max-width: 48rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .9rem .3rem 0; text-align: left; vertical-align: baseline; border-bottom: 1px solid #8886; }
.number { text-align: right; white-space: nowrap; }
.meaning, figcaption { font-size: .875rem; opacity: .8; }
.pictures { display: grid; grid-template-columns: repeat(3, 1fr); gap: .8rem; }
@media (max-width: 50rem) { .pictures { grid-template-columns: 1fr; } }
figure { margin: 0; }
figure img { display: block; width: 100%; }
.scale { width: 8rem; height: .7rem; margin: 0 .4rem; }
"""


@dataclass(frozen=True)
class Compared:
    """One held-out view: photograph and render (H, W, 3) uint8 sRGB, valid (H, W) bool."""

    name: str
    photograph: np.ndarray
    render: np.ndarray
    valid: np.ndarray


def write_page(path: Path, evaluation: dict[str, Any], pictures: Sequence[Compared]) -> None:
    """Write what evaluate_run() found as one HTML file, whole or not at all. Raises InputError when it cannot be."""
    title = f"Evaluation of {escape(Path(evaluation['run']).name)}"
    columns = _columns(evaluation["views"])
    lines = [
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>',
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head><body>',
        f"<h1>{title}</h1>",
        f"<p>{evaluation['gaussians']:,} Gaussians after {evaluation['iteration']:,} iterations, compared with "
        f"{len(pictures)} photographs of {escape(evaluation['scene'])} that training never saw.</p>",
        '<div class="wide"><table>',
        *(
            f'<tr><td>{label}</td><td class="number">{escape(value)}</td><td class="meaning">{meaning}</td></tr>'
            for label, value, meaning in _figures(evaluation)
        ),
        "</table></div>",
        *(f"<p>{escape(note)}</p>" for note in evaluation["notes"]),
        "<h2>View by view</h2>",
        '<div class="wide"><table>',
        _row("th", "Photograph", [label for label, _, _ in columns]),
        *(
            _row("td", escape(name), [_number(_at(view, keys), digits) for _, keys, digits in columns])
            for name, view in evaluation["views"].items()
        ),
        "</table></div>",
        f"<p>Error maps show the mean difference of red, green and blue: 0 {_image(_scale(), 'scale')} "
        f"{FULL_ERROR / 255:.0%} of the full scale and more. Grey was not compared.</p>",
    ]
    for view in pictures:
        shown = {"photograph": view.photograph, "render": view.render, "error": _error_map(view)}
        figures = (f"<figure>{_image(p)}<figcaption>{name}</figcaption></figure>" for name, p in shown.items())
        lines += [f"<h3>{escape(view.name)}</h3>", f'<div class="pictures">{"".join(figures)}</div>']
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join([*lines, "</body></html>\n"]), encoding="utf-8")


def _figures(evaluation: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Rows of the first table: label, figure, what it means."""
    control, machine, restored = evaluation["control_psnr"], evaluation["machine"], evaluation["restored"]
    rows = [
        ("PSNR, mean of views", _number(evaluation["test_psnr"], 2, " dB"), "higher is better"),
        ("PSNR, joint", _number(evaluation["test_psnr_joint"], 2, " dB"),
         "of the mean square error of all views together: a view that fails weighs more"),
        ("PSNR of the median photograph", _number(control, 2, " dB"),
         "what the pixel-wise median of the training photographs would reach"),
        ("SSIM", _number(evaluation["test_ssim"], 3), "1 is equal"),
    ]  # fmt: skip
    for name, backbone in BACKBONES.items():
        value = _number(evaluation["test_lpips"][name], 3)
        rows.append((f"LPIPS, {backbone.title}", value, "difference as people see it; 0 is equal"))
    if _number(restored["psnr"], 0) != NONE:
        rows += [
            ("Without water, PSNR", _number(restored["psnr"], 2, " dB"), "against the true picture without water"),
            ("Without water, colour error", _number(restored["delta_e"], 1),
             "CIE &Delta;E 2000; about 1 is the least that an eye sees"),
        ]  # fmt: skip
    versions = ", ".join(f"{name} {version}" for name, version in machine["packages"].items() if version)
    rows += [
        ("Floater mass", _number(100 * evaluation["floater_mass"], 1, " %"),
         "share of what is drawn that hangs more than 5 % of the median range in front of what is seen"),
        ("Registered photographs", f"{evaluation['registered']} of {evaluation['images']}", ""),
        ("Gaussians", f"{evaluation['gaussians']:,}",
         ", ".join(f"{escape(name)} {size:.1f} MB" for name, size in evaluation["megabytes"].items())),
        ("Training time", _number(evaluation["seconds"], 0, " s"), ""),
        ("Evaluated on", machine["device"],
         escape(f"{machine['system']}, Python {machine['python']}, backend {machine['backend']}, {versions}")),
    ]  # fmt: skip
    return rows


def _columns(views: dict[str, Any]) -> list[tuple[str, tuple[str, ...], int]]:
    """Columns of the table of views: label, keys of the figure in a view, decimals."""
    columns: list[tuple[str, tuple[str, ...], int]] = [("PSNR, dB", ("psnr",), 2), ("SSIM", ("ssim",), 3)]
    columns += [(f"LPIPS, {backbone.title}", ("lpips", name), 3) for name, backbone in BACKBONES.items()]
    columns += [
        ("Without water: PSNR, dB", ("restored", "psnr"), 2),
        ("&Delta;E 2000", ("restored", "delta_e"), 1),
    ]
    return [column for column in columns if any(_at(view, column[1]) is not None for view in views.values())]


def _at(view: dict[str, Any], keys: tuple[str, ...]) -> float | None:
    found: Any = view
    for key in keys:
        found = (found or {}).get(key)
    return found


NONE = "–"


def _number(value: float | None, digits: int, unit: str = "") -> str:
    return NONE if value is None or not np.isfinite(value) else f"{value:,.{digits}f}{unit}"


def _row(tag: str, name: str, values: Sequence[str]) -> str:
    numbers = "".join(f'<{tag} class="number">{value}</{tag}>' for value in values)
    return f"<tr><{tag}>{name}</{tag}>{numbers}</tr>"


def _error_map(view: Compared) -> np.ndarray:
    """(H, W, 3) uint8: the mean absolute difference over the channels, in colours from black to bright."""
    error = np.abs(view.render.astype(np.float32) - view.photograph).mean(-1)
    return np.where(view.valid[..., None], _colors(error / FULL_ERROR), np.uint8(128))


def _scale() -> np.ndarray:
    return _colors(np.tile(np.linspace(0, 1, 128, dtype=np.float32), (8, 1)))


def _colors(values: np.ndarray) -> np.ndarray:
    mapped = cv2.applyColorMap((values.clip(0, 1) * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    return cv2.cvtColor(mapped, cv2.COLOR_BGR2RGB)


def _image(pixels: np.ndarray, style: str = "") -> str:
    """An element that holds its picture itself."""
    encoded = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    return f'<img class="{style}" alt="" src="data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}">'
