"""The sidebar tab SWAG: base class of its panels, and what several of them draw."""

import textwrap
from typing import Literal

import bpy

from ..swag_engine.base.text import sparkline
from . import WORDS
from .blender_types import present
from .properties import status_of

CHARACTER_WIDTH = 6.4
"""Mean width of a character in Blender's interface font, in pixels at a scale of 1."""
Icon = Literal["NONE", "INFO", "ERROR", "CHECKMARK", "X", "QUESTION", "RECOVER_LAST", "MOD_OCEAN", "IMPORT"]


class SwagPanel(bpy.types.Panel):
    """Panel in the sidebar tab SWAG of the 3D viewport."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "SWAG"
    bl_translation_context = WORDS


def draw_job(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the job that runs: progress, Pause and Cancel, figures, the curve of PSNR."""
    status = status_of(context)
    text = "Stopping" if status.stopping else "Paused" if status.paused else status.text
    layout.progress(factor=status.factor, text=text)
    row = layout.row(align=True)
    if status.job == "Training":
        row.operator(
            "swag.pause", text="Resume" if status.paused else "Pause", icon="PLAY" if status.paused else "PAUSE"
        )
    row.operator("swag.cancel", text="Cancel", icon="CANCEL")
    figures = status.figures()
    if figures:
        grid = layout.grid_flow(row_major=True, columns=2, even_columns=True, align=True)
        for figure in figures:
            grid.label(text=figure)
    curve = [float(psnr) for psnr in status.curve.split()]
    if len(curve) > 1:
        layout.label(text=f"{curve[0]:.1f} {sparkline(curve)} {curve[-1]:.1f} dB")


def draw_outcome(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw how the last job ended; after an error with the button that shows its log."""
    status = status_of(context)
    draw_wrapped(layout, status.message, present(context.region).width, icon="ERROR" if status.failed else "CHECKMARK")
    if status.failed:
        layout.operator("swag.show_log", icon="TEXT")


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
