"""The sidebar's data: plan, forecast, settings in the .blend, progress; and the menu of all operators."""

import sys

import pytest

from swag_engine.settings.settings import TrainSettings


def test_the_plan_is_a_list_of_effects_that_the_user_can_overrule(blender, fake_engine, tmp_path):
    found = blender.run("panels.plan_and_overrule", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    assert found == {
        "message": "Effects to model: attenuation.",
        "lines": [
            ["attenuation", "Attenuation", "on", "Red loses 75% over the scene.", 1.25],
            ["lamp", "Lamp", "off", "Light falls off by 0%.", 0.5],
            ["moving_objects", "Moving objects", "unknown", "Only training shows it.", 0.0],
        ],
        "figures": {
            "attenuation": [
                ["Light lost", "75 %", "≥ 10 %", True],
                ["BIC gain", "3,280", "≥ 50", True],
            ],
            "lamp": [["Fall-off", "0.3 %", "≥ 15 %", False]],
            "moving_objects": [],
        },
        "explained": ["attenuation", "lamp"],
        "settings": "attenuation=off,lamp=on",
        "after another plan": "attenuation=off,lamp=on",
        "opened": ["attenuation=off,lamp=on", "Light falls off by 0%.", False],
        "stale": True,
        "reset": ["", False],
    }


def test_a_stopped_run_can_be_continued_after_the_file_is_opened_again(blender, tmp_path):
    assert blender.run("panels.stopped_run", tmp_path) == [
        "The run swag_run stopped before its first checkpoint.",
        "The run swag_run stopped at iteration 1200.",
    ]


def test_every_operator_has_a_tooltip_and_is_in_the_menu_that_the_search_finds(blender):
    found = blender.run("panels.operators_and_menu")
    # These act on one line of a list, and stand beside it.
    assert set(found["names"]) - set(found["menu"]) == {
        *("isolate_label", "select_label", "keep_mask", "select_run", "show_effect")
    }
    assert found["menu is in the Object menu"] is True
    assert found["without tooltip"] == [] and found["undescribed"] == []
    assert {"swag.train", "swag.plan", "swag.import_scene", "swag.separate_splats"} <= set(found["with undo"])


def test_curve_and_figures_of_a_training(blender):
    found = blender.run("panels.curve_and_figures")
    assert found["curve"] == " 10.00 12.50 20.00" and found["drawn"] == "▁▃█" and found["flat"] == "▁▁"
    assert found["figures"][-1] == "1:05 left"


def test_a_forecast_is_shown_until_its_settings_change(blender, fake_engine, tmp_path):
    found = blender.run("panels.forecast", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    lines = [["draft", "0:20-0:45", "24.0-26.0 dB", "0.6 GB"], ["high", "8:20-1:06:40", "PSNR unknown", "0.6 GB"]]
    assert found["before"] == [] and found["opened"] == lines
    assert found["message"] == "; ".join(" ".join(line) for line in lines) and not found["failed"]


@pytest.mark.parametrize("paused", [True, False])
def test_pause_switches_a_running_training(blender, paused):
    assert blender.run("panels.press_pause", paused) == {"enabled when idle": False, "paused": not paused}


def test_no_thread_and_no_timer_is_active_after_a_training(blender, fake_engine, tmp_path):
    found = blender.run("panels.idle_after_training", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    assert found["threads"] == [] and found["processor seconds"] < 0.05


@pytest.mark.main_version
def test_every_choice_of_the_engines_plan_is_valid(blender, tiny_scene):
    found = blender.run("panels.plan_by_the_engine", tiny_scene, SWAG_ENGINE_PYTHON=sys.executable)
    assert len(found["reasons"]) >= 10 and all(found["reasons"])
    for choice in ("ON", "OFF"):
        settings = TrainSettings.from_json(found[choice])
        assert settings.effects.count(f"={choice.lower()}") == len(found["reasons"])
