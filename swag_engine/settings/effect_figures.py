"""Figures behind the plan's decisions as rows of a table: what was measured, and what the decision needs."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Figure:
    """One figure of a decision.

    Attributes:
        label: Noun of at most 18 characters, for a table in a narrow panel.
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


_BIC = Figure("BIC gain")
_VIEWS = {
    "range_ratio": Figure("Range ratio"),
    "radius_correlation": Figure("Radius correlation"),
    "observations": Figure("Observations"),
}
FIGURES: dict[str, dict[str, Figure]] = {
    "attenuation": {
        "change": Figure("Light lost", "fraction"),
        "color": Figure("Color fading", "fraction"),
        "bic_gain": _BIC,
        "interval": Figure("Uncertainty", "fraction"),
        "resolution": Figure("Visible loss", "fraction"),
        **_VIEWS,
    },
    "backscatter": {
        "background_light": Figure("Added light", "light"),
        "dark_rise": Figure("Rise of dark light", "light"),
        "bic_gain": _BIC,
        **_VIEWS,
    },
    "separate_backscatter": {"bic_gain": _BIC, **_VIEWS},
    "lamp": {"falloff": Figure("Fall-off", "fraction"), "bic_gain": _BIC, **_VIEWS},
    "beam": {"falloff": Figure("Fall-off", "fraction"), "bic_gain": _BIC, **_VIEWS},
    "exposure": {"gain_sd": Figure("Variation", "fraction"), "bic_gain": _BIC, **_VIEWS},
    "vignetting": {
        "falloff": Figure("Fall-off", "fraction"),
        "radial": Figure("Radial part", "fraction"),
        "bic_gain": _BIC,
        **_VIEWS,
    },
    "caustics": {
        "flicker": Figure("Flicker", "fraction"),
        "shared": Figure("Shared flicker", "fraction"),
        "steadiness": Figure("Near to far"),
        "pairs": Figure("Near pairs"),
        "observations": Figure("Observations"),
    },
    "moving_objects": {},
    "interpolation": {
        "images": Figure("Photos"),
        "shared_points": Figure("Shared points", "fraction"),
    },
    "semantics": {"open_water": Figure("Open water", "fraction")},
    "depth_prior": {
        "cells": Figure("Filled cells", "fraction", below=True),
        "points": Figure("Points a photo", below=True),
        "accepted": Figure("Fitting photos", "fraction"),
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
    text = f"{shown:,.0f}" if abs(shown) >= 10 else f"{round(shown, 2) + 0.0:g}"  # + 0.0 turns -0 into 0
    return f"{text} %" if figure.kind == "fraction" else text
