"""Runs that are opened from their folders: splats, water, labels, figures, cameras; two of them beside each other."""

import json
import sys

import numpy as np
import pytest

from swag_engine.formats.run_folder import RunFolder
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.splats import Splats

UP = (0.0, -0.6, 0.8)
WATER = {
    "beta_D": [0.1, 0.05, 0.03],
    "beta_B": [0.1, 0.1, 0.1],
    "background_sh": [[0.0] * 3] * 9,
    "light": "linear",
    "per": "unit",
}
PLAN = {
    "attenuation": {"state": "on", "evidence": {"change": [0.7], "change_least": 0.1}, "reason": "Red.", "cost_ms": 1.0}
}


def make_run(folder, scene, count=20, **metrics):
    """A finished run as the engine leaves it."""
    random = np.random.default_rng(count)
    run = RunFolder(folder)
    folder.mkdir(parents=True)
    result = Splats(
        positions=random.uniform(-1, 1, (count, 3)).astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), 0.02, np.float32),
        opacities=np.full(count, 0.9, np.float32),
        sh=random.uniform(-1, 1, (count, 1, 3)).astype(np.float32),
        extras={"label": np.arange(count, dtype=np.int32) % 2 + 1},
    )
    run.write_config(scene, TrainSettings(iterations=1500, width=320, max_gaussians=5000), list(UP))
    run.write_result(result, UP)
    known = {"test_psnr": 25.5, "test_ssim": 0.8, "gaussians": count, "seconds": 61.0, "iteration": 1500}
    run.write_metrics(known | {"interrupted": False, "background": [0.1, 0.2, 0.3], "notes": ["Noted."]} | metrics)
    run.water.write_text(json.dumps(WATER))
    run.plan.write_text(json.dumps({"effects": PLAN, "water": None, "scene": ""}))
    names = [{"id": 1, "name": "coral"}, {"id": 2, "name": "wreck"}]
    (folder / "labels.json").write_text(json.dumps({"labels": names}))
    return folder


def test_the_quality_of_a_run_is_a_word(blender):
    cases = {
        (37.7, 20.4): "Excellent",  # docs/accuracy.md: aqualoc_amphorae
        (26.5, 19.7): "Good",  # docs/accuracy.md: demo
        (33.0, 24.0): "Good",  # a high PSNR is no merit where the baseline has it, too
        (33.0, 31.9): "Poor",
        (24.0, 20.0): "Fair",
        (21.9, 12.0): "Poor",
        (28.4, None): "Good",
        (None, 20.0): "",
    }
    metrics = [{"test_psnr": psnr, "control_psnr": control} for psnr, control in cases]
    assert blender.run("runs.qualities", metrics) == list(cases.values())


@pytest.fixture
def reef(tmp_path):
    folder = tmp_path / "reef"
    folder.mkdir()
    return folder


def test_a_run_is_opened_from_its_folder_or_its_config(blender, tmp_path, reef, fake_engine):
    run = make_run(tmp_path / "run", reef)
    reef.rmdir()  # the photos have been moved away
    found = blender.run("runs.open_folder_and_file", run, SWAG_ENGINE_PYTHON=fake_engine)
    assert found["objects"] == 1 and found["config"] == found["folder"]
    assert found["folder"] == {
        "count": 20, "run": "run", "water": True, "background": [0.1, 0.2, 0.3], "labels": ["coral", "wreck"],
        "up": [0.0, 0.0, 1.0],
        "notes": ["Noted."], "psnr": 25.5, "plan": ["attenuation"], "folders": ["", "run", False],
        "figures": {
            "test_psnr": "25.50 dB", "test_ssim": "0.800", "gaussians": "20", "iteration": "1,500", "width": "320 px",
            "seconds": "1:01", "recipe": "swag", "state": "Finished",
        },
    }  # fmt: skip


def test_a_result_finds_the_run_beside_it(blender, tmp_path, reef):
    run = make_run(tmp_path / "run", reef)
    found = blender.run("runs.open_beside", run)
    assert found["ply"] == found["glb"] == [str(run), True, [0.0, 0.0, 1.0]]
    assert found["copy"][:2] == ["", False]


def test_what_is_no_run_is_refused_in_a_sentence(blender, tmp_path, reef):
    run = make_run(tmp_path / "run", reef)
    found = blender.run("runs.refusals", run, reef)
    assert found["other"].startswith(f"{reef} is not the folder of a run")
    assert "water.json" in found["water"]
    assert "holds no result yet" in found["result"] and "Continue" in found["result"]
    assert "config.json does not hold a JSON object" in found["config"]


def test_splats_move_below_the_scene_of_their_photos(blender, tmp_path, reef, fake_engine):
    run = make_run(tmp_path / "run", reef)
    reef.rmdir()
    below, place, runs = blender.run("runs.adopt", run, str(reef), SWAG_ENGINE_PYTHON=fake_engine)
    assert below and place == [1.0, 2.0, 3.0] and runs == 1


def test_two_runs_stand_side_by_side_with_their_figures(blender, tmp_path, reef, fake_engine):
    first, second = (make_run(tmp_path / name, reef, count) for name, count in (("run", 400), ("run-2", 500)))
    reef.rmdir()
    found = blender.run("runs.compare", first, second, SWAG_ENGINE_PYTHON=fake_engine)
    assert found["shown"] == ["run-2", "run"] and found["swapped"] == "run"
    at_home, beside, back = found["places"]
    assert at_home == back and 1.8 < beside[0] - at_home[0] < 2.4 and beside[1:] == at_home[1:]
    assert "has no report yet" in found["report"]


def test_a_report_that_is_missing_is_written_when_it_is_opened(blender, tmp_path, reef, fake_engine):
    run = make_run(tmp_path / "run", reef)
    opened = blender.run("runs.missing_report", run, SWAG_ENGINE_PYTHON=fake_engine)
    assert opened == ["a report", "the same report"]


@pytest.mark.main_version
def test_the_engine_imports_the_cameras_of_an_opened_run(blender, tmp_path, tiny_scene):
    run = make_run(tmp_path / "run", tiny_scene)
    found = blender.run("runs.cameras", run, SWAG_ENGINE_PYTHON=sys.executable)
    assert found == {"cameras": 10, "runs": 1, "below the root": True}
