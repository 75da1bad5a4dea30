"""Runs: what they learn and write, how they stop and resume, and the errors they raise."""

import json
import shutil
import sys
from dataclasses import replace
from typing import Any

import pytest
import torch

from swag_engine.base.errors import InputError
from swag_engine.formats.ply import read_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.scene.colmap import load_scene
from swag_engine.settings.settings import TrainSettings
from swag_engine.training import trainer
from swag_engine.training.checkpoint import checkpoints, load_checkpoint
from swag_engine.training.trainer import train
from tests.scenes.tiny import make_tiny_scene

SETTINGS = TrainSettings(iterations=150, width=64, max_gaussians=500, sh_degree=1)


def stop_after(iterations):
    """Return a should_stop that is true from the call with this number, counted from 0; one call an iteration."""
    asked = iter(range(10**9))
    return lambda: next(asked) >= iterations


@pytest.fixture(scope="module")
def whole_run(tiny_scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "whole"
    events: list[dict[str, Any]] = []
    result = train(tiny_scene, folder, SETTINGS, on_event=events.append)
    return folder, result, events


def test_held_out_views_are_learned(whole_run):
    _, result, _ = whole_run
    metrics = result["metrics"]
    assert metrics["test_psnr"] > metrics["control_psnr"] + 3
    assert not result["interrupted"]
    assert metrics["iteration"] == SETTINGS.iterations


def test_densification_respects_the_largest_number(whole_run):
    _, result, _ = whole_run
    assert 300 < result["metrics"]["gaussians"] <= SETTINGS.max_gaussians


def test_the_run_folder_has_all_files(whole_run):
    folder, result, _ = whole_run
    names = {path.name for path in folder.iterdir()}
    assert {"config.json", "metrics.jsonl", "metrics.json", "result.ply", "result.glb"} <= names
    assert not [name for name in names if name.startswith(".swag-")]
    assert len(read_ply(folder / "result.ply").positions) == result["metrics"]["gaussians"]
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert {"iteration", "seconds", "loss", "psnr", "ssim", "gaussians", "ms"} <= set(lines[0])
    assert "test_psnr" in lines[-1]
    assert lines[0]["psnr"] < lines[-2]["psnr"]


def test_progress_events_are_complete(whole_run):
    *_, events = whole_run
    progress = [event for event in events if event["event"] == "progress" and event["stage"] == "train"]
    assert progress[-1]["iteration"] == SETTINGS.iterations
    assert {"seconds_left", "loss", "psnr", "gaussians", "iterations_per_second"} <= set(progress[-1])


def test_a_resumed_run_is_bit_equal_to_one_that_never_stopped(whole_run, tiny_scene, tmp_path):
    folder, _, _ = whole_run
    stopped = train(tiny_scene, tmp_path / "run", SETTINGS, should_stop=stop_after(20))
    assert stopped["interrupted"]
    assert stopped["metrics"]["iteration"] == 15  # stopped during a trial, which starts at iteration 15 and is repeated
    assert (tmp_path / "run" / "result.ply").exists()
    train(tiny_scene, tmp_path / "run", SETTINGS, resume=True)
    expected, _ = load_checkpoint(folder)
    got, state = load_checkpoint(tmp_path / "run")
    assert state["iteration"] == SETTINGS.iterations
    assert expected.keys() == got.keys()
    for name, tensor in expected.items():
        assert torch.equal(tensor, got[name]), name
    iterations = [
        json.loads(line)["iteration"] for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    ]
    assert iterations == sorted(iterations)


def test_resume_survives_a_damaged_newest_checkpoint(tiny_scene, tmp_path):
    short = replace(SETTINGS, iterations=60)
    train(tiny_scene, tmp_path / "run", short, should_stop=stop_after(20))
    train(tiny_scene, tmp_path / "run", short, resume=True, should_stop=stop_after(20))
    newest = checkpoints(tmp_path / "run")[-1]
    newest.write_bytes(newest.read_bytes()[:1000])
    result = train(tiny_scene, tmp_path / "run", short, resume=True)
    assert result["metrics"]["iteration"] == 60


def test_a_run_is_never_overwritten(whole_run, tiny_scene):
    folder, _, _ = whole_run
    with pytest.raises(InputError, match="holds a training run already"):
        train(tiny_scene, folder, SETTINGS)
    with pytest.raises(InputError, match="finished already"):
        train(tiny_scene, folder, SETTINGS, resume=True)


def test_resume_refuses_other_settings_and_scenes(tiny_scene, tmp_path):
    run = tmp_path / "run"
    train(tiny_scene, run, SETTINGS, should_stop=stop_after(2))
    with pytest.raises(InputError, match="started with width 64"):
        train(tiny_scene, run, replace(SETTINGS, width=32), resume=True)
    other = shutil.copytree(tiny_scene, tmp_path / "other")
    with pytest.raises(InputError, match="belongs to the scene"):
        train(other, run, SETTINGS, resume=True)
    with pytest.raises(InputError, match="There is no run in .* to continue"):
        train(tiny_scene, tmp_path / "nothing", SETTINGS, resume=True)


def test_a_run_continues_on_another_backend(tiny_scene, tmp_path):
    """The driver of a card may end every process that uses it."""
    short = replace(SETTINGS, iterations=6, backend="cpu")
    train(tiny_scene, tmp_path / "run", short, should_stop=stop_after(3))
    done = train(tiny_scene, tmp_path / "run", replace(short, backend="torch"), resume=True)
    assert done["metrics"]["iteration"] == 6
    assert RunFolder(tmp_path / "run").read_config()[1].backend == "torch"


def test_test_views_never_reach_a_decision(tiny_scene, tmp_path):
    """Other test images change the reported figures and nothing else."""
    short = replace(SETTINGS, iterations=40)
    spoiled = shutil.copytree(tiny_scene, tmp_path / "spoiled")
    for name in ("view_00.png", "view_08.png"):
        (spoiled / "images" / name).write_bytes((spoiled / "images" / "view_05.png").read_bytes())
    a = train(tiny_scene, tmp_path / "a", short)
    b = train(spoiled, tmp_path / "b", short)
    assert a["metrics"]["test_psnr"] != b["metrics"]["test_psnr"]
    assert a["metrics"]["psnr"] == b["metrics"]["psnr"]
    clean, _ = load_checkpoint(tmp_path / "a")
    other, _ = load_checkpoint(tmp_path / "b")
    assert all(torch.equal(clean[name], other[name]) for name in clean)


def test_two_images_are_trained_without_held_out_ones(tmp_path):
    scene = make_tiny_scene(tmp_path / "two", views=2)
    result = train(scene, tmp_path / "run", replace(SETTINGS, iterations=30))
    assert result["metrics"]["views"] == {}
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["test_psnr"] is None


def test_a_scene_without_points_is_refused(tmp_path):
    scene = make_tiny_scene(tmp_path / "empty", points=0)
    with pytest.raises(InputError, match="has no points"):
        train(scene, tmp_path / "run", SETTINGS)
    assert not (tmp_path / "run").exists()


def test_an_unreadable_image_leaves_no_run_folder(tiny_scene, tmp_path):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    (scene / "images" / "view_04.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="view_04.png"):
        train(scene, tmp_path / "run", SETTINGS)
    assert not (tmp_path / "run").exists()


def test_a_run_killed_while_loading_can_be_resumed(tiny_scene, tmp_path):
    class Killed(BaseException):
        pass

    def kill(event):
        raise Killed

    short = replace(SETTINGS, iterations=10)
    with pytest.raises(Killed):
        train(tiny_scene, tmp_path / "run", short, on_event=kill)
    assert train(tiny_scene, tmp_path / "run", short, resume=True)["metrics"]["iteration"] == 10


@pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot limit the size of files")
def test_a_file_that_cannot_be_written_whole_is_an_error_and_leaves_no_run_folder(tiny_scene, tmp_path, monkeypatch):
    import resource

    scene = load_scene(tiny_scene)
    monkeypatch.setattr(trainer, "load_scene", lambda folder: scene)

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))  # of bytes; config.json has more
    try:
        with pytest.raises(InputError, match=r"config.json: File too large"):
            train(tiny_scene, tmp_path / "run", SETTINGS)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "values", [{"iterations": -1}, {"width": "640"}, {"backend": "gpu"}, {"color": 3}, {"seed": True}]
)
def test_settings_are_checked(values):
    with pytest.raises(InputError):
        TrainSettings.from_json(values)
