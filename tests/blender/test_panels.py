"""The sidebar's data: plan, forecast, settings in the .blend, progress; and the menu of all operators."""

import sys

import pytest

from swag_engine.scene.colmap import load_scene
from swag_engine.settings.effect_names import EFFECTS
from swag_engine.settings.jerlov import JERLOV
from swag_engine.settings.presets import PRESETS
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.pacing.preset_size import fit_preset


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
        f"The run in {tmp_path / 'swag_run'} stopped before its first checkpoint.",
        f"The run in {tmp_path / 'swag_run'} stopped at iteration 1200.",
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
    assert found["threads"] == [] and found["processor seconds"] < 0.2


def test_the_panels_follow_the_work(blender, fake_engine, tmp_path):
    found = blender.run("panels.panels_by_stage", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    order = ["Photos", "Train", "Survey", "Result", "Edit", "Film", "Labels", "Maps", "Export"]
    assert list(dict.fromkeys(found["order"])) == order
    # Train and Result appear open when their stage is reached; until then a closed panel has their place.
    assert found["open"] == ["SWAG_PT_scene", "SWAG_PT_train", "SWAG_PT_result"]
    fresh, planned, trained = found["fresh"], found["planned"], found["trained"]
    assert {"SWAG_PT_train_later", "SWAG_PT_no_result"} <= set(fresh) and "SWAG_PT_train" not in fresh
    assert "swag.open_run" in fresh["SWAG_PT_no_result"]
    assert planned["SWAG_PT_train"][:4] == ["preset", "iterations", "width", "max_gaussians"]
    effects = planned["SWAG_PT_effects"]
    assert effects[effects.index("Measured") :][:8] == [
        *("Measured", "Needed", "Light lost", "75 %", "≥ 10 %", "BIC gain", "3,280", "≥ 50"),
    ]
    assert not {"effects", "time_budget", "words", "masks"} & set(planned["SWAG_PT_train_more"])
    assert "SWAG_PT_no_result" not in trained and "SWAG_PT_train_later" not in trained
    # After a run water and color come first, and figures are folded away behind a word.
    assert found["open below Result"] == ["SWAG_PT_water", "SWAG_PT_colors"]
    assert trained["SWAG_PT_result"] == []
    quality = trained["SWAG_PT_quality"]
    assert quality[0] == "Fair: 25.5 dB on photos it never saw."
    assert quality[quality.index("Test PSNR") + 1] == "25.50 dB" and "swag.open_report" in quality


def test_the_sizes_show_the_numbers_of_the_quality(blender):
    found = blender.run("panels.sizes")
    assert found["standard"] == [[3000, 640, 60_000], [0, 0, 0], ""]
    assert found["draft"] == found["as the preset"] == [[1500, 480, 45_000], [0, 0, 0], ""]
    assert found["own"] == [[700, 480, 45_000], [700, 0, 0], ""]
    assert found["high"] == [[9000, 960, 150_000], [0, 0, 0], ""]  # another quality replaces own numbers
    assert found["time"][1:] == [[0, 0, 0], "2.5m"]
    TrainSettings(time_budget="2.5m")


def test_water_types_are_a_menu(blender):
    found = blender.run("panels.water_types")
    assert found.pop("auto") == "auto" and found.pop("own") == "0.3,0.1,0.0625"
    assert list(found) == list(found.values()) == list(JERLOV)
    TrainSettings(water_type="0.3,0.1,0.0625", metres_per_unit=1.0)


def test_a_reason_is_given_only_where_it_holds(blender, fake_engine, tmp_path):
    found = blender.run("panels.reasons", tmp_path, SWAG_ENGINE_PYTHON=fake_engine)
    assert len(found) > 40
    for operator, (runs, reasons) in found.items():
        when, name = operator.split()
        assert len(reasons) == (not runs), operator
        assert any("Training is running" in reason for reason in reasons) <= (when == "busy"), operator
        if when == "idle" and name in ("swag.train", "swag.plan", "swag.forecast", "swag.inspect_scene"):
            assert reasons == ["Choose photos or a video first"]
    assert found["busy swag.find_cameras"][1] == ["Training is running: wait for its end, or cancel it"]
    assert found["busy swag.import_scene"] == [True, []]


def test_every_effect_has_a_small_picture(blender):
    loaded, largest = blender.run("panels.pictures")
    assert loaded == [[160, 160]] * len(EFFECTS) and largest < 20_000


@pytest.mark.main_version
def test_every_choice_of_the_engines_plan_is_valid(blender, tiny_scene):
    found = blender.run("panels.plan_by_the_engine", tiny_scene, SWAG_ENGINE_PYTHON=sys.executable)
    assert len(found["reasons"]) >= 10 and all(found["reasons"])
    for choice in ("ON", "OFF"):
        settings = TrainSettings.from_json(found[choice])
        assert settings.effects.count(f"={choice.lower()}") == len(found["reasons"])


@pytest.mark.main_version
def test_the_numbers_shown_before_a_training_are_those_of_its_run(blender, tiny_scene, tmp_path):
    found = blender.run(
        "panels.sizes_before_and_in_the_run", tiny_scene, tmp_path / "run", SWAG_ENGINE_PYTHON=sys.executable
    )
    scene = load_scene(tiny_scene)
    assert found["unknown"]
    for name in ("draft", "standard"):
        assert found[name]["known"] and found[name]["shown"] == found[name]["asked"]
    standard = fit_preset(scene, TrainSettings(preset="standard")).size.numbers()
    assert found["standard"]["shown"] == standard != PRESETS["standard"].numbers()
    own = found["own"]
    assert own["known"] and own["shown"]["width"] == 40 and own["shown"]["iterations"] == 20
    assert own["config"] == own["shown"]


def test_sizes_stay_known_until_something_changes_them(blender, fake_engine, tmp_path):
    (tmp_path / "photos").mkdir()
    found = blender.run("panels.known_sizes", tmp_path / "photos", SWAG_ENGINE_PYTHON=fake_engine)
    assert found["imported with other settings"] and found["own"]
    # At most one for each pixel of the surface: 200 000 at a width of 960, a quarter of them at 480.
    assert found["gaussians"] == [30_000, 5_000, 30_000, 50_000]
    assert found["lowered"] == [False, True] and found["other quality"] == [True, 30_000]
    assert found["in time"] == [False, 0]
    assert (found["seed"], found["sh_degree"], found["scene_folder"]) == (True, False, False)
