"""Surveys run by child processes of this machine; the jobs are stand-ins (tests/scenes/stand_in_survey.py)."""

import json
import re
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from swag_engine.app.progress import survey_lines
from swag_engine.base.errors import InputError
from swag_engine.formats.survey_folder import SurveyFolder
from swag_engine.survey import job as jobs
from swag_engine.survey import run
from swag_engine.survey.executors import local, protocol
from swag_engine.survey.executors.local import LocalExecutor
from swag_engine.survey.executors.protocol import Job, Machine, cores_for_each
from swag_engine.survey.run import run_survey
from tests.scenes import stand_in_survey
from tests.scenes.stand_in_survey import expected, make_survey, results, starts

ROOT = Path(__file__).resolve().parents[2]
BLOCKS = ["B-001", "B-002", "B-003", "B-004"]
JOB = (stand_in_survey.__file__,)
linux = pytest.mark.skipif(sys.platform != "linux", reason="kills processes in the way of Linux")


@pytest.fixture(autouse=True)
def stand_in(monkeypatch):
    monkeypatch.setattr(protocol, "JOB", JOB)
    monkeypatch.setattr(run, "RECHECK_SECONDS", 0.3)
    monkeypatch.setattr(run, "REFRESH_SECONDS", 0.1)
    monkeypatch.setattr(local, "available_cores", lambda: 4)


UNDISTURBED = {name: expected(name) for name in BLOCKS}


def test_blocks_are_trained_after_the_coarse_model(tmp_path):
    folder = make_survey(tmp_path / "survey")
    events: list[dict] = []
    document = run_survey(folder, LocalExecutor("cpu", most=2), events.append)
    assert results(folder) == UNDISTURBED
    assert (document["exit_code"], document["interrupted"], document["done"]) == (0, False, 5)
    assert document["sentences"] == [] and {row["state"] for row in document["blocks"]} == {"done"}
    states = [{row["name"]: row["state"] for row in event["blocks"]} for event in events]
    assert all(state["coarse"] == "done" for state in states if "running" in [state[name] for name in BLOCKS])
    assert max(list(state.values()).count("running") for state in states) == 2
    # All cores for the coarse model, then half of them for each of two blocks.
    assert starts(folder, "coarse")[0].split()[1] == "4" and starts(folder, "B-001")[0].split()[1] == "2"
    again = run_survey(folder, LocalExecutor("cpu"))
    assert again["done"] == 5 and all(len(starts(folder, name)) == 1 for name in BLOCKS), "done blocks are not started"


def test_seams_wait_for_all_blocks(tmp_path):
    folder = make_survey(tmp_path / "survey", orders={"B-003": ["refuse"]}, seams=("S-001-002",))
    events: list[dict] = []
    document = run_survey(folder, LocalExecutor("cpu"), events.append)
    assert not starts(folder, "S-001-002") and document["exit_code"] == 2
    (folder / "orders.json").write_text('{"S-001-002": ["crash", "crash", "crash"]}')
    failed = run_survey(folder, LocalExecutor("cpu"))
    assert failed["sentences"][0].startswith("Seam S-001-002 failed in 3 attempts: "), failed
    (folder / "orders.json").write_text("{}")
    done = run_survey(folder, LocalExecutor("cpu"), events.append)
    assert (done["exit_code"], done["done"]) == (0, 6)
    states = [{row["name"]: row["state"] for row in event["blocks"]} for event in events]
    assert any(state["S-001-002"] == "running" for state in states)
    assert all({state[name] for name in BLOCKS} == {"done"} for state in states if state["S-001-002"] == "running")


def test_a_line_for_each_block_at_work(tmp_path):
    folder, lines = make_survey(tmp_path / "survey", blocks=2, orders={"B-002": ["refuse"]}), []
    run_survey(folder, LocalExecutor("cpu", most=1), lambda event: lines.append(survey_lines(event)))
    shown = "\n".join(sum(lines, []))
    assert re.search(r"B-001  iteration \d+ of 20  PSNR \d\d\.\d\d dB  0:0\d left", shown), shown
    assert "B-002  failed: " in shown and "1 done, 1 running, 1 waiting" in shown
    assert "1 at once with 4 threads each" in shown


def test_a_killed_job_goes_on_and_a_useless_one_is_left(tmp_path):
    orders = {"B-001": ["kill", "kill"], "B-002": ["refuse"], "B-003": ["crash"] * 3}
    folder = make_survey(tmp_path / "survey", orders=orders)
    document = run_survey(folder, LocalExecutor("cpu"))
    rows = {row["name"]: row for row in document["blocks"]}
    assert results(folder) == UNDISTURBED | {"B-002": None, "B-003": None}
    assert [rows[name]["attempts"] for name in BLOCKS] == [2, 1, 3, 0]
    assert (document["exit_code"], document["done"]) == (2, 3)
    refused, crashed = document["sentences"]
    command = f"survey run {folder}, or survey block {folder} --block"
    assert refused.startswith("Block B-002 failed at the first attempt: ") and "a.png cannot be read" in refused
    assert refused.endswith(f"{command} B-002.")
    assert "Block B-003 failed in 3 attempts: " in crashed and "ValueError: a bug" in crashed
    failed = json.loads(SurveyFolder(folder).failed("B-003").read_text())
    assert failed["attempts"] == 3 and "ValueError: a bug" in failed["problem"]

    (folder / "orders.json").write_text("{}")
    assert run_survey(folder, LocalExecutor("cpu"))["exit_code"] == 0 and results(folder) == UNDISTURBED


def test_attempts_that_get_further_are_not_counted(tmp_path):
    folder = make_survey(tmp_path / "survey", blocks=1, orders={"B-001": ["kill"] * 4})
    assert run_survey(folder, LocalExecutor("cpu"))["exit_code"] == 0
    assert len(starts(folder, "B-001")) == 5


def test_blocks_wait_for_the_coarse_model(tmp_path):
    folder = make_survey(tmp_path / "survey", orders={"coarse": ["refuse"]})
    document = run_survey(folder, LocalExecutor("cpu"))
    assert document["sentences"][0].startswith("The coarse model failed at the first attempt: ")
    assert document["exit_code"] == 2 and not any(starts(folder, name) for name in BLOCKS)


def test_stopping_keeps_what_exists(tmp_path):
    folder = make_survey(tmp_path / "survey")
    seen: list[dict] = []

    def at_work(event):
        seen.extend(row for row in event["blocks"] if row["name"] in BLOCKS and row["iteration"] > 2)

    document = run_survey(folder, LocalExecutor("cpu", most=2), at_work, lambda: bool(seen))
    assert document["interrupted"] and 0 < document["done"] < 5 and not document["sentences"]
    assert "begun" in {row["state"] for row in document["blocks"]}, "no checkpoint was kept"
    assert run_survey(folder, LocalExecutor("cpu"))["done"] == 5 and results(folder) == UNDISTURBED


INTERRUPTED = """
import _thread, signal, threading
from swag_engine.survey.executors import child
signal.signal(signal.SIGINT, signal.SIG_IGN)
threading.Timer(1.0, _thread.interrupt_main).start()
try:
    child.run(["-c", "import time; time.sleep(60)"], 1, "")
except KeyboardInterrupt:
    print("interrupted")
"""


def test_a_job_can_be_cancelled_where_ray_was_started_in_the_background():
    """A shell lets its background processes ignore interrupts, and with them Ray's workers."""
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], cwd=ROOT, capture_output=True, text=True, timeout=50)
    assert done.stdout == "interrupted\n", done.stderr


INTERRUPTED_AS_IT_STARTS = """
import _thread
from swag_engine.survey.executors import child

class Watched(child.Child):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        started.append(self)
        _thread.interrupt_main()

started, child.Child = [], Watched
try:
    child.run(["-c", "import time; time.sleep(60)"], 1, "")
except KeyboardInterrupt:
    print("runs on" if started[0].running() else "ended")
"""


def test_a_job_that_is_cancelled_as_it_starts_does_not_run_on():
    command = [sys.executable, "-c", INTERRUPTED_AS_IT_STARTS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=50)
    assert done.stdout == "ended\n", done.stderr


DRIVER = """
import sys, json; from pathlib import Path
from swag_engine.survey import job as jobs
from swag_engine.survey import run
from swag_engine.survey.executors import local, protocol
from swag_engine.survey.executors.local import LocalExecutor
protocol.JOB, run.RECHECK_SECONDS, local.available_cores = (sys.argv[2],), 0.3, lambda: 4
print(json.dumps(run.run_survey(Path(sys.argv[1]), LocalExecutor("cpu", most=2))))
"""


@contextmanager
def driver(folder):
    """Start another process that runs a survey, and kill it at the end if it still runs."""
    with subprocess.Popen([sys.executable, "-c", DRIVER, folder, *JOB], cwd=ROOT, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for(what, seconds=120):
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until, "it did not happen"
        time.sleep(0.02)


@linux
def test_jobs_end_with_a_killed_driver_and_another_one_goes_on(tmp_path):
    folder = make_survey(tmp_path / "survey", orders={"B-001": ["endless"], "B-002": ["endless"]})
    with driver(folder) as first:
        wait_for(lambda: len(starts(folder, "B-001") + starts(folder, "B-002")) == 2)
        first.kill()
    processes = [int(line.split()[0]) for name in BLOCKS for line in starts(folder, name)]
    wait_for(lambda: not any(Path(f"/proc/{process}").exists() for process in processes))
    assert set(results(folder).values()) == {None}, "they went on unseen"
    assert run_survey(folder, LocalExecutor("cpu"))["done"] == 5 and results(folder) == UNDISTURBED


def test_two_drivers_do_no_harm(tmp_path):
    folder = make_survey(tmp_path / "survey", orders={"B-001": ["slow"]})
    with driver(folder) as other:
        wait_for(lambda: starts(folder, "B-001"))
        document = run_survey(folder, LocalExecutor("cpu", most=3))
        theirs = json.loads(other.stdout.read())
    assert document["done"] == theirs["done"] == 5 and results(folder) == UNDISTURBED
    assert all(len(starts(folder, name)) == 1 for name in BLOCKS), "a block was trained twice"


def test_another_version_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "engine_version", lambda: "9.9.9")
    folder = make_survey(tmp_path / "survey")
    with pytest.raises(InputError, match="was planned with version .* and this machine has 9.9.9"):
        run_survey(folder, LocalExecutor("cpu"))
    assert not starts(folder, "coarse")


@pytest.mark.parametrize(
    "memory, jobs, at_once, threads", [(1, 8, 4, 1), (40, 8, 2, 2), (40, 1, 1, 4), (90, 8, 1, 4), (1000, 8, 1, 4)]
)
def test_memory_and_cores_say_how_many_run_at_once(monkeypatch, tmp_path, memory, jobs, at_once, threads):
    monkeypatch.setattr(local, "free_memory", lambda: 125)
    executor = LocalExecutor("cpu")
    executor.divide([Job(tmp_path, str(number), memory) for number in range(jobs)])
    assert executor.room() == at_once and executor.describe().startswith(f"{at_once} at once with {threads} thread")


@linux
def test_after_memory_ran_out_fewer_run_at_once(tmp_path):
    folder = make_survey(tmp_path / "survey", orders={"B-001": ["kill"]})
    executor = LocalExecutor("cpu", most=2)
    two = [Job(folder, name, 1) for name in BLOCKS[:2]]
    executor.divide(two)
    for job in two:
        executor.start(job)
    assert executor.room() == 0
    ended = executor.ended(10)
    assert [job.name for job in ended] == ["B-001"] and "because memory ran out" in ended[0].problem
    assert executor.room() == 0, "there is one less at once"
    executor.close()


def test_no_core_is_idle_for_the_sake_of_a_round_number():
    small, large = Machine(2, 8), Machine(32, 64)
    assert cores_for_each([large], 8, 100) == 4
    assert cores_for_each([small, large], 8, 100) == 4
    assert cores_for_each([large, large], 1, 100) == 1
    assert cores_for_each([large, large], 8, 2) == 32
    assert cores_for_each([Machine(16, 100, most=1)], 1, 9) == 16 and cores_for_each([Machine(16, 1, 0)], 1, 9) == 0
