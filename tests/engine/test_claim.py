"""Claims on folders that several machines may work in."""

import json
import os
import socket
import subprocess
import sys
import time

import pytest

from swag_engine.base import claim as claims
from swag_engine.base.claim import FILE, claimed, read_claim
from swag_engine.base.files import FolderInUse


def write_claim(folder, **values):
    folder.mkdir(exist_ok=True)
    (folder / FILE).write_text(json.dumps({"host": "another", "pid": 1, "token": "t", "beat": 3} | values))


def test_a_claim_is_there_while_the_block_runs_and_beats(tmp_path, monkeypatch):
    monkeypatch.setattr(claims, "BEAT_SECONDS", 0.02)
    with claimed(tmp_path / "job") as claim:
        first = read_claim(tmp_path / "job" / FILE)
        assert first["host"] == socket.gethostname() and first["pid"] == os.getpid()
        deadline = time.monotonic() + 5
        while read_claim(tmp_path / "job" / FILE)["beat"] < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
        assert read_claim(tmp_path / "job" / FILE)["beat"] >= 2 and not claim.lost
    assert not (tmp_path / "job").exists()


def test_the_claim_of_a_dead_process_of_this_machine_is_taken_over_at_once(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    write_claim(tmp_path, host=socket.gethostname(), pid=dead.pid)
    started = time.monotonic()
    with claimed(tmp_path):
        assert read_claim(tmp_path / FILE)["pid"] == os.getpid()
    assert time.monotonic() - started < 5


def test_the_claim_of_another_machine_is_taken_over_when_it_does_not_beat(tmp_path):
    write_claim(tmp_path)
    with claimed(tmp_path, watched_seconds=0.2):
        assert read_claim(tmp_path / FILE)["pid"] == os.getpid()


def test_another_machine_that_beats_is_left_alone_whatever_its_clock(tmp_path, monkeypatch):
    write_claim(tmp_path)
    os.utime(tmp_path / FILE, (0, 0))  # a clock far behind

    def sleep(seconds):
        write_claim(tmp_path, beat=4)
        os.utime(tmp_path / FILE, (0, 0))

    monkeypatch.setattr(claims.time, "sleep", sleep)
    with pytest.raises(FolderInUse, match="process 1 on another"), claimed(tmp_path, watched_seconds=2):
        pass
    assert read_claim(tmp_path / FILE)["beat"] == 4


def test_a_second_process_of_this_machine_is_refused(tmp_path):
    code = "import sys; from pathlib import Path; from swag_engine.base.claim import claimed\n"
    code += "with claimed(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    other = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdin=-1, stdout=-1, text=True)
    assert other.stdout.readline() == "held\n"
    with pytest.raises(FolderInUse), claimed(tmp_path):
        pass
    other.kill()
    other.wait()
    with claimed(tmp_path):
        pass


def test_a_process_that_was_taken_over_knows_it(tmp_path, monkeypatch):
    monkeypatch.setattr(claims, "BEAT_SECONDS", 0.02)
    with claimed(tmp_path) as claim:
        write_claim(tmp_path)
        deadline = time.monotonic() + 5
        while not claim.lost and time.monotonic() < deadline:
            time.sleep(0.01)
        assert claim.lost
    assert read_claim(tmp_path / FILE)["host"] == "another"
