"""Figures of decisions as rows of a table, and the words of the effects."""

from pathlib import Path

from swag_engine.effects.registry import REGISTRY
from swag_engine.settings.effect_figures import FIGURES, FigureRow, figure_rows
from swag_engine.settings.effect_names import EFFECTS

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "reef_wreck"
ONLY_IN_THE_REASON = {"sure_color", "color_of_loss", "inverse_square"}
"""Figures that only replace another one."""


def test_every_effect_has_words_and_figures_that_fit_a_narrow_panel():
    assert list(EFFECTS) == list(FIGURES) == list(REGISTRY)
    for words in EFFECTS.values():
        assert len(words.statement) <= 30 and words.sentence.endswith(".")
    assert all(len(figure.label) <= 18 for figures in FIGURES.values() for figure in figures.values())


def test_a_figure_is_compared_with_its_threshold():
    evidence = {"change": [0.75, None, 0.3], "change_least": 0.1, "interval": 0.6, "interval_most": 0.5, "ratio": 2.0}
    assert figure_rows("attenuation", evidence) == [
        FigureRow("Light lost", "75 %", "≥ 10 %", True),
        FigureRow("Uncertainty", "60 %", "≤ 50 %", False),
    ]


def test_an_effect_that_helps_below_a_threshold_needs_less():
    evidence = {"points": 806.0, "points_least": 500, "cells": 0.004, "cells_least": 0.5}
    assert figure_rows("depth_prior", evidence) == [
        FigureRow("Filled cells", "0.4 %", "< 50 %", True),
        FigureRow("Points a photo", "806", "< 500", False),
    ]


def test_a_figure_that_could_not_be_measured_is_not_met():
    assert figure_rows("caustics", {"flicker_least": 0.06, "pairs": 7012, "pairs_least": 30}) == [
        FigureRow("Flicker", "-", "≥ 6 %", False),
        FigureRow("Near pairs", "7,012", "≥ 30", True),
    ]
    assert figure_rows("lamp", {"falloff": -0.00001, "falloff_least": 0.15})[0].measured == "0 %"
    assert figure_rows("of a later version", {"a": 1, "a_least": 2}) == []


def test_every_threshold_of_a_plan_is_in_the_table():
    from swag_engine.planning.plan import plan_scene

    plan = plan_scene(SCENE)
    for name, effect in plan.effects.items():
        compared = {key.rpartition("_")[0] for key in effect.evidence if key.endswith(("_least", "_most"))}
        assert compared - ONLY_IN_THE_REASON <= set(FIGURES[name]), name
        assert len(figure_rows(name, effect.evidence)) == len(compared - ONLY_IN_THE_REASON)
    assert all(row.met for row in figure_rows("attenuation", plan.effects["attenuation"].evidence))
    assert not all(row.met for row in figure_rows("lamp", plan.effects["lamp"].evidence))
