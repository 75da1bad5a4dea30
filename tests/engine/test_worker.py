"""The worker's protocol, spoken to the real process."""

import json
import os
import select
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swag_engine.app.protocol import FilmRequest, TrainRequest, parse_request
from swag_engine.base.errors import InputError
from swag_engine.base.strict_json import to_json
from swag_engine.formats.camera_path import PathFrame, write_camera_path
from swag_engine.formats.run_folder import RunFolder
from swag_engine.scene.colmap import load_scene
from tests.scenes.panels import write_photos

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
        return self.process.wait(60)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


@pytest.fixture
def worker():
    with Worker() as started:
        yield started


@pytest.fixture(scope="module")
def lasting_worker():
    """One worker for the tests that do not end it: each would wait for another one's imports."""
    with Worker() as started:
        yield started


def test_a_plan_is_answered_with_the_choices_in_it(lasting_worker, tiny_scene, tmp_path):
    lasting_worker.send(request="plan", scene=str(tiny_scene), out=str(tmp_path), settings={"effects": "lamp=on"})
    answer = lasting_worker.until("result", "error")
    assert answer["request"] == "plan" and answer["plan"]["effects"]["lamp"]["overruled"]
    assert json.loads((tmp_path / "plan.json").read_text()) == answer["plan"]
    lasting_worker.send(request="plan", scene=str(tiny_scene), settings={"effects": "fog=on"})
    assert "There is no effect 'fog'" in lasting_worker.until("result", "error")["message"]


def test_inspect_train_cancel_and_export(worker, tiny_scene, tmp_path):
    worker.send(request="inspect", scene=str(tiny_scene), arrays=str(tmp_path / "arrays"))
    found = worker.until("result", "error")
    assert found["registered"] == 10 and len(found["cameras"]) == 10
    assert Path(found["points"]["positions"]).exists()
    run = tmp_path / "run"
    settings = {"iterations": 100_000, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    worker.send(request="train", scene=str(tiny_scene), out=str(run), settings=settings)
    preview = worker.until("preview", "error", "result")
    assert preview["event"] == "preview" and Path(preview["path"]).exists() and len(preview["background"]) == 3
    worker.send(request="cancel")
    result = worker.until("result", "error")
    assert result["interrupted"] and Path(result["ply"]).exists()
    worker.send(request="export", run=str(run), format="glb", out=str(tmp_path / "reef.glb"))
    assert worker.until("result", "error")["event"] == "result"
    assert (tmp_path / "reef.glb").read_bytes()[:4] == b"glTF"
    assert worker.close() == 0


def test_cameras_of_photos_are_found_and_described(worker, tmp_path):
    photos = write_photos(tmp_path / "photos", np.linspace(-1, 1, 6))
    worker.send(request="sfm", photos=str(photos), out=str(tmp_path / "out"), arrays=str(tmp_path / "arrays"))
    stages = []
    while (event := worker.until("progress", "result", "error"))["event"] == "progress":
        assert 0 <= event["iteration"] <= event["iterations"]
        stages.append(event["text"])
    assert event["event"] == "result" and stages[-1] == "Placing cameras"
    assert event["scene"] == str(tmp_path / "out") and event["registered"] == event["images"] == 6
    assert len(np.load(event["points"]["positions"])) == event["points"]["count"] > 100
    assert 15 < event["summary"]["cameras"][0]["field_of_view"] < 140
    assert all("focal length" in warning for warning in event["warnings"])  # of a wall it cannot be known
    assert worker.close() == 0


@pytest.mark.parametrize("how", ["cancel", "close", "terminate", "kill"])
def test_a_search_for_cameras_that_ends_early_leaves_no_model_and_no_process(worker, tmp_path, how):
    photos = write_photos(tmp_path / "photos", np.linspace(-1.5, 1.5, 24))
    folders = {name: str(tmp_path / name) for name in ("photos", "out", "arrays")}
    request = {"request": "sfm"} | folders
    worker.send(**request)
    while worker.until("progress")["stage"] != "Matching photos":
        pass
    colmap = Path(f"/proc/{worker.process.pid}/task/{worker.process.pid}/children").read_text().split()
    assert len(colmap) == 1
    if how == "cancel":
        worker.send(request="cancel")
        assert worker.until("result", "error")["message"] == "Find Cameras was stopped; nothing was written."
        worker.close()
    else:
        {"close": worker.process.stdin.close, "terminate": worker.process.terminate, "kill": worker.process.kill}[how]()
    assert worker.process.wait(20) == {"terminate": 143, "kill": -9}.get(how, 0)
    for _ in range(60):
        if not Path(f"/proc/{colmap[0]}/exe").exists():
            break
        time.sleep(0.05)
    else:
        raise AssertionError("COLMAP goes on")
    if how == "kill":
        assert not (tmp_path / "out").exists()
        # The next search in the same folder removes what the killed one left.
        with Worker() as second:
            for photo in list(photos.iterdir())[6:]:
                photo.unlink()
            second.send(**request)
            assert second.until("result", "error")["event"] == "result"
            second.close()
        assert sorted(path.name for path in tmp_path.iterdir()) == ["arrays", "out", "photos"]
        assert len(list((tmp_path / "out" / "images").iterdir())) == 6
    else:
        assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_a_film_reports_its_frames_and_can_be_cancelled(lasting_worker, finished_run, tiny_scene, tmp_path):
    camera = load_scene(tiny_scene).views[0].camera
    frames = [PathFrame(replace(camera, name=f"{n:04d}")) for n in range(1, 2001)]
    write_camera_path(tmp_path / "cameras.json", frames)
    film = {"cameras": str(tmp_path / "cameras.json"), "splats": str(finished_run / "result.ply")}
    lasting_worker.send(request="film", out=str(tmp_path / "film"), run=str(finished_run), **film)
    event = lasting_worker.until("progress", "error", "result")
    assert (event["stage"], event["text"], event["iterations"]) == ("film", "Frame 1 of 2000", 2000)
    lasting_worker.send(request="cancel")
    result = lasting_worker.until("result", "error")
    assert result["interrupted"] and 0 < result["rendered"] < 2000
    assert len(list((tmp_path / "film").iterdir())) == result["rendered"]
    (tmp_path / "nothing.json").write_text("{}")
    lasting_worker.send(request="film", out=str(tmp_path), **film | {"cameras": str(tmp_path / "nothing.json")})
    assert "no camera path" in lasting_worker.until("result", "error")["message"]


@pytest.mark.parametrize(("field", "value"), [("fps", True), ("fps", "24"), ("background", [1, 2]), ("background", 1)])
def test_a_film_request_with_a_wrong_number_is_refused(field, value):
    message = {"request": "film", "cameras": "a", "splats": "b", "out": "c"}
    right = parse_request(json.dumps(message | {"fps": 12, "background": [0, 0.5, 1]}))
    assert isinstance(right, FilmRequest) and (right.fps, right.background) == (12, (0, 0.5, 1))
    with pytest.raises(InputError, match=f"has {field} = "):
        parse_request(json.dumps(message | {field: value}))


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


@pytest.mark.parametrize("now", [False, True])
def test_stopping_now_skips_the_evaluation_and_writes_what_exists(worker, tiny_scene, tmp_path, now):
    settings = {"iterations": 100_000, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    run = tmp_path / "run"
    worker.send(request="train", scene=str(tiny_scene), out=str(run), settings=settings)
    while worker.until("progress")["stage"] != "train":
        pass
    worker.send(request="cancel", now=now)
    texts = []
    while (event := worker.until("progress", "result", "error"))["event"] == "progress":
        texts += [event["text"]] if event["stage"] == "evaluate" else []
    assert event["interrupted"] and event["metrics"]["evaluation_stopped"] is now
    assert (event["metrics"]["test_psnr"] is None) is now and bool(event["metrics"]["views"]) is not now
    assert any(text.startswith("Evaluating test photo 1 of ") for text in texts) is not now
    assert json.loads((run / "metrics.json").read_text()) == event["metrics"] and (run / "result.ply").exists()
    report = Path(event["report"])
    assert ("The evaluation was stopped" in report.read_text()) is now
    report.unlink()
    worker.send(request="report", run=str(run))
    assert worker.until("result", "error")["report"] == str(report) and report.exists()


def test_a_cancel_with_nothing_to_cancel_does_not_end_the_next_training(lasting_worker, tiny_scene, tmp_path):
    lasting_worker.send(request="cancel")
    lasting_worker.send(request="pause")
    settings = {"iterations": 20, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    lasting_worker.send(request="train", scene=str(tiny_scene), out=str(tmp_path / "run"), settings=settings)
    result = lasting_worker.until("result", "error")
    assert not result["interrupted"] and result["metrics"]["iteration"] == 20
    lasting_worker.send(request="cancel")
    lasting_worker.send(request="inspect", scene=str(tiny_scene), arrays=str(tmp_path / "arrays"))
    assert lasting_worker.until("result", "error")["event"] == "result"


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
    assert worker.process.wait(60) == 143
    assert (tmp_path / "run" / "result.ply").exists()


def test_sigterm_before_the_first_iteration_ends_the_worker_at_once(worker, tmp_path):
    reef = ROOT / "tests" / "scenes" / "reef_wreck"  # planning it takes seconds
    worker.send(request="train", scene=str(reef), out=str(tmp_path / "run"))
    assert worker.until("progress")["stage"] == "load"
    worker.process.terminate()
    rest = worker.process.stdout.read()
    assert worker.process.wait(60) == 143
    assert '"train"' not in rest and '"result"' not in rest
    run = RunFolder(tmp_path / "run")
    assert run.config.exists() and not run.finished() and not run.ply.exists(), "it can be continued"


def test_sigterm_ends_an_idle_worker(worker, tiny_scene, tmp_path):
    worker.send(request="inspect", scene=str(tiny_scene), arrays=str(tmp_path / "arrays"))
    worker.until("result")
    worker.process.terminate()
    assert worker.process.wait(60) == 143


def test_the_worker_ends_with_its_parent_and_keeps_what_exists(worker, tiny_scene, tmp_path):
    settings = {"iterations": 100_000, "width": 64, "max_gaussians": 400, "sh_degree": 0}
    worker.send(request="train", scene=str(tiny_scene), out=str(tmp_path / "run"), settings=settings)
    while worker.until("progress")["stage"] != "train":
        pass
    worker.process.stdin.close()
    assert worker.process.wait(60) == 0
    assert (tmp_path / "run" / "result.ply").exists()


def test_wrong_requests_are_answered_and_the_worker_lives_on(lasting_worker, tiny_scene, tmp_path):
    lasting_worker.process.stdin.write("nonsense\n")
    lasting_worker.process.stdin.flush()
    assert lasting_worker.until("error")["kind"] == "input"
    lasting_worker.send(request="train", scene=str(tmp_path / "nowhere"), out=str(tmp_path / "run"))
    error = lasting_worker.until("error")
    assert error["kind"] == "input" and "nowhere" in error["message"] and "\n" not in error["message"]
    assert not (tmp_path / "run").exists()
    lasting_worker.send(request="inspect", scene=str(tiny_scene), arrays=str(tmp_path / "arrays"))
    assert lasting_worker.until("result", "error")["event"] == "result"


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
