"""Replaces the engine's Python: speaks the worker's protocol; the name of the scene folder chooses its behaviour.

Called as `fake_worker.py -m swag_engine.app.worker`, or `-m swag_engine ARGUMENTS` for the command line.
"""

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

from swag_engine.formats.ply import write_ply
from swag_engine.splats.splats import Splats

ITERATIONS = 10
LENS = {"field_of_view": 64.2, "focal_length": 812.4}
SIZES = {
    "presets": {
        name: {"iterations": 500, "width": 480, "max_gaussians": 30_000, "lowered": name == "high"}
        for name in ("draft", "standard", "high")
    },
    "surface": {"width": 960, "pixels": 200_000.0},
}
cancelled = threading.Event()
sys.path.append(str(Path(__file__).resolve().parents[2]))  # for tests.scenes


def send(**event):
    print(json.dumps(event), flush=True)


def splats(count):
    random = np.random.default_rng(0)
    return Splats(
        positions=random.uniform(-1, 1, (count, 3)).astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), 0.02, np.float32),
        opacities=np.full(count, 0.9, np.float32),
        sh=random.uniform(-1, 1, (count, 1, 3)).astype(np.float32),
    )


def train(request):
    scene, run = Path(request["scene"]), Path(request["out"])
    behaviour = scene.name
    if behaviour == "unusable":
        send(event="error", kind="input", message=f"{scene} holds no COLMAP model: look for the folder with sparse/0.")
        return
    run.mkdir(parents=True, exist_ok=True)
    (run / "config.json").write_text(json.dumps(request | {"up": [0, 0, 1]}))
    for image in range(1, 4):
        send(event="progress", stage="load", iteration=image, iterations=3, seconds=0.1, seconds_left=1.0)
    print("a library that prints to stdout")
    iteration = 0
    while iteration < ITERATIONS and not cancelled.is_set():
        iteration += 1
        send(
            event="progress", stage="train", iteration=iteration, iterations=ITERATIONS, seconds=iteration * 0.1,
            seconds_left=65.0, loss=0.1, psnr=20.0 + iteration if iteration > 4 else None, ssim=None,
            gaussians=100 * iteration, max_gaussians=5000, width=640, iterations_per_second=7.5,
        )  # fmt: skip
        if iteration == 5:
            write_ply(run / "preview.ply", splats(50))
            send(event="preview", path=str(run / "preview.ply"), iteration=iteration)
            if behaviour == "removes its preview":
                (run / "preview.ply").unlink()
        if iteration == 6 and behaviour == "killed":
            print("the last line of the log", file=sys.stderr, flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        if iteration == 6 and behaviour == "terminated":
            os.kill(os.getpid(), signal.SIGTERM)
        if iteration == 6 and behaviour == "interrupted":  # as the engine ends that has handled the signal
            os._exit(143)
        if iteration == 6 and behaviour == "incomplete":
            raise ModuleNotFoundError("No module named 'numpy'", name="numpy")
        if iteration == 6 and behaviour == "crash":
            raise MemoryError("no memory left")
        if iteration == 6 and behaviour == "deaf":
            time.sleep(600)
        if iteration == 6 and behaviour == "endless":
            cancelled.wait()
        time.sleep(0.02)
    count = 100 * iteration
    write_ply(run / "result.ply", splats(count))
    metrics = {
        "test_psnr": 25.5,
        "test_ssim": 0.8,
        "gaussians": count,
        "seconds": 61.0,
        "interrupted": cancelled.is_set(),
        "background": [0.1, 0.2, 0.3],
        "water": "No water is modelled: it adds too little.",
        "notes": [],
    }
    (run / "metrics.json").write_text(json.dumps(metrics))
    send(
        event="result", request="train", run=str(run), ply=str(run / "result.ply"), metrics=metrics,
        interrupted=cancelled.is_set(),
    )  # fmt: skip


def summary(*lenses, drift=None):
    return {"cameras": lenses, "focal_error": 0.004, "drift": drift}


def inspect(request):
    send(
        event="result", request="inspect", scene=request["scene"], images=12, registered=11,
        points={"positions": "", "colors": "", "count": 345}, up=[0, 0, 1], cameras=[], summary=summary(LENS),
        warnings=["The disk lacks one.png."], sizes=SIZES,
    )  # fmt: skip


def sfm(request):
    source, arrays = Path(request["photos"]), Path(request["arrays"])
    if source.name == "unusable":
        send(event="error", kind="input", message=f"There are no photos (JPEG, PNG, TIFF, BMP or WebP) in {source}.")
        return
    send(event="progress", stage="Matching photos", text="Matching photos", iteration=40, iterations=100)
    cameras = []
    for index in range(4):
        pose = np.eye(4)
        pose[0, 3] = -index  # cameras in a row, one unit apart
        size = {"width": 640, "height": 360, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 180.0}
        cameras.append({"name": f"{index}.jpg", **size, "world_to_camera": pose.tolist(), "image": ""})
    paths = {"positions": str(arrays / "xyz.npy"), "colors": str(arrays / "rgb.npy")}
    np.save(paths["positions"], np.random.default_rng(0).uniform(-10, 10, (50, 3)).astype(np.float32))
    np.save(paths["colors"], np.full((50, 3), 200, np.uint8))
    send(
        event="result", request="sfm", scene=request["out"], images=5, registered=4, points=paths | {"count": 50},
        up=[0, -1, 0], cameras=cameras, summary=summary(LENS, LENS, drift={"fraction": 0.012}),
        warnings=["The focal length is doubtful."], sizes=SIZES, notes=["Took 5 of 90 frames."],
    )  # fmt: skip


def import_cameras(request):
    sfm({"photos": request["file"]} | request)


def plan(request):
    lost = {"change": [0.75, 0.4, None], "change_least": 0.1, "bic_gain": 3279.5, "bic_gain_least": 50.0}
    lines = {
        "attenuation": ("on", lost, "Red loses 75% over the scene.", 1.25),
        "lamp": ("off", {"falloff": 0.003, "falloff_least": 0.15}, "Light falls off by 0%.", 0.5),
        "moving_objects": ("unknown", {"masked_images": 0}, "Only training shows it.", 0.0),
    }
    effects = {
        name: {"state": state, "evidence": found, "reason": reason, "cost_ms": cost, "start": {}, "overruled": False}
        for name, (state, found, reason, cost) in lines.items()
    }
    send(event="result", request="plan", plan={"effects": effects, "water": None})


def forecast(request):
    send(event="progress", stage="Speed", text="Speed", iteration=0, iterations=100)
    expected = {"iterations": 500, "width": 480, "max_gaussians": 30_000, "memory_mb": 640}
    presets = {
        "draft": expected | {"seconds": [20.4, 30.0, 45.2], "psnr": [24.04, 25.0, 26.0]},
        "high": expected | {"seconds": [500.0, 700.0, 4000.0], "psnr": None},
    }
    send(event="result", request="forecast", scene=request["scene"], presets=presets, sizes=SIZES)


def chart(request):
    run = Path(request["run"])
    if run.name == "no chart":
        send(event="error", kind="input", message="None of the 3 photos shows a 24-patch color chart.")
        return
    document = {
        "delta_e": {"photos": 16.24, "restored": 6.5, "corrected": 4.8, "left_out_patches": 5.2},
        "beta_D": {"chart": [0.35, 0.12, 0.08], "error": [0.01] * 3, "run": None, "per": "unit"},
        "photos": [{"name": f"{index}.jpg"} for index in range(7)],
    }
    (run / "chart.json").write_text(json.dumps(document))
    send(event="result", request="chart", run=str(run), **document)


def restore(request):
    out = Path(request["out"])
    out.mkdir()
    (out / "request.json").write_text(json.dumps(request))
    send(event="progress", stage="Restore photos", text="Restore photos", iteration=50, iterations=100)
    send(event="result", request="restore", out=request["out"], photos=2)


def report(request):
    page = Path(request["run"]) / "report.html"
    page.write_text("a report")
    send(event="result", request="report", report=str(page))


def plan_survey(request):
    from tests.scenes.hand_made_survey import make_survey

    survey = make_survey(Path(request["out"]), Path(request["scene"]), merged=False)
    (survey.path / "request.json").write_text(json.dumps(request))
    send(event="progress", stage="Cutting", text="Cutting", iteration=40, iterations=100)
    send(event="result", request="plan_survey", survey=request["out"], blocks=4)


def merge_survey(request):
    from swag_engine.formats.survey_folder import SurveyFolder
    from tests.scenes.hand_made_survey import write_tiles

    write_tiles(SurveyFolder(Path(request["survey"])))
    send(event="progress", stage="Tiles", text="Tiles", iteration=90, iterations=100)
    send(event="result", request="merge_survey", survey=request["survey"], notes=["A note of the merge."])


def main():
    if sys.argv[2] == "swag_engine":
        print("arguments", json.dumps(sys.argv[3:]))
        sys.exit(7)
    for line in sys.stdin:
        request = json.loads(line)
        if request["request"] == "cancel":
            cancelled.set()
        else:
            if Path(request.get("scene", "")).name == "deaf":
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
            # A crash in the thread must end the process, as a crash of the engine does.
            answer = {
                "train": train,
                "inspect": inspect,
                "plan": plan,
                "forecast": forecast,
                "sfm": sfm,
                "import_cameras": import_cameras,
                "chart": chart,
                "restore": restore,
                "report": report,
                "plan_survey": plan_survey,
                "merge_survey": merge_survey,
            }[request["request"]]
            threading.Thread(target=run_or_die, args=(answer, request), daemon=True).start()
    cancelled.set()


def run_or_die(answer, request):
    try:
        answer(request)
    except BaseException:
        import traceback

        traceback.print_exc()
        os._exit(1)


main()
