"""cameras.html: the figures of a scene's cameras, their path, the points they share, and the doubtful places."""

import base64
from collections.abc import Sequence
from html import escape
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from scipy import sparse

from ..base.html_page import number, paragraph_html, table_html, write_page
from .colmap import Scene
from .inspect import assess_scene, what_is_doubtful
from .model_quality import ModelQuality
from .unregistered import explain_unregistered

_FEW_SHARED = 30
"""Points that an image shares with the one it shares most with, below which it hangs by a thread: COLMAP accepts a
pose from 30 points on."""
_MOST_ROWS = 50
"""Rows of a table, at most."""
_MOST_POINTS = 2500
"""Sparse points in a drawing, at most."""
_SIDE = 640
"""Width of a drawing in units of its own."""
_STYLE = """<style>
.path { stroke: var(--bar); fill: none; stroke-width: 1.5; }
.camera { fill: var(--bar); } .doubtful { fill: #d1495b; } .loop { stroke: #d1495b; stroke-dasharray: 6 4; }
.point { fill: currentColor; opacity: .28; } .scalebar { stroke: currentColor; stroke-width: 2; }
.drawing text { fill: currentColor; font-size: 14px; }
.drawings { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)); gap: 1.5rem; }
.matrix { max-width: 40rem; } .matrix img { image-rendering: pixelated; border: 1px solid var(--line); }
</style>"""


def write_camera_page(scene: Scene, path: Path, warnings: Sequence[str] = ()) -> None:
    """Write the page of a scene's cameras.

    Args:
        scene: The scene.
        path: The HTML file.
        warnings: Sentences that only those who made the model can say, such as which photos did not connect.

    Raises:
        InputError: When the model cannot be read any more, or the file cannot be written.
    """
    quality = assess_scene(scene)
    unregistered = explain_unregistered(scene)
    doubts = list(dict.fromkeys([*warnings, *what_is_doubtful(scene, quality, unregistered)]))
    shared = shared_points(scene)
    places = _doubtful_places(scene, quality, shared)
    parts = [_STYLE]
    parts += [paragraph_html(sentence, "note") for sentence in doubts]
    if not doubts:
        parts.append(paragraph_html("Nothing about these cameras is doubtful."))
    parts += ["<h2>Figures</h2>", table_html(_figures(quality), styles=("", "number", "meaning"))]
    parts += ["<h2>Path</h2>", _paths_html(scene, quality, set(places))]
    if shared.nnz:
        parts += ["<h2>Shared points</h2>", _matrix_html(scene, shared)]
    if places:
        rows = [(name, "; ".join(reasons)) for name, reasons in places.items()]
        parts += ["<h2>Doubtful places</h2>", *_long_table_html(rows, ("photo", "why"))]
    if unregistered:
        failed = [(image.name, image.reason) for image in unregistered]
        parts += ["<h2>Photos without a pose</h2>", *_long_table_html(failed, ("photo", "probable reason"))]
    write_page(path, f"Cameras of {scene.folder.name}", parts)


def shared_points(scene: Scene) -> sparse.csr_matrix:
    """Count the points that two views share, (V, V) int; the points of each on the diagonal."""
    counts = [len(view.point_indices) for view in scene.views]
    seen = sparse.csr_matrix(
        (
            np.ones(sum(counts), np.int32),
            np.concatenate([view.point_indices for view in scene.views]),
            np.concatenate([[0], np.cumsum(counts)]),
        ),
        (len(scene.views), len(scene.points.positions)),
    )
    return (seen @ seen.T).tocsr()


def _figures(quality: ModelQuality) -> list[tuple[str, str, str]]:
    rows = [
        ("Photos with a pose", f"{quality.registered} of {quality.image_count}", f"{quality.registered_share:.0%}"),
        ("Sparse points", number(quality.points, 0), ""),
        ("Photos that observe a point", number(quality.track_length, 1), "mean; more make points and poses certain"),
        ("Triangulation angle", number(quality.triangulation_angle, 1, "°"), "median over the points; from 2° on"),
        ("Reprojection error", number(quality.reprojection_error, 2, " px"), "mean; up to 2 px"),
    ]
    several = len(quality.focal_lengths) > 1
    for camera_id, focal in list(quality.focal_lengths.items())[:_MOST_ROWS]:
        error, field = quality.focal_errors[camera_id], quality.fields_of_view[camera_id]
        rows.append(
            (
                f"Focal length{f' of lens {camera_id}' if several else ''}",
                f"{focal:,.0f} px" + (f" ± {error * focal:,.1f}" if error is not None else ""),
                f"horizontal field of view {field:.0f}°"
                + (f"; standard error {error:.2%}" if error is not None else "; its error cannot be determined"),
            )
        )
    drift = quality.drift
    rows.append(
        ("Drift", f"{drift.fraction:.2%} ± {drift.error:.2%}", f"of the path, between {drift.first} and {drift.last}")
        if drift
        else ("Drift", number(None, 0), "cannot be determined: no place is visited twice")
    )
    return rows


def _doubtful_places(scene: Scene, quality: ModelQuality, shared: sparse.csr_matrix) -> dict[str, list[str]]:
    """Return what is doubtful about views by name, in the order of the views."""
    found: dict[str, list[str]] = {}
    if not shared.nnz:
        return found
    own = shared.diagonal()
    others = shared - sparse.diags(own, dtype=own.dtype)
    most = others.max(axis=1).toarray().ravel()
    few = set(quality.few_points)
    opened = {name: other for pair in quality.open_loops for name, other in (pair, pair[::-1])}
    for row, view in enumerate(scene.views):
        reasons = []
        if view.name in few:
            reasons.append(f"only {own[row]} points")
        if most[row] < _FEW_SHARED:
            reasons.append(f"shares at most {most[row]} points with any other photo")
        if view.name in opened:
            reasons.append(f"should show the same place as {opened[view.name]}, but shares no points with it")
        if reasons:
            found[view.name] = reasons
    return found


def _long_table_html(rows: list[tuple[str, str]], heads: tuple[str, str]) -> list[str]:
    more = len(rows) - _MOST_ROWS
    return [
        table_html(rows[:_MOST_ROWS], heads, ("", "text")),
        *([paragraph_html(f"And {more} more.")] if more > 0 else []),
    ]


# Path -----------------------------------------------------------------------------------------------------------------


def _paths_html(scene: Scene, quality: ModelQuality, doubtful: set[str]) -> str:
    """Draw the cameras from the top and from the side."""
    centres = np.stack([view.camera.centre for view in scene.views])
    right = _longest_level_direction(centres, scene.up)
    ahead = np.cross(scene.up, right)
    drawings = [
        _drawing(scene, quality, doubtful, centres, np.stack([right, ahead]), "From above"),
        _drawing(scene, quality, doubtful, centres, np.stack([right, scene.up]), "From the side"),
    ]
    legend = "The line joins the photos in the order of their names, from the ring on; each triangle opens towards "
    legend += "what the photo shows; grey: sparse points. Red: doubtful photos, and dashed lines between visits of a "
    legend += "place that disagree or are not joined. The vertical is estimated."
    return f'<div class="drawings">{"".join(drawings)}</div>{paragraph_html(legend)}'


def _longest_level_direction(centres: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the level unit vector (3,) along which the cameras extend most."""
    level = centres - centres.mean(0)
    level -= (level @ up)[:, None] * up
    direction = np.linalg.svd(level, full_matrices=False)[2][0]
    direction -= (direction @ up) * up
    length = np.linalg.norm(direction)
    if length < 1e-6:  # straight up, or all at one place
        direction = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
        length = np.linalg.norm(direction)
    return np.asarray(direction / length)


def _drawing(
    scene: Scene, quality: ModelQuality, doubtful: set[str], centres: np.ndarray, axes: np.ndarray, title: str
) -> str:
    """Draw cameras and points along two axes (2, 3)."""
    points = scene.points.positions[:: max(1, -(-len(scene.points.positions) // _MOST_POINTS))] @ axes.T
    places = centres @ axes.T
    low, high = np.percentile(points, [2, 98], axis=0)
    low, high = np.minimum(low, places.min(0)), np.maximum(high, places.max(0))
    extent = max(float((high - low).max()), 1e-12)
    scale = (_SIDE - 40) / extent
    height = float((high - low)[1]) * scale + 70

    def on_page(positions: np.ndarray) -> np.ndarray:
        x, y = ((positions - low) * scale + 20).T
        return np.stack([x, height - 30 - y], -1)

    shown = on_page(points[((points >= low) & (points <= high)).all(1)])
    drawn = on_page(places)
    dots = "".join(f'<circle class="point" cx="{x:.1f}" cy="{y:.1f}" r="1.2"/>' for x, y in shown)
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in drawn)
    index = {view.name: row for row, view in enumerate(scene.views)}
    pairs = list(quality.open_loops[:10])
    if quality.drift and any(doubt.kind == "drift" for doubt in quality.doubts):
        pairs.append((quality.drift.first, quality.drift.last))
    loops = ""
    for first, last in pairs:
        if first in index and last in index:
            (x1, y1), (x2, y2) = drawn[index[first]], drawn[index[last]]
            loops += f'<line class="loop" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'
    # A drone's thousand photos need small triangles, ten photos large ones.
    size = float(np.clip(0.5 * np.median(np.linalg.norm(np.diff(drawn, axis=0), axis=1)), 4, 12))
    cameras = []
    for view, (x, y) in zip(scene.views, drawn, strict=True):
        forward = axes @ view.camera.world_to_camera[2, :3] * [1, -1]
        side = np.array([-forward[1], forward[0]]) / max(float(np.linalg.norm(forward)), 1e-9)
        base = np.array([x, y]) + size * forward
        corners = [(x, y), base + 0.5 * size * side, base - 0.5 * size * side]
        style = "camera doubtful" if view.name in doubtful else "camera"
        cameras.append(
            f'<polygon class="{style}" points="{" ".join(f"{u:.1f},{v:.1f}" for u, v in corners)}"/>'
            f'<circle class="{style}" cx="{x:.1f}" cy="{y:.1f}" r="2.5"><title>{escape(view.name)}</title></circle>'
        )
    start = f'<circle class="path" cx="{drawn[0, 0]:.1f}" cy="{drawn[0, 1]:.1f}" r="8"/>'
    unit = 10.0 ** np.floor(np.log10(extent / 2))
    unit *= next(factor for factor in (5, 2, 1) if factor * unit <= extent / 2)
    end, below = 20 + unit * scale, height - 8
    ruler = (
        f'<line class="scalebar" x1="20" x2="{end:.1f}" y1="{below:.1f}" y2="{below:.1f}"/>'
        f'<text x="{end + 8:.1f}" y="{below + 4:.1f}">{unit:g} scene units</text>'
    )
    return (
        f'<figure><svg class="drawing" viewBox="0 0 {_SIDE} {height:.0f}" role="img" aria-label="{title}">'
        f'{dots}<polyline class="path" points="{line}"/>{start}{loops}{"".join(cameras)}{ruler}</svg>'
        f"<figcaption>{title}</figcaption></figure>"
    )


# Matrix ---------------------------------------------------------------------------------------------------------------


def _matrix_html(scene: Scene, shared: sparse.csr_matrix) -> str:
    """Draw the points that each two photos share as an image of a pixel for each pair."""
    counts = shared.toarray().astype(np.float32)
    np.fill_diagonal(counts, 0)
    most = max(float(counts.max()), 1.0)
    strength = np.sqrt(counts / most)  # few shared points are to be seen, too
    # The color of the bars on the page, clear where nothing is shared, so that it suits light and dark pages.
    pixels = np.zeros((*counts.shape, 4), np.uint8)
    pixels[..., :3] = (0x9E, 0x7F, 0x2A)
    pixels[..., 3] = np.where(counts > 0, 25 + 230 * strength, 0)
    larger = max(1, 400 // len(counts))
    pixels = np.kron(pixels, np.ones((larger, larger, 1), np.uint8))
    encoded = base64.b64encode(cv2.imencode(".png", pixels)[1].tobytes()).decode()
    first, last = escape(scene.views[0].name), escape(scene.views[-1].name)
    gaps = [
        (before.name, after.name)
        for row, (before, after) in enumerate(pairwise(scene.views))
        if counts[row, row + 1] == 0
    ]
    text = f"Each row and each column is a photo, from {first} to {last}; the stronger the color, the more points the "
    text += f"two share (most: {most:,.0f}). A band along the diagonal joins neighbours; marks away from it join "
    text += "visits of a place at different times."
    lines = [
        f'<figure class="matrix"><img alt="Matrix of shared points" src="data:image/png;base64,{encoded}">'
        f"<figcaption>{text}</figcaption></figure>"
    ]
    if gaps:
        lines.append(
            paragraph_html(
                f"Neighbours in the order of names that share no points: {len(gaps)} pairs, the first {gaps[0][0]} and "
                f"{gaps[0][1]}."
            )
        )
    return "".join(lines)
