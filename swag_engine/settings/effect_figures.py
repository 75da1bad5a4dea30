"""Figures behind the plan's decisions as rows of a table: what was measured, and what the decision needs."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Figure:
    """One figure of a decision.

    Attributes:
        label: Noun of a few words for a table.
        kind: A fraction shown as a percentage, an amount of light (0..1), or a number.
        below: Whether the scene calls for the effect where the figure misses its threshold.
    """

    label: str
    kind: Literal["fraction", "light", "number"] = "number"
    below: bool = False


@dataclass(frozen=True)
class FigureRow:
    """One row of the table.

    Attributes:
        label: What was measured.
        measured: Its value, "-" where it could not be measured.
        needed: What the effect needs, such as "≥ 10 %".
        met: Whether the value is that.
    """

    label: str
    measured: str
    needed: str
    met: bool


_BIC = Figure("Evidence (BIC gain)")
_VIEWS = {
    "range_ratio": Figure("Farthest to nearest range"),
    "radius_correlation": Figure("Range follows image radius"),
    "observations": Figure("Observed points"),
}
FIGURES: dict[str, dict[str, Figure]] = {
    "attenuation": {
        "change": Figure("Light lost with range", "fraction"),
        "color": Figure("Fading beside another color", "fraction"),
        "bic_gain": _BIC,
        "interval": Figure("Uncertainty of the loss", "fraction"),
        "resolution": Figure("Smallest visible loss", "fraction"),
        **_VIEWS,
    },
    "backscatter": {
        "background_light": Figure("Light added far away", "light"),
        "dark_rise": Figure("Rise of the darkest light", "light"),
        "bic_gain": _BIC,
        **_VIEWS,
    },
    "separate_backscatter": {"bic_gain": _BIC, **_VIEWS},
    "lamp": {"falloff": Figure("Fall-off from the camera", "fraction"), "bic_gain": _BIC, **_VIEWS},
    "exposure": {"gain_sd": Figure("Difference between photos", "fraction"), "bic_gain": _BIC, **_VIEWS},
    "vignetting": {
        "falloff": Figure("Fall-off to the corners", "fraction"),
        "radial": Figure("Radial part of it", "fraction"),
        "bic_gain": _BIC,
        **_VIEWS,
    },
    "caustics": {
        "flicker": Figure("Flicker", "fraction"),
        "shared": Figure("Flicker alike nearby", "fraction"),
        "steadiness": Figure("Near to far views"),
        "pairs": Figure("Pairs of near views"),
        "observations": Figure("Observed points"),
    },
    "moving_objects": {},
    "interpolation": {
        "images": Figure("Photos"),
        "shared_points": Figure("Points shared by neighbors", "fraction"),
    },
    "semantics": {"open_water": Figure("Open water in photos", "fraction")},
    "depth_prior": {
        "cells": Figure("Cells with points", "fraction", below=True),
        "points": Figure("Points a photo", below=True),
        "accepted": Figure("Photos with fitting depth", "fraction"),
    },
}
"""The figures of each effect in the order of the table. Figures that only replace another one are left out: they are in
the reason of the decision."""


def figure_rows(effect: str, evidence: Mapping[str, Any]) -> list[FigureRow]:
    """Compare the figures of a decision with their thresholds.

    Args:
        effect: Name of the effect.
        evidence: Figures of the plan, each beside NAME_least or NAME_most; one of several colors counts by its largest.

    Returns:
        A row for each figure of FIGURES that has a threshold in the plan.
    """
    rows = []
    for name, figure in FIGURES.get(effect, {}).items():
        for bound in ("least", "most"):
            threshold = evidence.get(f"{name}_{bound}")
            if threshold is None:
                continue
            value = evidence.get(name)
            if isinstance(value, list):
                value = max((part for part in value if part is not None), default=None)
            reached = value is not None and (value >= threshold if bound == "least" else value <= threshold)
            sign = {"least": "≥", "most": "≤"}[bound] if not figure.below else {"least": "<", "most": ">"}[bound]
            measured = "-" if value is None else _text(value, figure)
            met = value is not None and reached != figure.below
            rows.append(FigureRow(figure.label, measured, f"{sign} {_text(threshold, figure)}", met))
    return rows


def _text(value: float, figure: Figure) -> str:
    if figure.kind == "light":
        return f"{value:.3f}"
    shown = 100 * value if figure.kind == "fraction" else value
    text = f"{shown:,.0f}" if abs(shown) >= 10 else f"{round(shown, 2) + 0.0:g}"  # + 0.0: no minus before 0
    return f"{text} %" if figure.kind == "fraction" else text
