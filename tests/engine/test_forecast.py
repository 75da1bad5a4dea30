"""What a run is said to take and reach before it begins, and what becomes of it afterwards."""

import json
from dataclasses import fields, replace

import pytest

from swag_engine.experiments import forecast as forecasts
from swag_engine.experiments.forecast import describe, expectation, forecast_scene, history, record, time_text
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import cache_root
from swag_engine.settings.presets import PRESETS
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.pacing.speed import Speed, measure_speed
from swag_engine.training.trainer import train

SETTINGS = TrainSettings(iterations=40, width=48, max_gaussians=320, sh_degree=1)


@pytest.fixture
def forecast(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("SWAG_CACHE_DIR", str(tmp_path / "cache"))
    return forecast_scene(tiny_scene, TrainSettings(sh_degree=1))


def test_every_preset_has_time_quality_and_memory_with_ranges(forecast):
    assert list(forecast["presets"]) == list(PRESETS)
    lines = list(forecast["presets"].values())
    for line in lines:
        assert 0 < line["seconds"][0] < line["seconds"][1] < line["seconds"][2]
        assert 5 < line["psnr"][0] < line["psnr"][1] < line["psnr"][2] < 60
    for less, more in zip(lines, lines[1:], strict=False):
        assert less["seconds"][1] < more["seconds"][1]
        assert less["psnr"][1] <= more["psnr"][1]
        assert less["memory_mb"] <= more["memory_mb"]
    text = describe(forecast)
    assert all(name in text for name in PRESETS) and "dB" in text and "GB" in text


def test_outcomes_narrow_the_next_forecast(forecast, tiny_scene, tmp_path):
    expected = expectation(tiny_scene, SETTINGS)
    assert expected["iterations"] == 40
    for number in range(3):
        run = tmp_path / f"run{number}"
        metrics = train(tiny_scene, run, SETTINGS)["metrics"]
        record(run, expected, 3 * expected["first_guess"])
    kept = json.loads((run / "forecast.json").read_text())
    assert kept["expected"] == expected
    assert kept["outcome"] == {
        "seconds": round(3 * expected["first_guess"], 2), "psnr": metrics["psnr"], "gaussians": metrics["gaussians"]
    }  # fmt: skip
    learned = expectation(tiny_scene, SETTINGS)
    assert learned["seconds"][1] == pytest.approx(3 * expected["first_guess"], abs=0.06)
    assert learned["seconds"][2] / learned["seconds"][0] < expected["seconds"][2] / expected["seconds"][0]
    assert learned["psnr"][1] == pytest.approx(metrics["psnr"], abs=0.02)
    assert learned["psnr"][2] - learned["psnr"][0] < expected["psnr"][2] - expected["psnr"][0] + 2 * forecasts.SPREAD_DB


def test_nothing_is_promised_that_was_not_looked_at(forecast, tiny_scene, tmp_path, monkeypatch):
    assert expectation(tiny_scene, TrainSettings(time_budget="1m")) is None
    assert expectation(tiny_scene, TrainSettings(recipe="3dgs")) is None
    assert expectation(tmp_path, SETTINGS) is None
    monkeypatch.setattr(forecasts.platform, "node", lambda: "another computer")
    assert expectation(tiny_scene, SETTINGS) is None


def test_what_every_run_takes_is_counted(forecast, tiny_scene):
    kept = next(cache_root().rglob("forecast.json"))
    document = json.loads(kept.read_text())
    before = expectation(tiny_scene, SETTINGS)["first_guess"]
    kept.write_text(json.dumps(document | {"seconds_beside": document["seconds_beside"] + 5}))
    assert expectation(tiny_scene, SETTINGS)["first_guess"] == pytest.approx(before + 5, abs=0.01)
    for damaged in ({"recipe": "swag"}, [], document | {"speed": {}}):
        kept.write_text(json.dumps(damaged))
        assert expectation(tiny_scene, SETTINGS) is None


def test_a_scene_of_as_many_points_as_a_colour_has_channels(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("SWAG_CACHE_DIR", str(tmp_path))
    scene = load_scene(tiny_scene)
    points = scene.points
    three = replace(points, **{field.name: getattr(points, field.name)[:3] for field in fields(points)})
    speed = measure_speed(replace(scene, points=three), TrainSettings(sh_degree=1))
    assert 0 < speed.milliseconds(1000, 64 * 48) < 10_000


def test_a_speed_measured_beside_other_work_is_held_against_a_look(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("SWAG_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(forecasts, "measure_speed", lambda scene, settings: Speed(1000.0, 0.0, 0.0, 0.0))
    taken, look = [], forecasts._look

    def looked(scene_folder, settings):
        found = look(scene_folder, settings)
        taken.append(found[1])
        return found

    monkeypatch.setattr(forecasts, "_look", looked)
    iteration = forecast_scene(tiny_scene, TrainSettings(sh_degree=1))["speed"]["fixed"] / 1000
    assert 0 < iteration * forecasts.SECOND_LOOK.iterations < taken[1] < 100


def test_a_damaged_history_is_read_as_far_as_it_goes(forecast, tiny_scene, tmp_path):
    expected = expectation(tiny_scene, SETTINGS)
    train(tiny_scene, tmp_path / "run", SETTINGS)
    record(tmp_path / "run", expected, 2.0)
    path = tmp_path / "cache" / "history.jsonl"
    path.write_text('{"outcome": {"seconds": 1}}\n\x00 garbage\n' + path.read_text() + '{"machine": ')
    assert [entry["outcome"]["seconds"] for entry in history()] == [2.0]
    assert expectation(tiny_scene, SETTINGS)["seconds"][1] > 0


@pytest.mark.parametrize(("seconds", "text"), [(45.2, "45 s"), (720, "12 min"), (12600, "3.5 h")])
def test_durations_as_people_say_them(seconds, text):
    assert time_text(seconds) == text
