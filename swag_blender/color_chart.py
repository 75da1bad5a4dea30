"""A color chart in the photos of a run: the engine's request, and the panel that shows what was found."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.run_folder import RunFolder, read_json
from ..swag_engine.scene.cameras import Camera
from .blender_types import present
from .run_list import folder_of, photographed_run, shown_run
from .scene_import import PHOTO_KEY
from .sidebar import SwagPanel, draw_job, draw_outcome

ROWS = {
    "Photos": "photos",
    "Without Water": "restored",
    "Corrected": "corrected",
    "Patch Left Out": "left_out_patches",
}
"""Labels of the rows, and the entries of `delta_e` in chart.json."""
LISTED = 5
"""Photos that are listed by name, at most."""


def request(obj: bpy.types.Object, marked: str) -> dict[str, Any]:
    """The engine's request to find a color chart in the photos of the run of a splat object.

    Args:
        obj: a splat object.
        marked: photo and corners that `marked_corners` has written; "" for a search.

    Raises:
        InputError: the splats are from no run.
    """
    run = {"request": "chart", "run": str(photographed_run(obj))}
    return run | {"marked": marked} if marked else run


def position_in_photo(camera: Camera, ray: Vector) -> tuple[float, float] | None:
    """Where a camera sees a direction of Blender's world, in fractions of the photo from its upper left corner.

    None beside the photo.
    """
    x, y, z = camera.K @ camera.world_to_camera[:3, :3] @ np.array(ray, np.float64)
    if z <= 0:
        return None
    place = float(x / z / camera.width), float(y / z / camera.height)
    return place if all(0 <= value <= 1 for value in place) else None


def marked_corners(camera: bpy.types.Object, corners: Sequence[tuple[float, float]]) -> str:
    """The photo of a camera and corners in fractions of it, as the request has them."""
    numbers = ",".join(f"{value:.6f}" for corner in corners for value in corner)
    return f"{camera.get(PHOTO_KEY, camera.name)}:{numbers}"


def describe(event: dict[str, Any]) -> str:
    """A sentence about the result of the request."""
    delta_e, count = event["delta_e"], len(event["photos"])
    return (
        f"Color chart in {count} photo{'s' if count > 1 else ''}: delta E {delta_e['photos']:.1f} as photographed, "
        f"{delta_e['restored']:.1f} without water, {delta_e['corrected']:.1f} corrected."
    )


def chart_of(folder: Path) -> dict[str, Any]:
    """The contents of the run's chart.json; empty where it has none, or a damaged one."""
    file = RunFolder(folder).chart
    try:
        return _read(file, file.stat().st_mtime_ns)
    except (OSError, InputError):
        return {}


@functools.lru_cache(maxsize=8)
def _read(file: Path, _changed: int) -> dict[str, Any]:
    return read_json(file, "")


def rows_of(chart: dict[str, Any]) -> list[tuple[str, str]]:
    """Labels and values of delta E in a chart.json, without those that are not known."""
    delta_e = chart.get("delta_e")
    values = delta_e if isinstance(delta_e, dict) else {}
    return [(label, f"{values[key]:.1f}") for label, key in ROWS.items() if isinstance(values.get(key), int | float)]


def attenuation_of(chart: dict[str, Any]) -> str:
    """Attenuation of red, green and blue that the chart says; "" where it is not known."""
    found = chart.get("beta_D")
    values = found.get("chart") if isinstance(found, dict) else None
    known = isinstance(values, list) and all(isinstance(value, int | float) for value in values)
    return " ".join(f"{value:.3f}" for value in values) if known and values else ""


def photos_of(chart: dict[str, Any]) -> list[str]:
    """Names of the photos that show the chart; the last one stands for those beyond LISTED."""
    photos = chart.get("photos")
    names = [str(photo.get("name")) for photo in photos if isinstance(photo, dict)] if isinstance(photos, list) else []
    return names if len(names) <= LISTED else [*names[: LISTED - 1], f"+ {len(names) - LISTED + 1}"]


class SWAG_PT_color_chart(SwagPanel):
    """Panel of the color chart in the photos."""

    bl_label = "Color Chart"
    bl_parent_id = "SWAG_PT_water"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a run."""
        return shown_run(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout = present(self.layout)
        if draw_job(layout, context, "Color chart"):
            return
        column = layout.column(align=True)
        column.operator("swag.find_color_chart", icon="COLOR")
        column.operator("swag.mark_color_chart", icon="EYEDROPPER")
        draw_outcome(layout, context, "Color chart", only_failed=True)
        chart = chart_of(folder_of(present(shown_run(context))))
        rows = rows_of(chart)
        if not rows:
            return
        column = layout.column(align=True)
        column.label(text="Delta E of the patches:")
        for label, value in rows:
            split = column.split(factor=0.6)
            split.label(text=label)
            split.label(text=value, translate=False)
        if attenuation := attenuation_of(chart):
            column = layout.column(align=True)
            column.label(text="Attenuation")
            split = column.split(factor=0.4)
            split.label(text="From Chart")
            split.label(text=attenuation, translate=False)
        column = layout.column(align=True)
        column.label(text="Found in these photos:")
        for name in photos_of(chart):
            column.label(text=name, translate=False)


register, unregister = bpy.utils.register_classes_factory((SWAG_PT_color_chart,))
