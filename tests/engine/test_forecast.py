"""Forecasts of time, memory and quality, and how outcomes of runs correct them."""

import json
import shutil
from dataclasses import fields, replace
from typing import Any

import pytest

from swag_engine.experiments import forecast as forecasts
from swag_engine.experiments.forecast import (
    corrected_speed,
    describe,
    expected_outcome,
    forecast_scene,
    past_outcomes,
    record_outcome,
    time_text,
)
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import cache_root
from swag_engine.settings.presets import PRESETS
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.pacing.speed import Speed, measure_speed
from swag_engine.training.trainer import train

SETTINGS = TrainSettings(iterations=40, width=48, max_gaussians=320, sh_degree=1)


@pytest.fixture(scope="module")
def kept_forecast(tiny_scene, tmp_path_factory):
    """A forecast, and the cache folder in which it is kept."""
    cache = tmp_path_factory.mktemp("forecast")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SWAG_CACHE_DIR", str(cache))
        return forecast_scene(tiny_scene, TrainSettings(sh_degree=1)), cache


@pytest.fixture
def forecast(kept_forecast, tmp_path, monkeypatch):
    """A forecast, kept in a cache folder of the test's own."""
    document, cache = kept_forecast
    monkeypatch.setenv("SWAG_CACHE_DIR", str(shutil.copytree(cache, tmp_path / "cache")))
    return document


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
    expected = expected_outcome(tiny_scene, SETTINGS)
    assert expected["iterations"] == 40
    run = tmp_path / "run"
    metrics = train(tiny_scene, run, SETTINGS)["metrics"]
    for _ in range(forecasts.ENOUGH):
        record_outcome(run, expected, 3 * expected["first_guess"])
    kept = json.loads((run / "forecast.json").read_text())
    assert kept["expected"] == expected
    assert kept["outcome"] == {
        "seconds": round(3 * expected["first_guess"], 2), "psnr": metrics["psnr"], "gaussians": metrics["gaussians"]
    }  # fmt: skip
    learned = expected_outcome(tiny_scene, SETTINGS)
    assert learned["seconds"][1] == pytest.approx(3 * expected["first_guess"], abs=0.06)
    assert learned["seconds"][2] / learned["seconds"][0] < expected["seconds"][2] / expected["seconds"][0]
    assert learned["psnr"][1] == pytest.approx(metrics["psnr"], abs=0.02)
    assert learned["psnr"][2] - learned["psnr"][0] < expected["psnr"][2] - expected["psnr"][0] + 2 * forecasts.ERROR_DB


def test_there_is_no_expectation_for_what_was_not_measured(forecast, tiny_scene, tmp_path):
    assert expected_outcome(tiny_scene, SETTINGS) is not None
    assert expected_outcome(tiny_scene, TrainSettings(time_budget="1m")) is None
    assert expected_outcome(tiny_scene, TrainSettings(recipe="3dgs")) is None
    assert expected_outcome(tmp_path, SETTINGS) is None
    kept = next(cache_root().rglob("forecast.json"))
    kept.write_text(json.dumps(json.loads(kept.read_text()) | {"machine": "another computer"}))
    assert expected_outcome(tiny_scene, SETTINGS) is None


def test_time_beside_training_is_added_to_every_run(forecast, tiny_scene):
    kept = next(cache_root().rglob("forecast.json"))
    document = json.loads(kept.read_text())
    before = expected_outcome(tiny_scene, SETTINGS)["first_guess"]
    kept.write_text(json.dumps(document | {"seconds_beside": document["seconds_beside"] + 5}))
    assert expected_outcome(tiny_scene, SETTINGS)["first_guess"] == pytest.approx(before + 5, abs=0.01)
    every_kind: tuple[Any, ...] = ({"recipe": "swag"}, [], document | {"speed": {}})
    for damaged in every_kind:
        kept.write_text(json.dumps(damaged))
        assert expected_outcome(tiny_scene, SETTINGS) is None


def test_speed_is_measured_on_a_scene_of_three_points(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("SWAG_CACHE_DIR", str(tmp_path))
    scene = load_scene(tiny_scene)
    points = scene.points
    three = replace(points, **{field.name: getattr(points, field.name)[:3] for field in fields(points)})
    speed = measure_speed(replace(scene, points=three), TrainSettings(sh_degree=1))
    assert 0 < speed.milliseconds(1000, 64 * 48) < 10_000


def test_a_speed_measured_beside_other_work_is_corrected_by_a_run():
    measured = Speed(1000.0, 2.0, 3.0, 4.0)
    assert corrected_speed(measured, 170.0, training=17.0, whole=20.0) == (measured.times(0.1), pytest.approx(3.0))
    assert measured.times(0.1).fixed == pytest.approx(100.0)
    assert corrected_speed(measured, 170.0, training=200.0, whole=205.0) == (measured, pytest.approx(35.0))


def test_a_damaged_history_is_read_as_far_as_it_goes(forecast, tiny_scene, tmp_path):
    expected = expected_outcome(tiny_scene, SETTINGS)
    train(tiny_scene, tmp_path / "run", SETTINGS)
    record_outcome(tmp_path / "run", expected, 2.0)
    path = tmp_path / "cache" / "history.jsonl"
    path.write_text('{"outcome": {"seconds": 1}}\n\x00 garbage\n' + path.read_text() + '{"machine": ')
    assert [entry["outcome"]["seconds"] for entry in past_outcomes()] == [2.0]
    assert expected_outcome(tiny_scene, SETTINGS)["seconds"][1] > 0


@pytest.mark.parametrize(("seconds", "text"), [(45.2, "45 s"), (720, "12 min"), (12600, "3.5 h")])
def test_durations_are_written_in_fitting_units(seconds, text):
    assert time_text(seconds) == text
