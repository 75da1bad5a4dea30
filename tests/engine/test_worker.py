"""The worker's protocol, spoken to the real process."""

import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from swag_engine.app.protocol import TrainRequest, parse_request
from swag_engine.base.errors import InputError
from swag_engine.base.strict_json import to_json
from swag_engine.formats.run_folder import RunFolder

ROOT = Path(__file__).resolve().parents[2]


class Worker:
    """A worker process and its events."""

    def __init__(self):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "swag_engine.app.worker"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def send(self, **request):
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()

    def until(self, *kinds):
        for line in self.process.stdout:
            event = json.loads(line)
            if event["event"] in kinds:
                return event
        raise AssertionError(f"the worker ended before {kinds}")

    def close(self):
        self.process.stdin.close()
        self.process.stdout.close()
        return self.process.wait(30)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


@pytest.fixture
def worker():
    with Worker() as started:
        yield started


def test_a_plan_is_answered_with_the_choices_in_it(worker, tiny_scene, tmp_path):
    worker.send(request="plan", scene=str(tiny_scene), out=str(tmp_path), settings={"effects": "lamp=on"})
    answer = worker.until("result", "error")
    assert answer["request"] == "plan" and answer["plan"]["effects"]["lamp"]["overruled"]
    assert json.loads((tmp_path / "plan.json").read_text()) == answer["plan"]
    worker.send(request="plan", scene=str(tiny_scene), settings={"effects": "fog=on"})
    assert "There is no effect 'fog'" in worker.until("result", "error")["message"]


def test_inspect_train_cancel_and_export(worker, tiny_scene, tmp_path):
    worker.send(request="inspect", scene=str(tiny_scene), arrays=str(tmp_path / "arrays"))
    found = worker.until("result", "error")
    assert found["registered"] == 10 and len(found["cameras"]) == 10
    assert Path(found["points"]["positions"]).exists()
    run = tmp_path / "run"
    settings = {"iterations": 100_000, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    worker.send(request="train", scene=str(tiny_scene), out=str(run), settings=settings)
    preview = worker.until("preview", "error", "result")
    assert preview["event"] == "preview" and Path(preview["path"]).exists()
    worker.send(request="cancel")
    result = worker.until("result", "error")
    assert result["interrupted"] and Path(result["ply"]).exists()
    worker.send(request="export", run=str(run), format="glb", out=str(tmp_path / "reef.glb"))
    assert worker.until("result", "error")["event"] == "result"
    assert (tmp_path / "reef.glb").read_bytes()[:4] == b"glTF"
    assert worker.close() == 0


def test_a_killed_worker_leaves_a_run_that_resumes(worker, tiny_scene, tmp_path):
    run = tmp_path / "run"
    settings = {"iterations": 400, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    worker.send(request="train", scene=str(tiny_scene), out=str(run), settings=settings)
    while worker.until("progress")["stage"] != "train":
        pass
    os.kill(worker.process.pid, signal.SIGKILL)
    worker.process.wait()
    second = Worker()
    second.send(request="train", scene=str(tiny_scene), out=str(run), settings=settings, resume=True)
    result = second.until("result", "error")
    assert result["event"] == "result" and result["metrics"]["iteration"] == 400
    assert second.close() == 0


def test_a_paused_run_stands_still_and_ends_as_if_it_had_not(tiny_scene, tmp_path):
    from swag_engine.settings.settings import TrainSettings
    from swag_engine.training.trainer import train

    settings: dict[str, Any] = {"iterations": 300, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    train(tiny_scene, tmp_path / "whole", TrainSettings(**settings))
    with Worker() as worker:
        worker.send(request="train", scene=str(tiny_scene), out=str(tmp_path / "run"), settings=settings)
        while (event := worker.until("progress"))["stage"] != "train":
            pass
        worker.send(request="pause")
        time.sleep(1.0)  # what was on its way arrives
        while select.select([worker.process.stdout], [], [], 0)[0]:
            event = worker.until("progress", "checkpoint", "preview")
        assert event["iteration"] < 300
        paused = time.monotonic()
        assert not select.select([worker.process.stdout], [], [], 2.0)[0], "it went on"
        paused = time.monotonic() - paused
        started = time.monotonic()
        worker.send(request="go_on")
        result = worker.until("result", "error")
        assert result["metrics"]["seconds"] < event["seconds"] + 1.0 + time.monotonic() - started + paused / 2
    assert (tmp_path / "run" / "result.ply").read_bytes() == (tmp_path / "whole" / "result.ply").read_bytes()


@pytest.mark.parametrize("how", ["cancel", "close"])
def test_a_paused_run_can_be_ended(worker, tiny_scene, tmp_path, how):
    settings = {"iterations": 100_000, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    worker.send(request="train", scene=str(tiny_scene), out=str(tmp_path / "run"), settings=settings)
    while worker.until("progress")["stage"] != "train":
        pass
    worker.send(request="pause")
    if how == "cancel":
        worker.send(request="cancel")
        assert worker.until("result", "error")["interrupted"]
    assert worker.close() == 0
    assert (tmp_path / "run" / "result.ply").exists()


def test_a_cancel_with_nothing_to_cancel_does_not_end_the_next_training(worker, tiny_scene, tmp_path):
    worker.send(request="cancel")
    worker.send(request="pause")
    settings = {"iterations": 20, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    worker.send(request="train", scene=str(tiny_scene), out=str(tmp_path / "run"), settings=settings)
    result = worker.until("result", "error")
    assert not result["interrupted"] and result["metrics"]["iteration"] == 20
    worker.send(request="cancel")
    worker.send(request="inspect", scene=str(tiny_scene), arrays=str(tmp_path / "arrays"))
    assert worker.until("result", "error")["event"] == "result"


@pytest.mark.parametrize("paused", [False, True])
def test_sigterm_ends_a_training_with_its_result(worker, tiny_scene, tmp_path, paused):
    settings = {"iterations": 100_000, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    worker.send(request="train", scene=str(tiny_scene), out=str(tmp_path / "run"), settings=settings)
    while worker.until("progress")["stage"] != "train":
        pass
    if paused:
        worker.send(request="pause")
        time.sleep(0.5)
    worker.process.terminate()
    assert worker.until("result", "error")["interrupted"]
    assert worker.process.wait(30) == 143
    assert (tmp_path / "run" / "result.ply").exists()


def test_sigterm_before_the_first_iteration_ends_the_worker_at_once(worker, tmp_path):
    reef = ROOT / "tests" / "scenes" / "reef_wreck"  # planning it takes seconds
    worker.send(request="train", scene=str(reef), out=str(tmp_path / "run"))
    assert worker.until("progress")["stage"] == "load"
    worker.process.terminate()
    rest = worker.process.stdout.read()
    assert worker.process.wait(30) == 143
    assert '"train"' not in rest and '"result"' not in rest
    run = RunFolder(tmp_path / "run")
    assert run.config.exists() and not run.finished() and not run.ply.exists(), "it can be continued"


def test_sigterm_ends_an_idle_worker(worker, tiny_scene, tmp_path):
    worker.send(request="inspect", scene=str(tiny_scene), arrays=str(tmp_path / "arrays"))
    worker.until("result")
    worker.process.terminate()
    assert worker.process.wait(30) == 143


def test_the_worker_ends_with_its_parent_and_keeps_what_exists(worker, tiny_scene, tmp_path):
    settings = {"iterations": 100_000, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    worker.send(request="train", scene=str(tiny_scene), out=str(tmp_path / "run"), settings=settings)
    while worker.until("progress")["stage"] != "train":
        pass
    started = time.monotonic()
    worker.process.stdin.close()
    assert worker.process.wait(30) == 0
    assert time.monotonic() - started < 20
    assert (tmp_path / "run" / "result.ply").exists()


def test_wrong_requests_are_answered_and_the_worker_lives_on(worker, tiny_scene, tmp_path):
    worker.process.stdin.write("nonsense\n")
    worker.process.stdin.flush()
    assert worker.until("error")["kind"] == "input"
    worker.send(request="train", scene=str(tmp_path / "nowhere"), out=str(tmp_path / "run"))
    error = worker.until("error")
    assert error["kind"] == "input" and "nowhere" in error["message"] and "\n" not in error["message"]
    assert not (tmp_path / "run").exists()
    worker.send(request="inspect", scene=str(tiny_scene), arrays=str(tmp_path / "arrays"))
    assert worker.until("result", "error")["event"] == "result"


@pytest.mark.parametrize(
    "line",
    [
        "[]",
        '{"request": "paint"}',
        '{"request": "train", "scene": "a"}',
        '{"request": "train", "scene": 3, "out": "b"}',
        '{"request": "train", "scene": "a", "out": "b", "settings": {"iterations": -1}}',
        '{"request": "train", "scene": "a", "out": "b", "resume": "yes"}',
        '{"request": "export", "run": "a", "format": "obj", "out": "b"}',
        '{"request": "inspect", "scene": "a", "arrays": "b", "more": 1}',
    ],
)
def test_requests_are_validated(line):
    with pytest.raises(InputError):
        parse_request(line)


def test_a_good_request_is_parsed():
    request = parse_request('{"request": "train", "scene": "a", "out": "b", "settings": {"width": 99}}')
    assert isinstance(request, TrainRequest) and request.settings.width == 99 and not request.resume


def test_events_are_strict_json():
    assert json.loads(to_json({"psnr": float("nan"), "views": [float("inf"), 1.5]})) == {
        "psnr": None,
        "views": [None, 1.5],
    }


def test_a_missing_package_is_named_with_what_to_do(tiny_scene, tmp_path):
    (tmp_path / "torch.py").write_text("raise ModuleNotFoundError(\"No module named 'torch'\", name='torch')")
    done = subprocess.run(
        [sys.executable, "-m", "swag_engine.app.worker"], cwd=ROOT, capture_output=True, text=True, timeout=60,
        input=json.dumps({"request": "plan", "scene": str(tiny_scene)}), env=os.environ | {"PYTHONPATH": str(tmp_path)},
    )  # fmt: skip
    event = json.loads(done.stdout)
    assert event["event"] == "error" and event["kind"] == "input"
    assert event["message"].startswith(f"{sys.executable} lacks the package torch: install")
    assert "Install Engine" in event["message"]
