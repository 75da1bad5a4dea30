"""The runs of a scene in panels: a list, the quality of one in words, the figures of one or two, their reports."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, cast

import bpy
import numpy as np
from bpy.props import BoolProperty, PointerProperty
from bpy.types import PropertyGroup
from mathutils import Vector

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.run_folder import RunFolder, read_json
from . import splats
from .blender_types import present, set_button, with_properties
from .effects import NO_WATER
from .properties import time_text
from .run_quality import Quality, quality_of
from .runs import RUN_KEY
from .sidebar import draw_job, draw_outcome, draw_wrapped

REPORT = "report.html"
"""Name of the report in a run's folder."""
LABELS = {
    "test_psnr": "Test PSNR",
    "test_ssim": "Test SSIM",
    "gaussians": "Gaussians",
    "iteration": "Iterations",
    "width": "Width",
    "seconds": "Time",
    "recipe": "Method",
    "state": "State",
}
"""The figures of a run in the order of the table."""
GAP = 1.1
"""Distance of two runs beside each other, as a factor of the first one's width."""


def runs_in(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The splat objects of runs in a scene, in the order of the folders' names."""
    found = [obj for obj in scene.objects if obj.get(RUN_KEY) and splats.is_splats(obj)]
    return sorted(found, key=lambda obj: (folder_of(obj).name, obj.name))


def folder_of(obj: bpy.types.Object) -> Path:
    """Folder of the run of a splat object."""
    return Path(bpy.path.abspath(obj[RUN_KEY]))


def photographed_run(obj: bpy.types.Object) -> Path:
    """Folder of the run of a splat object, whose photos are asked for.

    Raises:
        InputError: the splats are from no run.
    """
    if not obj.get(RUN_KEY):
        raise InputError(f"The splats of {obj.name} are from no run on this machine, so there are no photos of them.")
    return folder_of(obj)


def shown_run(context: bpy.types.Context) -> bpy.types.Object | None:
    """The run of the active object, else the last one of the scene; None without runs."""
    found = runs_in(present(context.scene))
    return context.active_object if context.active_object in found else found[-1] if found else None


def compared_run(context: bpy.types.Context) -> bpy.types.Object | None:
    """The run that the shown one is compared with: the chosen one, or the other one of two; None for none."""
    scene, shown = present(context.scene), shown_run(context)
    others = [obj for obj in runs_in(scene) if obj != shown]
    chosen = compare_of(scene).other
    return chosen if chosen in others else others[0] if len(others) == 1 else None


def figures_of(folder: Path) -> dict[str, str]:
    """The figures of a run by the names of LABELS, from its files; empty where the folder has none."""
    return _read(folder)[0]


def notes_of(folder: Path) -> list[str]:
    """What a run noticed, in sentences."""
    return _read(folder)[1]


def quality_of_run(folder: Path) -> tuple[Quality, float] | None:
    """The quality of a run and its PSNR on test photos in dB; None where the folder does not tell."""
    return _read(folder)[2]


def _read(folder: Path) -> tuple[dict[str, str], list[str], tuple[Quality, float] | None]:
    run = RunFolder(folder)
    try:
        return _read_metrics(run, run.metrics.stat().st_mtime_ns)
    except (OSError, InputError):
        return {}, [], None


@functools.lru_cache(maxsize=32)
def _read_metrics(run: RunFolder, _changed: int) -> tuple[dict[str, str], list[str], tuple[Quality, float] | None]:
    metrics = read_json(run.metrics, "")
    _, settings, _ = run.read_config()
    size = settings.sized()

    def text(name: str, shown: Callable[[float], str]) -> str:
        number = metrics.get(name)
        return shown(number) if isinstance(number, int | float) else "-"

    figures = {
        "test_psnr": text("test_psnr", "{:.2f} dB".format),
        "test_ssim": text("test_ssim", "{:.3f}".format),
        "gaussians": text("gaussians", "{:,}".format),
        "iteration": text("iteration", "{:,}".format),
        "width": f"{size.width} px" if size.width else "-",
        "seconds": text("seconds", time_text),
        "recipe": settings.recipe,
        "state": "Stopped" if metrics.get("interrupted") else "Finished",
    }
    notes = metrics.get("notes")
    water = [] if run.water.is_file() else [NO_WATER]
    sentences = water + [str(note) for note in (notes if isinstance(notes, list) else [])]
    return figures, sentences, quality_of(metrics)


def report_of(folder: Path) -> Path:
    """The report of a run, which may not exist."""
    return folder / REPORT


def draw_runs(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the list of runs where there are several, and what compares two of them."""
    scene = present(context.scene)
    found, shown = runs_in(scene), shown_run(context)
    if len(found) > 1:
        column = layout.column(align=True)
        for obj in found:
            row = column.row(align=True)
            button = row.operator("swag.select_run", text=folder_of(obj).name, translate=False, depress=obj == shown)
            set_button(button, name=obj.name)
            row.prop(obj, "hide_viewport", text="", emboss=False)
    if len(found) > 2:
        layout.prop(compare_of(scene), "other")
    if compared_run(context):
        layout.prop(compare_of(scene), "beside", toggle=True)


def draw_quality(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the quality of the shown run in words, and its figures beside those of another one where there are two."""
    shown, other = present(shown_run(context)), compared_run(context)
    if quality := quality_of_run(folder_of(shown)):
        text = bpy.app.translations.pgettext_iface("{word}: {psnr} dB on photos it never saw.")
        word = bpy.app.translations.pgettext_iface(quality[0].word)
        draw_wrapped(layout, text.format(word=word, psnr=f"{quality[1]:.1f}"), present(context.region).width)
        draw_wrapped(layout, quality[0].meaning, present(context.region).width)
    columns = [figures_of(folder_of(obj)) for obj in (shown, other) if obj]
    width = present(context.region).width
    if not folder_of(shown).is_dir():
        draw_wrapped(layout, "The run folder is gone; only the splats are left.", width, icon="INFO")
    elif any(columns):
        _draw_figures(layout, [folder_of(obj).name for obj in (shown, other) if obj], columns)
    for note in notes_of(folder_of(shown)):
        draw_wrapped(layout, note, width, icon="INFO")
    draw_job(layout, context, "Report") or draw_outcome(layout, context, "Report", only_failed=True)
    set_button(layout.operator("swag.open_report", icon="URL"), folder=str(folder_of(shown)))


def _draw_figures(layout: bpy.types.UILayout, names: list[str], columns: list[dict[str, str]]) -> None:
    """Draw a table with a column for each run; a run without figures has an empty one."""
    table = layout.column(align=True)
    table.scale_y = 0.8
    rows = [(label, [column.get(name, "-") for column in columns]) for name, label in LABELS.items()]
    for label, values in [("", names), *rows] if len(columns) > 1 else rows:
        row = table.split(factor=0.4)
        row.label(text=label)
        cells = row.row()
        for value in values:
            cells.label(text=value)


def place_beside(scene: bpy.types.Scene, shown: bpy.types.Object, other: bpy.types.Object | None) -> None:
    """Show another run beside the first one, along the world's x axis; None puts all runs back in their places.

    Only the delta of the objects' location changes, so that the splats keep their coordinates.
    """
    for obj in runs_in(scene):
        obj.delta_location = (0.0, 0.0, 0.0)
    if other is None:
        return
    bpy.context.evaluated_depsgraph_get()
    matrix = np.array(shown.matrix_world)
    across = splats.read_splats(shown).positions @ matrix[0, :3]
    # Not the bounding box: a few splats far away would move the other run out of sight.
    low, high = np.percentile(across, (2, 98))
    turn = other.parent.matrix_world.to_3x3().inverted() if other.parent else None
    offset = Vector((GAP * float(high - low), 0.0, 0.0))
    other.delta_location = turn @ offset if turn else offset


def _place(compare: Any, context: bpy.types.Context) -> None:
    scene = compare.id_data
    shown = shown_run(context)
    if shown is not None:
        place_beside(scene, shown, compared_run(context) if compare.beside else None)


@with_properties
class SwagCompare(PropertyGroup):
    """`scene.swag_compare`: which runs are compared."""

    other: Annotated[
        bpy.types.Object | None,
        PointerProperty(
            name="Compare With",
            description="Run whose figures stand beside those of the selected run",
            type=bpy.types.Object,
            poll=lambda self, obj: bool(obj.get(RUN_KEY)) and splats.is_splats(obj),
            update=_place,
        ),
    ]
    beside: Annotated[
        bool,
        BoolProperty(
            name="Side by Side",
            description="Move the compared run beside the selected one in the viewport, and back",
            update=_place,
        ),
    ]


def compare_of(scene: bpy.types.Scene) -> SwagCompare:
    """Which runs of a scene are compared."""
    return cast(Any, scene).swag_compare


def register() -> None:
    """Register the properties with scenes."""
    bpy.utils.register_class(SwagCompare)
    cast(Any, bpy.types.Scene).swag_compare = PointerProperty(type=SwagCompare)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.Scene).swag_compare
    bpy.utils.unregister_class(SwagCompare)
