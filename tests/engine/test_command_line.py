"""The command line as a user meets it: exit codes, JSON, sentences."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from swag_engine.kernels.machine import PACKAGES

ROOT = Path(__file__).resolve().parents[2]
TRAIN = ["--iterations", "60", "--width", "64", "--max-gaussians", "400", "--sh-degree", "0"]


def swag(*arguments, **more):
    command = [sys.executable, "-m", "swag_engine", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, **more)


def assert_one_sentence(done):
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr


@pytest.fixture(scope="module")
def run(tiny_scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("Läufe") / "the run"
    done = swag("train", tiny_scene, "--out", folder, "--json", *TRAIN)
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


def test_inspect_prints_what_was_found(tiny_scene):
    done = swag("inspect", tiny_scene)
    assert done.returncode == 0 and "10" in done.stdout and "300" in done.stdout
    assert json.loads(swag("inspect", tiny_scene, "--json").stdout)["registered"] == 10


def test_train_answers_in_json_alone(run):
    folder, result = run
    assert result["metrics"]["iteration"] == 60
    assert Path(result["ply"]).parent == folder


def test_evaluate_repeats_the_figures_of_training(run):
    folder, result = run
    scores = json.loads(swag("evaluate", folder, "--json").stdout)
    assert scores["test_psnr"] == result["metrics"]["test_psnr"]
    assert set(scores["views"]) == {"view_00.png", "view_08.png"}


def test_render_writes_pictures_and_knows_its_cameras(run, tmp_path):
    folder, _ = run
    done = swag("render", folder, "--out", tmp_path / "pictures", "--camera", "view_03.png")
    assert done.returncode == 0 and (tmp_path / "pictures" / "view_03.png").stat().st_size > 500
    assert_one_sentence(swag("render", folder, "--out", tmp_path, "--camera", "view_99.png"))


@pytest.mark.parametrize("format", ["ply", "glb"])
def test_export(run, tmp_path, format):
    folder, _ = run
    out = tmp_path / f"reef.{format}"
    assert swag("export", folder, "--format", format, "--out", out).returncode == 0
    assert out.read_bytes()[:4] in (b"ply\n", b"glTF")


def test_interrupt_keeps_what_exists(tiny_scene, tmp_path):
    command = [sys.executable, "-m", "swag_engine", "train", tiny_scene, "--out", tmp_path / "run", "--width", "64"]
    process = subprocess.Popen(
        [*map(str, command), "--iterations", "100000"], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    while not (tmp_path / "run" / "config.json").exists():
        assert process.poll() is None
        time.sleep(0.1)
    time.sleep(2)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 130
    assert (tmp_path / "run" / "result.ply").exists()
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["interrupted"]


def test_a_full_disk_ends_in_one_sentence(tiny_scene, tmp_path):
    def little_room():
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    done = swag("train", tiny_scene, "--out", tmp_path / "run", "--json", *TRAIN, preexec_fn=little_room)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("Cannot write")
    assert "Cannot write" in json.loads(done.stdout)["error"]
    assert not list((tmp_path / "run").glob("*.part")) and not list((tmp_path / "run").glob("result*"))


@pytest.mark.parametrize(
    "arguments",
    [
        ("inspect", "/nowhere/at all"),
        ("train", "/nowhere", "--out", "/tmp/never"),
        ("evaluate", "/nowhere"),
        ("export", "/nowhere", "--format", "ply", "--out", "/tmp/never.ply"),
        ("train", "/nowhere", "--out", "/tmp/never", "--iterations", "-3"),
    ],
)
def test_bad_input_is_one_sentence(arguments):
    assert_one_sentence(swag(*arguments))


def test_usage_errors_exit_with_two():
    assert swag("paint").returncode == 2
    assert swag("train").returncode == 2


def test_torch_trains_where_no_kernel_runs(tiny_scene, tmp_path):
    done = swag("train", tiny_scene, "--out", tmp_path / "run", "--json", "--backend", "torch", *TRAIN)
    metrics = json.loads(done.stdout)["metrics"]
    assert metrics["iteration"] == 60 and metrics["test_psnr"] > metrics["control_psnr"]


def test_the_doctor_knows_all_that_the_engine_requires():
    assert sorted(PACKAGES) == sorted((ROOT / "requirements.txt").read_text().split())


def test_the_doctor_says_what_runs_and_why_not_the_other():
    found = json.loads(swag("doctor", "--json").stdout)
    text = swag("doctor").stdout
    assert found["packages"]["torch"] == torch.__version__ and found["backends"]["cpu"]["runs"]
    cuda = found["backends"]["cuda"]
    if cuda["runs"]:
        assert found["auto"] == "cuda" and cuda["device"] in text
    else:
        assert found["auto"] == "cpu" and f"backend cuda: does not run here: {cuda['reason']}" in text
    assert f"Training takes {found['auto']}." in text


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card here")
def test_asking_for_a_card_that_is_not_there_is_one_sentence_and_leaves_nothing(tiny_scene, tmp_path):
    done = swag("train", tiny_scene, "--out", tmp_path / "run", "--backend", "cuda", *TRAIN)
    assert_one_sentence(done)
    assert done.stderr.startswith("The cuda backend cannot run here: ") and not (tmp_path / "run").exists()


def test_a_missing_package_is_named(tmp_path):
    (tmp_path / "torch.py").write_text("raise ModuleNotFoundError(\"No module named 'torch'\", name='torch')")
    done = swag("doctor", env={"PYTHONPATH": str(tmp_path)})
    assert_one_sentence(done)
    assert "lacks the package torch" in done.stderr


@pytest.mark.parametrize("module", ["swag_engine.app.cli", "swag_engine.app.worker"])
def test_threads_are_told_to_share_the_cores_before_numpy_and_torch_come(module):
    script = """
import importlib, os, sys

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name in ("numpy", "torch"):
            assert os.environ["OPENBLAS_NUM_THREADS"] == "1" and os.environ["OMP_WAIT_POLICY"] == "PASSIVE", name
            print(name)

sys.meta_path.insert(0, Watch())
importlib.import_module(sys.argv[1])
"""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("OPENBLAS_", "OMP_"))}
    done = subprocess.run(
        [sys.executable, "-c", script, module], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0 and "numpy" in done.stdout, done.stderr
