"""The command line as a user meets it: exit codes, JSON, sentences."""

import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from swag_engine.app import cli, progress
from swag_engine.app.interrupts import Interrupts
from swag_engine.kernels.machine import PACKAGES, engine_version

ROOT = Path(__file__).resolve().parents[2]
TRAIN = ["--iterations", "60", "--width", "64", "--max-gaussians", "400", "--sh-degree", "0"]


def swag(*arguments, **more):
    command = [sys.executable, "-m", "swag_engine", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, **more)


@pytest.fixture
def call(capsys):
    """Like `swag`, in this process: to start another one takes seconds."""

    def called(*arguments):
        capsys.readouterr()
        try:
            code = cli.main([str(argument) for argument in arguments])
        except SystemExit as usage:
            code = usage.args[0]
        printed = capsys.readouterr()
        return SimpleNamespace(returncode=code, stdout=printed.out, stderr=printed.err)

    return called


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


def test_a_reader_that_has_enough_of_the_output_is_no_error():
    reader, writer = os.pipe()
    os.close(reader)  # as `| head` does
    command = [sys.executable, "-m", "swag_engine", "render", "--help"]
    done = subprocess.run(command, cwd=ROOT, stdout=writer, stderr=subprocess.PIPE, text=True, timeout=120)
    os.close(writer)
    assert done.returncode == 141 and not done.stderr


def test_inspect_prints_what_was_found(tiny_scene, call):
    done = swag("inspect", tiny_scene)
    assert done.returncode == 0 and "10" in done.stdout and "300" in done.stdout
    assert json.loads(call("inspect", tiny_scene, "--json").stdout)["registered"] == 10


def test_train_answers_in_json_alone(run):
    folder, result = run
    assert result["metrics"]["iteration"] == 60
    assert Path(result["ply"]).parent == folder


def test_evaluate_repeats_the_figures_of_training(run, call):
    folder, result = run
    scores = json.loads(call("evaluate", folder, "--json").stdout)
    assert scores["test_psnr"] == result["metrics"]["test_psnr"]
    assert set(scores["views"]) == {"view_00.png", "view_08.png"}


def test_render_writes_pictures_and_knows_its_cameras(run, tmp_path, call):
    folder, _ = run
    done = call("render", folder, "--out", tmp_path / "pictures", "--camera", "view_03.png")
    assert done.returncode == 0 and (tmp_path / "pictures" / "view_03.png").stat().st_size > 500
    assert_one_sentence(call("render", folder, "--out", tmp_path, "--camera", "view_99.png"))


def test_film_renders_the_cameras_that_export_writes(run, tmp_path, call):
    folder, _ = run
    assert call("export", folder, "--format", "ply", "--out", tmp_path / "reef.ply", "--cameras").returncode == 0
    cameras = tmp_path / "reef_cameras" / "transforms.json"
    done = call("film", folder, cameras, "--out", tmp_path / "film", "--alpha", "--depth", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["rendered"] == 10 and "Frame 1 of 10" in done.stderr
    assert (tmp_path / "film" / "view_03.png").exists() and (tmp_path / "film" / "depth" / "view_03.exr").exists()
    assert_one_sentence(call("film", folder, tmp_path / "none.json", "--out", tmp_path / "film"))


@pytest.mark.parametrize("format", ["ply", "glb"])
def test_export(run, tmp_path, format, call):
    folder, _ = run
    out = tmp_path / f"reef.{format}"
    assert call("export", folder, "--format", format, "--out", out).returncode == 0
    assert out.read_bytes()[:4] in (b"ply\n", b"glTF")


def begin(*arguments, until):
    """Start a command and wait for a line with `until` on its stderr."""
    command = [sys.executable, "-m", "swag_engine", *map(str, arguments)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        if until in line:
            return process
    raise AssertionError(f"the command ended before {until!r}: exit code {process.wait()}")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_keeps_what_exists(tiny_scene, tmp_path, number, code):
    sizes = "--width", "64", "--iterations", "100000"
    process = begin("train", tiny_scene, "--out", tmp_path / "run", "--json", *sizes, until="iterations/s")
    time.sleep(0.5)
    process.send_signal(number)
    printed, errors = process.communicate(timeout=60)
    assert process.returncode == code and "Stopping after this iteration" in errors
    assert "Aborted" not in errors and "@" not in errors, errors  # a native stack trace has an address in each line
    assert json.loads(printed)["interrupted"]
    assert {"result.ply", "result.glb", "report.html"} <= set(os.listdir(tmp_path / "run"))
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["interrupted"] and (tmp_path / "run" / f"checkpoint-{metrics['iteration']:07d}.safetensors").exists()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_ends_other_commands_with_a_document(tiny_scene, number, code):
    process = begin("forecast", tiny_scene, "--json", until="Probe runs")
    process.send_signal(number)
    printed, errors = process.communicate(timeout=60)
    assert process.returncode == code
    assert json.loads(printed) == {"error": "Interrupted.", "interrupted": True}
    assert errors.strip().splitlines()[-1] == "Interrupted." and "Traceback" not in errors and "@" not in errors


def test_ctrl_c_again_ends_at_once_and_sigterm_again_does_not(monkeypatch):
    interrupts = Interrupts()
    with interrupts.deferred():
        assert not interrupts.should_stop()
        interrupts._handle(signal.SIGTERM, None)
        interrupts._handle(signal.SIGTERM, None)
        assert interrupts.should_stop() and interrupts.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            interrupts._handle(signal.SIGINT, None)
    assert interrupts.exit_code == 143


def test_ctrl_c_again_during_an_evaluation_ends_that_and_a_third_time_everything():
    interrupts = Interrupts()
    with interrupts.deferred():
        interrupts.should_stop()
        interrupts._handle(signal.SIGTERM, None)
        assert not interrupts.should_stop_now()
        interrupts._handle(signal.SIGTERM, None)
        assert not interrupts.should_stop_now(), "a service sends it to all processes at once"
        interrupts._handle(signal.SIGINT, None)
        assert interrupts.should_stop_now() and interrupts.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            interrupts._handle(signal.SIGINT, None)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_acts_at_once_until_the_work_asks_for_it(number):
    interrupts = Interrupts()
    for _ in range(2):  # the second block has not asked, whatever the first one did
        interrupts.install()
        with interrupts.deferred(), pytest.raises(KeyboardInterrupt):
            interrupts._handle(number, None)
        with interrupts.deferred():
            interrupts.should_stop()
    assert interrupts.exit_code == 128 + number


def test_colmap_leaves_signals_alone():
    code = """
import signal
from swag_engine.scene.colmap_library import pycolmap
status = open("/proc/self/status").read()
caught = int(status.split("SigCgt:")[1].split()[0], 16)
print(caught >> (signal.SIGTERM - 1) & 1)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "0", done.stderr


def test_a_full_disk_ends_in_one_sentence(tiny_scene, tmp_path):
    def little_room():
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    done = swag("train", tiny_scene, "--out", tmp_path / "run", "--json", *TRAIN, preexec_fn=little_room)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("Cannot write")
    assert "Cannot write" in json.loads(done.stdout)["error"]
    assert not list((tmp_path / "run").glob(".swag-*")) and not list((tmp_path / "run").glob("result*"))


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
def test_bad_input_is_one_sentence(arguments, call):
    assert_one_sentence(call(*arguments))


@pytest.mark.parametrize(
    "wrong, meant",
    [("trian", "train"), ("survey rnu", "run"), ("batch evalute", "evaluate"), ("sacle", "scale"), ("qqq", None)],
)
def test_a_misspelled_command_is_named_with_the_one_that_is_meant(wrong, meant, call):
    done = call(*wrong.split(), "--json")
    assert_one_sentence(done)
    assert wrong.split()[-1] in done.stderr and done.stderr.strip() == json.loads(done.stdout)["error"]
    assert (f"Did you mean {meant}?" in done.stderr) if meant else ("Did you mean" not in done.stderr)


@pytest.mark.parametrize("name, program", [("swag", "swag"), ("__main__.py", "python -m swag_engine")])
def test_messages_name_the_program_as_it_was_started(name, program, tmp_path):
    """Also those of the commands that a command starts."""
    script = tmp_path / name
    script.write_text("import sys; from swag_engine.__main__ import main; sys.exit(main())")
    environment = {key: value for key, value in os.environ.items() if key != "SWAG_PROG"} | {"PYTHONPATH": str(ROOT)}
    (tmp_path / "scenes" / "empty").mkdir(parents=True)

    def printed(*arguments):
        command = [sys.executable, str(script), *map(str, arguments)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
        return done.stdout + done.stderr

    start = printed()
    assert [line.strip().startswith(f"{program} ") for line in start.splitlines()].count(True) == 4, start
    assert printed("--version") == f"swag {engine_version()}\n"
    assert f"{program} survey --help" in printed("survey", "rnu")
    assert f"For full helptext, run {program} --help" in printed("survey").replace("│\n", "")
    assert f"`{program} sfm PHOTOS --out SCENE`" in printed("batch", "inspect", tmp_path / "scenes")


def test_usage_errors_exit_with_two(call):
    assert call("paint").returncode == 2
    assert call("train").returncode == 2
    assert "error" in json.loads(call("train", "--json").stdout)


def test_torch_trains_where_no_kernel_runs(tiny_scene, tmp_path, call):
    few = ["--iterations", "40", "--width", "32", "--max-gaussians", "400", "--sh-degree", "0", "--recipe", "3dgs"]
    done = call("train", tiny_scene, "--out", tmp_path / "run", "--json", "--backend", "torch", *few)
    metrics = json.loads(done.stdout)["metrics"]
    assert metrics["iteration"] == 40 and metrics["test_psnr"] > metrics["control_psnr"]


def test_the_doctor_knows_all_that_the_engine_requires():
    listed = (ROOT / "requirements.txt").read_text()
    assert sorted(PACKAGES) == sorted(re.findall(r"^[\w-]+", listed, re.MULTILINE))


def test_the_doctor_says_what_runs_and_why_not_the_other(call):
    found = json.loads(swag("doctor", "--json").stdout)
    text = call("doctor").stdout
    assert found["packages"]["torch"] == torch.__version__ and found["backends"]["cpu"]["runs"]
    cuda = found["backends"]["cuda"]
    if cuda["runs"]:
        assert found["auto"] == "cuda" and cuda["device"] in text
    else:
        assert found["auto"] == "cpu" and f"backend cuda: does not run here: {cuda['reason']}" in text
    assert f"Training uses {found['auto']} on {found['hardware']['name']}, " in text


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card here")
def test_asking_for_a_card_that_is_not_there_is_one_sentence_and_leaves_nothing(tiny_scene, tmp_path, call):
    done = call("train", tiny_scene, "--out", tmp_path / "run", "--backend", "cuda", *TRAIN)
    assert_one_sentence(done)
    assert done.stderr.startswith("The cuda backend cannot run here: ") and not (tmp_path / "run").exists()


@pytest.mark.parametrize("package", ["torch", "tyro"])
def test_a_missing_package_is_named(tmp_path, package):
    """torch is imported by the command, tyro before there is one."""
    text = f"raise ModuleNotFoundError(\"No module named '{package}'\", name='{package}')"
    (tmp_path / f"{package}.py").write_text(text)
    done = swag("doctor", env={"PYTHONPATH": str(tmp_path)})
    assert_one_sentence(done)
    assert f"lacks the package {package}" in done.stderr and not done.stdout
    with_json = swag("doctor", "--json", env={"PYTHONPATH": str(tmp_path)})
    assert_one_sentence(with_json)
    assert json.loads(with_json.stdout) == {"error": with_json.stderr.strip()}


def test_continuing_a_run_that_does_not_exist_says_what_to_do(tiny_scene, tmp_path, call):
    done = call("train", tiny_scene, "--out", tmp_path / "run", "--resume")
    assert_one_sentence(done)
    assert f"There is no run in {tmp_path / 'run'} to continue: start one without --resume." in done.stderr
    assert not (tmp_path / "run").exists()


def test_a_log_has_the_first_line_of_each_stage_and_then_one_each_ten_seconds(monkeypatch, capsys):
    clock = iter(range(0, 1000))
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock) / 5)
    event = {"event": "progress", "loss": 0.1, "psnr": None, "curve": [], "next_minute_db": None, "gaussians": 7}
    event |= {"iterations_per_second": 9.0, "seconds_left": 60.0}
    with progress.training_progress() as update:
        for number in range(1, 11):
            update(event | {"stage": "load", "iteration": number, "iterations": 10})
        for number in range(1, 151):  # 30 seconds; a time budget expects the end at each of them
            update(event | {"stage": "train", "iteration": number, "iterations": number})
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[2] for line in lines] == ["Photo", *["loss"] * 3], lines


@pytest.mark.parametrize("module", ["swag_engine.app.cli", "swag_engine.app.worker"])
def test_threads_and_memory_are_set_before_numpy_and_torch_come(module):
    script = """
import importlib, os, sys

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name in ("numpy", "torch"):
            assert os.environ["OPENBLAS_NUM_THREADS"] == "1" and os.environ["OMP_WAIT_POLICY"] == "PASSIVE", name
            assert os.environ["THP_MEM_ALLOC_ENABLE"] == "1", name
            print(name)

sys.meta_path.insert(0, Watch())
importlib.import_module(sys.argv[1])
"""
    own = ("OPENBLAS_", "OMP_", "THP_")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(own)}
    done = subprocess.run(
        [sys.executable, "-c", script, module], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0 and "numpy" in done.stdout, done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="the GNU C library is asked")
def test_memory_that_was_freed_is_used_again_without_being_cleared():
    script = """
import resource
import swag_engine.base.threads
import torch

def pages_cleared():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.empty(100_000_000, dtype=torch.uint8).fill_(1)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

print(pages_cleared())
for _ in range(10):  # aligned blocks need some room until they fit where others were
    pages_cleared()
print(sum(pages_cleared() for _ in range(4)))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120)
    first, others = map(int, done.stdout.split())
    assert first > 40 and others < 20, done.stdout + done.stderr  # huge pages hold 2 MB
