"""The selected effect in the panel: what it does, as a picture and a sentence, and the figures of its decision."""

from pathlib import Path
from typing import Any

import bpy
import bpy.utils.previews

from .effects import SwagEffect, state_icon, state_sentence
from .properties import SwagScene
from .sidebar import draw_wrapped

FOLDER = Path(__file__).with_name("pictures")
"""A picture NAME.jpg for each effect: left without it, right with it. docs/scripts/effect_pictures.py makes them."""
SIZE = 7.0
"""Size of the picture, in heights of a button."""
COLUMNS = ("Measured", "Needed")
_pictures: Any = None


def draw_effect(layout: bpy.types.UILayout, swag: SwagScene, line: SwagEffect, width: int) -> None:
    """Draw the choice, the decision and the figures of an effect.

    Args:
        layout: where.
        swag: settings, for what labels are learned from.
        line: the effect.
        width: of the region, pixels.
    """
    layout.prop(line, "choice", expand=True)
    box = layout.box()
    box.label(text=line.title)
    if picture := picture_of(line.name):
        box.template_icon(icon_value=picture, scale=SIZE)
    draw_wrapped(box, line.words.sentence, width - 20)
    draw_wrapped(box, state_sentence(line.state), width - 20, icon=state_icon(line.state))
    if line.figures:
        _draw_figures(box, line)
    if not line.explained:
        draw_wrapped(box, line.reason, width - 20)
    if line.cost_ms:
        text = bpy.app.translations.pgettext_iface("Takes about {cost} ms of an iteration on this machine.")
        draw_wrapped(box, text.format(cost=f"{line.cost_ms:.1f}"), width - 20)
    if line.name == "semantics" and line.choice == "ON":
        box.prop(swag, "words")
        box.prop(swag, "masks")


def _draw_figures(layout: bpy.types.UILayout, line: SwagEffect) -> None:
    """Draw what was measured beside what the effect needs; figures that are not what it needs are red."""
    table = layout.column(align=True)
    table.scale_y = 0.8
    _draw_row(table, "", *COLUMNS)
    for figure in line.figures:
        row = table.row()
        row.alert = not figure.met
        _draw_row(row, figure.name, figure.measured, figure.needed)


def _draw_row(layout: bpy.types.UILayout, name: str, measured: str, needed: str) -> None:
    row = layout.split(factor=0.46)
    row.label(text=name)
    values = row.split(factor=0.5)
    values.label(text=measured)
    values.label(text=needed)


def picture_of(effect: str) -> int:
    """Icon number of the picture of an effect; 0 without one. The pictures are loaded when the first is drawn."""
    global _pictures
    if _pictures is None:
        _pictures = bpy.utils.previews.new()
        for path in FOLDER.glob("*.jpg"):
            _pictures.load(path.stem, str(path), "IMAGE")
    return _pictures[effect].icon_id if effect in _pictures else 0


def register() -> None:
    """Nothing: the pictures are loaded when they are needed."""


def unregister() -> None:
    """Free the pictures."""
    global _pictures
    if _pictures is not None:
        bpy.utils.previews.remove(_pictures)
        _pictures = None
