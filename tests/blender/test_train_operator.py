"""Training from Blender without a window, against a worker that behaves as told."""

import os
import sys

import pytest

TRAIN = """
import json, pathlib, sys, tempfile, bpy
from bl_ext.user_default.swag_splatting.swag_blender import engine_process

def train(folder, **options):
    swag = bpy.context.scene.swag
    swag.scene_folder, swag.run_folder = folder, ""
    try:
        print("RETURNED", json.dumps(sorted(bpy.ops.swag.train(**options))), flush=True)
    except RuntimeError as error:
        print("REPORTED", json.dumps(str(error)), flush=True)
    assert not engine_process._running, "a worker is left"
    assert not bpy.context.window_manager.swag.job
    return swag

root = pathlib.Path(sys.argv[-1])
"""


def test_trains_to_the_end_with_progress_and_puts_the_result_into_the_scene(blender, fake_engine, tmp_path):
    (tmp_path / "Räuber höhle").mkdir()
    printed = blender.run(
        TRAIN
        + """
swag = train(str(root))
objects = [o for o in bpy.data.objects if o.type == "POINTCLOUD"]
print("RESULT", json.dumps({"objects": len(objects), "points": len(objects[0].data.points), "run": swag.run_folder,
      "gaussians": swag.result_gaussians, "psnr": swag.result_psnr, "interrupted": swag.result_interrupted,
      "continue": swag.can_continue, "status": bpy.context.window_manager.swag.message}))
again = train(str(root))
objects = [o for o in bpy.data.objects if o.type == "POINTCLOUD"]
print("AGAIN", json.dumps({"objects": len(objects), "run": again.run_folder}))
""",
        tmp_path / "Räuber höhle",
        SWAG_ENGINE_PYTHON=fake_engine,
    )
    assert blender.json_after("RETURNED", printed) == ["FINISHED"]
    result = blender.json_after("RESULT", printed)
    assert result["objects"] == 1 and result["points"] == 1000 == result["gaussians"]
    assert result["run"] == str(tmp_path / "Räuber höhle" / "swag_run")
    assert result["psnr"] == 25.5 and not result["interrupted"] and not result["continue"]
    assert result["status"] == "Trained 1000 Gaussians in 1:01, 25.5 dB on held-out photos."
    # A second run never writes over the first.
    assert blender.json_after("AGAIN", printed) == {"objects": 2, "run": result["run"] + "-2"}
    assert "Training: Photo 1 of 3" in printed
    assert "Training: Iteration 10 of 10, PSNR 30.00 dB, 1000 Gaussians, 7.5 iterations/s, 1:05 left" in printed


def test_a_preview_that_is_gone_when_the_window_comes_to_it_harms_nothing(blender, fake_engine, tmp_path):
    (tmp_path / "hasty").mkdir()
    printed = blender.run(TRAIN + "train(str(root))", tmp_path / "hasty", SWAG_ENGINE_PYTHON=fake_engine)
    assert blender.json_after("RETURNED", printed) == ["FINISHED"]


@pytest.mark.parametrize(
    ("scene", "sentence"),
    [
        ("unusable", "unusable holds no COLMAP model: look for the folder with sparse/0."),
        ("killed", "The engine was ended by signal 9 before it was done: the last line of the log"),
        ("crash", "The engine ended with exit code 1 before it was done: MemoryError: no memory left"),
    ],
)
def test_what_goes_wrong_is_one_sentence(blender, fake_engine, tmp_path, scene, sentence):
    (tmp_path / scene).mkdir()
    printed = blender.run(TRAIN + "train(str(root))", tmp_path / scene, SWAG_ENGINE_PYTHON=fake_engine)
    reported = blender.json_after("REPORTED", printed)
    assert reported.startswith("Error: ") and reported.strip().endswith(sentence)
    assert "RETURNED" not in printed


def test_no_folder_and_no_engine_are_one_sentence(blender, tmp_path):
    printed = blender.run(TRAIN + "train('')", tmp_path)
    assert "Choose the folder with the photos" in blender.json_after("REPORTED", printed)
    printed = blender.run(TRAIN + "train(str(root))", tmp_path, SWAG_ENGINE_PYTHON="/no/such/python")
    assert "The engine's Python /no/such/python cannot be run" in blender.json_after("REPORTED", printed)
    assert "Traceback" not in printed


def test_interrupting_keeps_what_exists_and_a_deaf_worker_is_killed(blender, fake_engine, tmp_path):
    (tmp_path / "endless").mkdir()
    (tmp_path / "deaf").mkdir()
    printed = blender.run(
        TRAIN
        + """
import time
engine_process.CANCEL_SECONDS = engine_process.TERMINATE_SECONDS = 0.3
for name in ("endless", "deaf"):
    request = {"request": "train", "scene": str(root / name), "out": str(root / name / "run"), "settings": {}}
    started = time.monotonic()
    with engine_process.Engine() as engine:
        engine.send({**request, "resume": False})
        outcome = None
        while outcome is None and time.monotonic() - started < 20:
            try:
                for event in engine.poll():
                    if event["event"] == "result":
                        outcome = event["interrupted"]
                    elif event.get("iteration") == 6:
                        engine.cancel()
            except engine_process.EngineError as error:
                outcome = str(error)
            time.sleep(0.01)
    print(name.upper(), json.dumps(outcome))
""",
        tmp_path,
        SWAG_ENGINE_PYTHON=fake_engine,
    )
    assert blender.json_after("ENDLESS", printed) is True
    assert (tmp_path / "endless" / "run" / "result.ply").exists()
    assert blender.json_after("DEAF", printed).startswith("The engine was ended by signal 9")


def test_worker_does_not_outlive_blender_or_the_extension(blender, fake_engine, tmp_path):
    (tmp_path / "endless").mkdir()
    printed = blender.run(
        TRAIN
        + """
import addon_utils
def start():
    engine = engine_process.Engine()
    engine.send({"request": "train", "scene": str(root), "out": str(root / "run"), "settings": {}, "resume": False})
    while not engine.poll():
        pass
    return engine

engine = start()
bpy.ops.wm.read_homefile(use_empty=True)
print("LOADED", json.dumps(engine._process.poll() is not None))
engine = start()
addon_utils.disable(EXTENSION)
print("DISABLED", json.dumps(engine._process.poll() is not None))
addon_utils.enable(EXTENSION)
print("LEFT", start()._process.pid, flush=True)
""",
        tmp_path / "endless",
        SWAG_ENGINE_PYTHON=fake_engine,
    )
    assert blender.json_after("LOADED", printed) is True
    assert blender.json_after("DISABLED", printed) is True
    left = blender.json_after("LEFT", printed)
    with pytest.raises(ProcessLookupError):
        os.kill(left, 0)


def test_trains_with_the_real_engine(blender, tiny_scene):
    printed = blender.run(
        TRAIN
        + """
bpy.ops.swag.import_scene(directory=str(root))
swag = bpy.context.scene.swag
swag.iterations, swag.width, swag.run_folder = 60, 64, bpy.app.tempdir + "run"
print("RETURNED", json.dumps(sorted(bpy.ops.swag.train())), flush=True)
made = [o for o in bpy.data.objects if "swag_run" in o]
print("RESULT", json.dumps({"objects": len(made), "points": len(made[0].data.points), "parent": made[0].parent.name,
      "gaussians": swag.result_gaussians, "psnr": swag.result_psnr}))
try:
    bpy.ops.swag.train(resume=True)
except RuntimeError as error:
    print("REPORTED", json.dumps(str(error)))
""",
        tiny_scene,
        SWAG_ENGINE_PYTHON=sys.executable,
    )
    assert blender.json_after("RETURNED", printed) == ["FINISHED"]
    result = blender.json_after("RESULT", printed)
    assert result["objects"] == 1 and result["points"] == result["gaussians"] > 0
    assert result["parent"] == tiny_scene.name and result["psnr"] > 10
    assert "is finished already" in blender.json_after("REPORTED", printed)
    assert "Traceback" not in printed


def test_inspect_says_what_was_found(blender, fake_engine, tmp_path):
    printed = blender.run(
        TRAIN
        + """
bpy.context.scene.swag.scene_folder = str(root)
bpy.ops.swag.inspect_scene()
print("FOUND", json.dumps(bpy.context.scene.swag.found))
""",
        tmp_path,
        SWAG_ENGINE_PYTHON=fake_engine,
    )
    assert blender.json_after("FOUND", printed).splitlines() == [
        "11 of 12 photos have a camera, 345 points",
        "The disk lacks one.png.",
    ]
