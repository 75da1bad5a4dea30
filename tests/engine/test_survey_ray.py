"""Surveys on a Ray cluster, all nodes of which are this machine; the jobs are stand-ins (stand_in_survey.py)."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

if sys.platform != "linux":
    pytest.skip("Ray has clusters on Linux only", allow_module_level=True)
ray = pytest.importorskip("ray")
from ray.cluster_utils import Cluster

from swag_engine.base.errors import InputError
from swag_engine.survey import run
from swag_engine.survey.executors import protocol
from swag_engine.survey.executors.ray import STORE_BYTES, RayExecutor
from swag_engine.survey.run import run_survey
from tests.scenes import stand_in_survey
from tests.scenes.stand_in_survey import expected, make_survey, results, starts

ROOT = Path(__file__).resolve().parents[2]
JOB = (stand_in_survey.__file__,)
BLOCKS = ["B-001", "B-002", "B-003", "B-004"]
UNDISTURBED = {name: expected(name) for name in BLOCKS}
NODE = {"num_cpus": 1, "object_store_memory": STORE_BYTES}


@pytest.fixture(scope="module")
def cluster():
    """A cluster of a head, on which no job runs, and two nodes with one core each."""
    cluster = Cluster(initialize_head=True, head_node_args=NODE | {"num_cpus": 0, "include_dashboard": False})
    for _ in range(2):
        cluster.add_node(**NODE)  # type: ignore[arg-type]
    yield cluster
    cluster.shutdown()


@pytest.fixture(autouse=True)
def stand_in(monkeypatch):
    monkeypatch.setattr(protocol, "JOB", JOB)
    monkeypatch.setattr(run, "RECHECK_SECONDS", 0.3)
    monkeypatch.setattr(run, "REFRESH_SECONDS", 0.1)


def raylet(node):
    """Return what jobs on a node of the cluster know it by."""
    return str(node.all_processes["raylet"][0].process.pid)


def nodes_of(folder, names=BLOCKS):
    """Return the node of each start of each block."""
    return {name: [line.split()[2] for line in starts(folder, name)] for name in names}


def test_a_block_that_a_node_refuses_is_trained_on_another_one(cluster, tmp_path):
    """One of two nodes lacks a photo of two blocks, both lack one of a third."""
    bad = raylet(cluster.list_all_nodes()[1])
    orders = {"B-001": [f"refuse on {bad}"] * 3, "B-002": [f"refuse on {bad}"] * 3, "B-003": ["refuse"] * 9}
    folder = make_survey(tmp_path / "survey", orders=orders)
    events: list[dict] = []
    document = run_survey(folder, RayExecutor("cpu", cluster.address), events.append)
    assert results(folder) == UNDISTURBED | {"B-003": None} and document["exit_code"] == 2
    used = nodes_of(folder)
    assert len(set(sum(used.values(), []))) == 2, "one node did all the work"
    assert bad in used["B-001"] + used["B-002"] and used["B-001"][-1] != bad and used["B-002"][-1] != bad
    assert len(used["B-003"]) == len(set(used["B-003"])) == 2, "each node is asked once"
    assert document["sentences"][0].startswith("Block B-003 failed in 2 attempts: On node ")
    assert "a.png cannot be read" in document["sentences"][0]
    assert events[-1]["executor"] == "2 nodes, 1 thread for each job"


def test_a_node_is_lost_and_one_is_added(cluster, tmp_path, capsys):
    """The blocks of the lost node go on from their checkpoints, on the others; that is no failed attempt."""
    lost = cluster.add_node(**NODE)
    known_as = raylet(lost)
    folder = make_survey(tmp_path / "survey", orders=dict.fromkeys(BLOCKS, [f"endless on {known_as}"]))
    changed: list[bool] = []

    def change(event):
        at_work = [row["name"] for row in event["blocks"] if row["name"] in BLOCKS and row["iteration"] in range(1, 20)]
        if not changed and any(known_as in nodes for nodes in nodes_of(folder, at_work).values()):
            changed.append(True)
            cluster.remove_node(lost, allow_graceful=False)
            cluster.add_node(**NODE)

    document = run_survey(folder, RayExecutor("cpu", cluster.address), change)
    assert changed and document["done"] == 5 and results(folder) == UNDISTURBED
    assert not capsys.readouterr().out, "stdout is for the answer of the command"
    assert all(row["attempts"] == 0 for row in document["blocks"])
    used = nodes_of(folder)
    assert any(nodes[0] == known_as and len(nodes) > 1 for nodes in used.values()), used


def test_stopping_keeps_what_exists(cluster, tmp_path):
    # No block is done before it is told to end, on however busy a machine.
    folder = make_survey(tmp_path / "survey", orders={name: ["endless"] * 9 for name in BLOCKS})
    seen: list[dict] = []

    def at_work(event):
        seen.extend(row for row in event["blocks"] if row["name"] in BLOCKS and row["iteration"] > 0)

    document = run_survey(folder, RayExecutor("cpu", cluster.address), at_work, lambda: bool(seen))
    assert document["interrupted"] and document["done"] < 5 and not document["sentences"]
    assert "begun" in {row["state"] for row in document["blocks"]}, "no checkpoint was kept"


DRIVER = """
import sys; from pathlib import Path
from swag_engine.survey import run
from swag_engine.survey.executors import protocol
from swag_engine.survey.executors.ray import RayExecutor
protocol.JOB, run.RECHECK_SECONDS = (sys.argv[3],), 0.3
run.run_survey(Path(sys.argv[1]), RayExecutor("cpu", sys.argv[2]))
"""


def test_a_driver_is_killed_and_started_again(cluster, tmp_path):
    folder = make_survey(tmp_path / "survey")
    with subprocess.Popen([sys.executable, "-c", DRIVER, folder, cluster.address, *JOB], cwd=ROOT) as driver:
        until = time.monotonic() + 180
        while len(sum(nodes_of(folder).values(), [])) < 2:
            assert time.monotonic() < until and driver.poll() is None
            time.sleep(0.02)
        driver.kill()
    document = run_survey(folder, RayExecutor("cpu", cluster.address))
    assert document["done"] == 5 and results(folder) == UNDISTURBED
    assert max(len(lines) for lines in nodes_of(folder).values()) > 1, "no block was begun by the killed driver"


def test_a_cluster_on_this_machine(tmp_path):
    folder = make_survey(tmp_path / "survey", blocks=1)
    assert run_survey(folder, RayExecutor("auto"))["done"] == 2
    assert results(folder) == {"B-001": expected("B-001")}


def test_an_address_without_a_cluster():
    with pytest.raises(InputError, match="No Ray cluster answers at 127.0.0.1:6378 .*: start one with `ray start"):
        RayExecutor("cpu", "127.0.0.1:6378")
