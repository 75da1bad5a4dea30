"""Jobs of a survey that are killed, stopped, run twice, or run out of disk: the result is that of undisturbed ones.

The jobs are processes of the real command, each of which takes seconds to start; so there is one survey for all faults.
"""

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

if sys.platform != "linux":
    pytest.skip("kills processes in the way of Linux", allow_module_level=True)

from swag_engine.formats.survey_folder import COARSE, SurveyFolder
from swag_engine.settings.settings import TrainSettings
from swag_engine.survey.executors.local import LocalExecutor
from swag_engine.survey.job import hash_of, run_job
from swag_engine.survey.plan import plan_survey
from swag_engine.survey.run import run_survey
from swag_engine.training.checkpoint import checkpoints
from tests.scenes.survey_scenes import tiny_survey

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = TrainSettings(iterations=40, width=48, max_gaussians=20_000, sh_degree=0, backend="cpu")
LIMIT = 2000
"""Bytes that a file of the job whose disk is full may have."""


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("planned")
    tiny_survey(folder / "scene", images=30, width=48)
    plan_survey(folder / "scene", folder / "survey", SETTINGS, 8)
    return folder


@pytest.fixture(scope="module")
def undisturbed(planned, tmp_path_factory):
    """The survey, trained without processes of its jobs."""
    files = SurveyFolder(shutil.copytree(planned, tmp_path_factory.mktemp("undisturbed") / "all") / "survey")
    for name in files.read().jobs:
        assert run_job(files.path, name)["state"] == "done"
    return files


class Disturbed(LocalExecutor):
    """Does something to the first process of some jobs.

    Args:
        faults: By the name of a job, a function of the number of its process.
    """

    def __init__(self, faults):
        super().__init__("cpu")
        self.faults, self.threads = dict(faults), []

    def start(self, job):
        super().start(job)
        if fault := self.faults.pop(job.name, None):
            process = self._children[job.name]._process.pid
            self.threads.append(threading.Thread(target=fault, args=(process,)))
            self.threads[-1].start()


def test_results_are_equal_to_the_bit(planned, undisturbed, tmp_path):
    files = SurveyFolder(shutil.copytree(planned, tmp_path / "all") / "survey")
    first, second, third, fourth = files.read().blocks[:4]
    chance, other = random.Random(5), []

    def killed(name):
        """Kill the process at any moment of the time that it takes undisturbed, or a second more."""
        seconds = chance.uniform(0, json.loads(undisturbed.done(name).read_text())["seconds"] + 1)

        def fault(process):
            time.sleep(seconds)
            os.kill(process, signal.SIGKILL)

        return fault

    def stopped_and_checkpoint_cut(process):
        """Stop the process with a checkpoint, and cut that in half before it starts again."""
        while not files.run(first).metrics_log.exists():
            time.sleep(0.01)
        os.kill(process, signal.SIGTERM)
        os.kill(process, signal.SIGTERM)
        while not checkpoints(files.run(first).path):
            time.sleep(0.01)
        for path in checkpoints(files.run(first).path):
            os.truncate(path, path.stat().st_size // 2)

    def disk_full(process):
        resource.prlimit(process, resource.RLIMIT_FSIZE, (LIMIT, LIMIT))

    def run_twice(process):
        words = ["-m", "swag_engine", "survey", "block", str(files.path), "--block", fourth, "--json"]
        answer = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, check=False)
        other.append((answer.returncode, json.loads(answer.stdout)["state"]))

    faults = {
        COARSE: killed(COARSE), first: stopped_and_checkpoint_cut, second: killed(second), third: disk_full,
        fourth: run_twice,
    }  # fmt: skip
    executor = Disturbed(faults)
    document = run_survey(files.path, executor)
    for thread in executor.threads:
        thread.join()
    rows = {row["name"]: row for row in document["blocks"]}
    left = {name: row["state"] for name, row in rows.items() if row["state"] != "done"}
    assert left == {third: "failed"} | dict.fromkeys(files.read().seams, "waiting")
    assert rows[COARSE]["attempts"] == rows[first]["attempts"] == rows[second]["attempts"] == 1, rows
    assert other and other[0][0] == 0 and other[0][1] in ("running", "done")
    (sentence,) = document["sentences"]
    assert sentence.startswith(f"Block {third} failed at the first attempt: Cannot write {files.job(third)}"), sentence
    assert "File too large" in sentence and sentence.endswith(f"survey block {files.path} --block {third}.")

    seam = files.read().seams[0]
    again = Disturbed({seam: killed(seam)})
    assert run_survey(files.path, again)["exit_code"] == 0
    again.threads[0].join()
    for name in undisturbed.read().jobs:
        assert hash_of(files.run(name).ply) == hash_of(undisturbed.run(name).ply), name
    left = [path for path in files.path.rglob("*") if path.name.startswith(".swag-") or path.name == "failed.json"]
    assert not left, "files of ended processes"
