"""The sidebar tab SWAG: base class of its panels, and what several of them draw."""

import textwrap
from collections.abc import Sequence
from typing import Any, Literal

import bpy

from ..swag_engine.base.text import sparkline
from . import WORDS
from .blender_types import present, set_button
from .properties import SwagJob, status_of

CHARACTER_WIDTH = 6.4
"""Mean width of a character in Blender's interface font, in pixels at a scale of 1."""
POPUP_WIDTH = 600
"""Width of a popup with sentences, in pixels."""
Icon = Literal["NONE", "INFO", "ERROR", "CHECKMARK", "X", "QUESTION", "RECOVER_LAST", "MOD_OCEAN", "IMPORT"]


class SwagPanel(bpy.types.Panel):
    """Panel in the sidebar tab SWAG of the 3D viewport."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "SWAG"
    bl_translation_context = WORDS


def draw_job(layout: bpy.types.UILayout, context: bpy.types.Context, *jobs: str) -> bool:
    """Draw those of these jobs that run: progress, Pause and Cancel, figures, the curve of PSNR.

    Returns whether one runs.
    """
    running = [job for job in status_of(context).running if job.name in jobs]
    for job in running:
        layout.progress(factor=job.factor, text=job.shown_text)
        if job.evaluates and job.stopping:
            draw_wrapped(layout, "The result is kept.", present(context.region).width)
        row = layout.row(align=True)
        if job.name == "Training" and not job.stopping:
            row.operator("swag.pause", text="Resume" if job.paused else "Pause", icon="PLAY" if job.paused else "PAUSE")
        draw_cancel(row, job, text="Stop Now" if job.stopping else "Cancel")
        figures = job.figures()
        if figures:
            grid = layout.grid_flow(row_major=True, columns=2, even_columns=True, align=True)
            for figure in figures:
                grid.label(text=figure)
        curve = [float(psnr) for psnr in job.curve.split()]
        if len(curve) > 1:
            layout.label(text=f"{curve[0]:.1f} {sparkline(curve)} {curve[-1]:.1f} dB")
    return bool(running)


def draw_cancel(layout: bpy.types.UILayout, job: SwagJob, text: str) -> None:
    """Draw the button that cancels a job, which stops it at once where it was cancelled before."""
    row = layout.row(align=True)
    row.enabled = not job.stopping_now
    set_button(row.operator("swag.cancel", text=text, icon="CANCEL"), job=job.name)


def draw_outcome(layout: bpy.types.UILayout, context: bpy.types.Context, *jobs: str, only_failed: bool = False) -> bool:
    """Draw how the one of these jobs ended that ended last; after an error with the button that shows its log.

    Returns whether there is something to draw.
    """
    job = status_of(context).ended(*jobs)
    if job is None or only_failed and not job.failed:
        return False
    draw_wrapped(layout, job.message, present(context.region).width, icon="ERROR" if job.failed else "CHECKMARK")
    if job.failed:
        set_button(layout.operator("swag.show_log", icon="TEXT"), job=job.name)
    return True


def draw_wrapped(layout: bpy.types.UILayout, text: str, width: int, icon: Icon = "NONE") -> None:
    """Draw a sentence over as many lines as a region of `width` pixels needs."""
    text = bpy.app.translations.pgettext_iface(text)
    scale = present(bpy.context.preferences).system.ui_scale or 1.0  # 0 without a window
    pixels = width / scale - (30 if icon == "NONE" else 54)
    characters = max(20, int(pixels / CHARACTER_WIDTH))
    column = layout.column(align=True)
    column.scale_y = 0.8
    for number, line in enumerate(textwrap.wrap(text, characters)):
        column.label(text=line, icon=icon if number == 0 else "BLANK1" if icon != "NONE" else "NONE")


def show_popup(sentences: Sequence[str], icon: Icon, title: str = "SWAG Splatting") -> None:
    """Show sentences, translated already, in a popup of the first window; in background nothing is shown."""

    def draw(menu: Any, context: bpy.types.Context) -> None:
        for sentence in sentences:
            draw_wrapped(menu.layout, sentence, POPUP_WIDTH)

    window_manager = present(bpy.context.window_manager)
    if window_manager.windows and not bpy.app.background:
        with bpy.context.temp_override(window=window_manager.windows[0]):
            window_manager.popup_menu(draw, title=title, icon=icon)
