"""One command over a folder of scenes: all are tried, each says what became of it."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from swag_engine.app.batch import batch, describe
from swag_engine.app.interrupts import Interrupts
from swag_engine.base.errors import InputError

TRAIN = ("--iterations", "40", "--width", "64", "--max-gaussians", "400", "--sh-degree", "0")


@pytest.fixture(scope="module")
def scenes(tiny_scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    for name in ("a reef", "c wreck"):
        shutil.copytree(tiny_scene, folder / name)
    (folder / "b empty").mkdir()
    (folder / ".hidden").mkdir()
    (folder / "notes.txt").touch()
    return folder


@pytest.fixture(scope="module")
def trained(scenes):
    command = [sys.executable, "-m", "swag_engine", "batch", "train", str(scenes), "--out", str(scenes / "runs")]
    return subprocess.run([*command, *TRAIN, "--json"], capture_output=True, text=True)


def test_a_failing_scene_stops_no_other(trained, scenes):
    document = json.loads(trained.stdout)
    assert trained.returncode == document["exit_code"] == 2 and "Traceback" not in trained.stderr
    rows = {row["name"]: row for row in document["rows"]}
    assert list(rows) == ["a reef", "b empty", "c wreck"]
    assert [row["exit_code"] for row in rows.values()] == [0, 2, 0]
    assert "No COLMAP model was found" in rows["b empty"]["error"] and rows["b empty"]["state"] == "not usable"
    assert rows["c wreck"]["result"]["metrics"]["iteration"] == 40
    assert (scenes / "runs" / "a reef" / "result.ply").exists() and not (scenes / "runs" / "b empty").exists()
    table = describe(document).splitlines()
    assert table[0].startswith("a reef   done") and table[0].endswith(" Gaussians") and "PSNR" in table[0]
    assert table[1].startswith("b empty  not usable") and table[-1] == "2 of 3 done."


def test_runs_are_exported_each_to_a_file_of_its_name(trained, scenes, tmp_path):
    (scenes / "runs" / "not a run").mkdir(exist_ok=True)
    document = batch("export", scenes / "runs", tmp_path, ("--format", "glb"), Interrupts())
    assert document["exit_code"] == 0 and not document["interrupted"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a reef.glb", "c wreck.glb"]


def test_nothing_to_do_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="is not a folder"):
        batch("train", tmp_path / "nowhere", None, (), Interrupts())
    with pytest.raises(InputError, match="holds no folders of runs"):
        batch("label", tmp_path, None, (), Interrupts())


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_ends_the_scene_at_hand_and_begins_no_other(scenes, tmp_path, number, code):
    command = [sys.executable, "-m", "swag_engine", "batch", "train", str(scenes), "--out", str(tmp_path / "runs")]
    process = subprocess.Popen(
        [*command, "--iterations", "100000", "--width", "64", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    for line in process.stderr:
        if "iterations/s" in line:
            break
    time.sleep(0.5)
    if number == signal.SIGINT:  # as the terminal does it: to all processes
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    output, _ = process.communicate(timeout=300)
    document = json.loads(output)
    assert process.returncode == document["exit_code"] == code and document["interrupted"]
    (row,) = document["rows"]
    assert row["exit_code"] == code and row["state"] == "interrupted" and row["result"]["interrupted"]
    assert (tmp_path / "runs" / "a reef" / "result.ply").exists()
