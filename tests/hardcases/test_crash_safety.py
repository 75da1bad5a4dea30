"""Killed processes, full disks, two writers: named files of a run folder are whole, and runs can be resumed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from swag_engine.base import files
from swag_engine.base.errors import InputError
from swag_engine.base.files import atomic_path, locked_folder
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = TrainSettings(iterations=20, width=48, max_gaussians=300, sh_degree=0)
linux = pytest.mark.skipif(sys.platform != "linux", reason="kills processes in the way of Linux")


@linux
def test_killed_runs_resume_bit_equal():
    """Twenty of the hundred that `python tests/hardcases/killed_runs.py` kills."""
    command = [sys.executable, "tests/hardcases/killed_runs.py", "--kills", "20", "--seed", "1"]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert seen["kills"] == 20 and all(seen[kind] for kind in ("moment", "call", "write", "full")), seen
    assert "Traceback" not in done.stderr


def test_a_file_is_flushed_before_it_is_renamed(tmp_path, monkeypatch):
    done: list[Path | str] = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda f: (done.append(Path(os.readlink(f"/proc/self/fd/{f}"))), fsync(f))[1])
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append("rename"), replace(a, b))[1])
    with atomic_path(tmp_path / "a.json") as temporary:
        temporary.write_text("{}")
    assert done == [temporary, "rename", tmp_path]


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_a_full_disk_keeps_the_old_file(tmp_path, monkeypatch, step):
    path = tmp_path / "a.json"
    path.write_text("old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match="a.json: No space left"), atomic_path(path) as temporary:
        temporary.write_text("new")
        if step == "write":
            full()
        monkeypatch.setattr(os, step, full)
    monkeypatch.undo()
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.json"]


def holder(folder: Path) -> subprocess.Popen:
    """Start another process that claims `folder`."""
    code = "from pathlib import Path; from swag_engine.base.files import locked_folder"
    code += f"\nwith locked_folder(Path({str(folder)!r})):\n    print('held', flush=True); input()"
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"held\n"
    return process


@pytest.mark.parametrize("ends", ["by itself", "killed"])
def test_a_second_process_on_one_run_is_refused(tiny_scene, tmp_path, ends):
    run = tmp_path / "run"
    with holder(run) as other:
        for resume in (False, True):
            with pytest.raises(InputError, match=f"Another process is working in {run}"):
                train(tiny_scene, run, SETTINGS, resume)
        assert os.listdir(run) == [files.LOCK]
        if ends == "killed":
            other.kill()
        else:
            other.communicate(b"\n")
    assert run.exists() == (ends == "killed")
    assert train(tiny_scene, run, SETTINGS)["metrics"]["iteration"] == SETTINGS.iterations
    assert files.LOCK not in os.listdir(run)


def test_a_second_claim_in_one_process_is_refused(tmp_path):
    with locked_folder(tmp_path / "run"):
        with pytest.raises(InputError, match="Another process"), locked_folder(tmp_path / "run"):
            pass
        with pytest.raises(InputError, match="Another process"), locked_folder(tmp_path / "run"):
            pass
    assert not (tmp_path / "run").exists()


def test_unfinished_files_of_a_killed_process_are_removed(tmp_path):
    for name in (f"{files.TEMPORARY}0123456789ab/result.ply", ".keep", "result.ply"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    with locked_folder(tmp_path):
        assert sorted(os.listdir(tmp_path)) == [".keep", files.LOCK, "result.ply"]


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="Cannot write .*file/run"), locked_folder(tmp_path / "file" / "run"):
        pass


@linux
def test_a_killed_blender_leaves_a_whole_run_and_no_worker(tiny_scene, tmp_path):
    """When its parent process dies, the worker reaches the end of its pipe, writes the result so far, and ends."""
    run = tmp_path / "run"
    request: dict[str, Any] = {"request": "train", "scene": str(tiny_scene), "out": str(run)}
    request["settings"] = {"iterations": 100_000, "width": 48, "max_gaussians": 300, "sh_degree": 0}
    code = f"""
import subprocess, sys, time
worker = subprocess.Popen([sys.executable, "-m", "swag_engine.app.worker"], stdin=-1, stdout=-1, stderr=-3, text=True)
worker.stdin.write({json.dumps(request)!r} + chr(10)); worker.stdin.flush()
for line in worker.stdout:
    if '"train"' in line:
        print(worker.pid, flush=True)
        time.sleep(1000)
"""
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE) as blender:
        worker = int(blender.stdout.readline())
        os.kill(blender.pid, signal.SIGKILL)
    for _ in range(1000):
        if not Path(f"/proc/{worker}/fd").exists() or not os.access(f"/proc/{worker}/exe", os.F_OK):
            break
        time.sleep(0.05)
    assert (run / "result.ply").exists() and files.LOCK not in os.listdir(run)
    trained = json.loads((run / "metrics.json").read_text())
    assert trained["interrupted"] and trained["iteration"] > 0
