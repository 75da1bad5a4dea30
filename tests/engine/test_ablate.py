"""Ablation: its rows, its figures, and how an interrupted one is continued."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from swag_engine.app.cli import main
from swag_engine.base.errors import InputError
from swag_engine.experiments.ablate import Row, ablate, ablation_rows, compare_rows, format_table
from swag_engine.scene.georeference import Georeference, write_georeference
from swag_engine.settings.effect_names import EFFECTS
from swag_engine.settings.presets import FEWEST
from swag_engine.settings.recipes import RECIPES, SWITCHES, recipe_of
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.runs import training_times

SETTINGS = TrainSettings(iterations=12, width=48, max_gaussians=320, sh_degree=0)
TWO_ROWS = [Row("3dgs", "3dgs"), Row("swag without water", "swag", "water=off")]


def test_every_recipe_and_every_switch_has_a_row():
    table_rows = ablation_rows()
    assert {row.recipe for row in table_rows if not row.effects} == set(RECIPES)
    switched = {row.effects.partition("=")[0] for row in table_rows if row.effects}
    assert switched == {"water", *EFFECTS, *SWITCHES}
    for row in table_rows:
        TrainSettings(recipe=row.recipe, effects=row.effects)
        assert not row.effects or recipe_of(row.recipe, row.effects) != RECIPES[row.recipe], row


def test_the_table_has_mean_and_standard_deviation_over_the_seeds(tiny_scene, tmp_path):
    done = []
    document = compare_rows(
        TWO_ROWS, tiny_scene, tmp_path / "a", 2, SETTINGS, on_run=lambda name, seed, f: done.append((name, seed))
    )
    assert done == [("3dgs", 0), ("3dgs", 1), ("swag without water", 0), ("swag without water", 1)]
    row = document["rows"][0]
    values = [run["test_psnr"] for run in row["runs"]]
    assert values[0] != values[1]
    assert row["mean"]["test_psnr"] == pytest.approx(sum(values) / 2)
    assert row["spread"]["test_psnr"] == pytest.approx(abs(values[0] - values[1]) / 2**0.5)
    assert row["mean"]["delta_e"] is None  # the scene has no truth
    text = (tmp_path / "a" / "ablation.md").read_text()
    assert text == format_table(document) + "\n" and "| swag without water |" in text and " ± " in text
    assert json.loads((tmp_path / "a" / "ablation.json").read_text())["seeds"] == 2
    again = train(tiny_scene, tmp_path / "again", replace(SETTINGS, recipe="swag", effects="water=off"))
    assert document["rows"][1]["runs"][0]["test_psnr"] == again["metrics"]["test_psnr"]


def test_an_interrupted_table_is_continued(tiny_scene, tmp_path):
    asked = iter(range(10**9))
    stopped = compare_rows(TWO_ROWS, tiny_scene, tmp_path / "a", 1, SETTINGS, should_stop=lambda: next(asked) > 16)
    assert stopped["interrupted"] and len(stopped["rows"]) == 1
    whole = compare_rows(TWO_ROWS, tiny_scene, tmp_path / "b", 1, SETTINGS)
    before = training_times(tmp_path / "a")
    resumed = compare_rows(TWO_ROWS, tiny_scene, tmp_path / "a", 1, SETTINGS)
    after = training_times(tmp_path / "a")
    assert [name for name in after if after[name] != before.get(name)] == ["swag-without-water/seed-0"]
    assert not resumed["interrupted"]
    for expected, got in zip(whole["rows"], resumed["rows"], strict=True):
        assert expected["mean"]["test_psnr"] == got["mean"]["test_psnr"]


def test_sizes_left_to_a_preset_are_those_of_the_scene_and_the_same_for_all_runs(tiny_scene, tmp_path):
    """Also where the ablation is started again, and the scene has a scale, which the runs then have too."""
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    write_georeference(scene, Georeference(0.5, None, "gps", "full", np.eye(3), np.zeros(3)))
    asked = replace(SETTINGS, preset="draft", width=0, max_gaussians=0)
    first = compare_rows(TWO_ROWS[:1], scene, tmp_path / "a", 1, asked)
    again = compare_rows(TWO_ROWS, scene, tmp_path / "a", 1, asked)
    settings = again["settings"]
    assert settings == first["settings"] and settings["metres_per_unit"] == 0.5
    assert (settings["width"], settings["max_gaussians"]) == (64, FEWEST)
    assert again["rows"][0]["mean"] == first["rows"][0]["mean"] and len(again["rows"]) == 2


def test_runs_of_other_settings_are_refused(tiny_scene, tmp_path):
    compare_rows(TWO_ROWS[:1], tiny_scene, tmp_path / "a", 1, SETTINGS)
    with pytest.raises(InputError, match="another scene or other settings"):
        compare_rows(TWO_ROWS[:1], tiny_scene, tmp_path / "a", 1, replace(SETTINGS, width=32))
    with pytest.raises(InputError, match="seeds must be 1 or more"):
        ablate(tiny_scene, tmp_path / "b", 0, SETTINGS)


def test_a_scene_that_is_not_there_is_refused(tmp_path, capsys):
    assert main(["ablate", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr().err
    assert "nowhere" in printed and "Traceback" not in printed
