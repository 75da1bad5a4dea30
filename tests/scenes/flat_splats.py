"""Splats laid on known surfaces, with labels, and runs of them: areas, heights and colors are exactly known."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from swag_engine.formats.run_folder import RunFolder, write_json
from swag_engine.scene.georeference import Georeference, Placement, write_georeference
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.splats import Splats, concatenate
from swag_engine.splats.transform import C0, quaternions, transformed

Heights = Callable[[np.ndarray, np.ndarray], np.ndarray]
GEOREFERENCE = Georeference(
    metres_per_unit=0.5, error=0.01, method="targets", axes="full",
    rotation=np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), translation=np.zeros(3),
    placement=Placement("EPSG:32633", (500_000.0, 4_000_000.0, -12.0)),
)  # fmt: skip
"""A scene of half metres with y down and z to the north."""


def sheet(
    left: float,
    bottom: float,
    right: float,
    top: float,
    spacing: float,
    height: Heights | float = 0.0,
    color: tuple[float, float, float] = (0.5, 0.5, 0.5),
    label: int = 0,
) -> Splats:
    """Flat Gaussians on a grid, tangent to the surface z = height(x, y), in metres with z up."""
    columns, rows = round((right - left) / spacing), round((top - bottom) / spacing)
    x, y = np.meshgrid(
        left + (np.arange(columns) + 0.5) * (right - left) / columns,
        bottom + (np.arange(rows) + 0.5) * (top - bottom) / rows,
    )
    x, y = x.ravel(), y.ravel()
    at: Heights = height if callable(height) else lambda x, y: np.full_like(x, height)
    step = 1e-4
    slope_x = (at(x + step, y) - at(x - step, y)) / (2 * step)
    slope_y = (at(x, y + step) - at(x, y - step)) / (2 * step)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    along = np.stack([np.ones_like(x), np.zeros_like(x), slope_x], 1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    turn = np.stack([along, np.cross(normal, along), normal], 2)
    count = len(x)
    scales = np.tile([0.6 * spacing, 0.6 * spacing, 1e-3 * spacing], (count, 1))
    scales[:, 0] /= along[:, 0]
    sh = np.tile((np.array(color) - 0.5) / C0, (count, 1, 1))
    return Splats(
        np.stack([x, y, at(x, y)], 1).astype(np.float32),
        quaternions(turn).astype(np.float32),
        scales.astype(np.float32),
        np.full(count, 0.9, np.float32),
        sh.astype(np.float32),
        {"label": np.full(count, label, np.int32)},
    )


def write_run(
    folder: Path, parts: list[Splats], labels: tuple[str, ...] = (), measured: Georeference | None = GEOREFERENCE
) -> Path:
    """Write a finished run whose splats are `parts` in metres, and its scene; return the run's folder."""
    scene = folder / "scene"
    scene.mkdir(parents=True)
    splats = concatenate(parts)
    to_scene = np.linalg.inv((measured or GEOREFERENCE).matrix)
    in_scene = transformed(splats, to_scene)
    run = RunFolder(folder / "run")
    run.path.mkdir()
    run.write_config(scene, TrainSettings(), [0.0, -1.0, 0.0])
    run.write_result(in_scene, [0.0, -1.0, 0.0])
    if measured:
        write_georeference(scene, measured)
    if labels:
        table = [{"id": i, "name": name, "count": 1, "fraction": 0.1} for i, name in enumerate(labels, start=1)]
        write_json(run.path / "labels.json", {"labels": table, "unlabelled": 0, "embedder": "none"})
    return run.path
