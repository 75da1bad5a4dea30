"""Training from Blender without a window."""

import time

import addon_utils
import bpy
from bl_ext.user_default.swag_splatting.swag_blender import engine_process

EXTENSION = "bl_ext.user_default.swag_splatting"


def train(folder):
    """The error message of a training, or "" after it finished. No worker and no job may be left."""
    swag = bpy.context.scene.swag
    swag.scene_folder, swag.run_folder = folder, ""
    message = ""
    try:
        assert bpy.ops.swag.train() == {"FINISHED"}
    except RuntimeError as error:
        message = str(error)
    assert not engine_process._running, "a worker is left"
    assert not bpy.context.window_manager.swag.job
    return message


def clouds():
    return [obj for obj in bpy.data.objects if obj.type == "POINTCLOUD"]


def train_twice(folder):
    """What the first training put into the scene, and number of objects and run folder after the second."""
    assert train(folder) == ""
    swag = bpy.context.scene.swag
    first = {
        "points": [len(obj.data.points) for obj in clouds()],
        "run": swag.run_folder,
        "gaussians": swag.result_gaussians,
        "psnr": swag.result_psnr,
        "interrupted": swag.result_interrupted,
        "continue": swag.can_continue,
        "message": bpy.context.window_manager.swag.message,
    }
    assert train(folder) == ""
    return {"first": first, "second": {"objects": len(clouds()), "run": swag.run_folder}}


def points_after_training(folder):
    """Number of points of each object that a training made."""
    assert train(folder) == ""
    return [len(obj.data.points) for obj in clouds()]


def cancel(folder):
    """Cancel a training at iteration 6 and wait; whether its result says interrupted, or the error's message."""
    engine_process.CANCEL_SECONDS = engine_process.TERMINATE_SECONDS = 0.3
    request = {"request": "train", "scene": folder, "out": folder + "/run", "settings": {}, "resume": False}
    started = time.monotonic()
    with engine_process.Engine() as engine:
        engine.send(request)
        while time.monotonic() - started < 20:
            try:
                for event in engine.poll():
                    if event["event"] == "result":
                        return event["interrupted"]
                    if event.get("iteration") == 6:
                        engine.cancel()
            except engine_process.EngineError as error:
                return str(error)
            time.sleep(0.01)
    raise AssertionError("the engine did not answer within 20 s")


def start_worker(folder):
    """A worker that trains, after its first event."""
    engine = engine_process.Engine()
    engine.send({"request": "train", "scene": folder, "out": folder + "/run", "settings": {}, "resume": False})
    while not engine.poll():
        time.sleep(0.01)
    return engine._process


def leave_a_worker(folder):
    """Whether a worker ended with its file and with the extension; the process number of one that is still alive."""
    process = start_worker(folder)
    bpy.ops.wm.read_homefile(use_empty=True)
    ended = {"file": process.poll() is not None}
    process = start_worker(folder)
    addon_utils.disable(EXTENSION)
    ended["extension"] = process.poll() is not None
    addon_utils.enable(EXTENSION)
    return {"ended": ended, "alive": start_worker(folder).pid}


def train_by_the_engine(scene, run):
    bpy.ops.swag.import_scene(directory=scene)
    swag = bpy.context.scene.swag
    swag.iterations, swag.width, swag.run_folder = 60, 64, run
    assert bpy.ops.swag.train() == {"FINISHED"}
    made = [obj for obj in bpy.data.objects if "swag_run" in obj]
    found = {"points": [len(obj.data.points) for obj in made], "parent": made[0].parent.name}
    found |= {"gaussians": swag.result_gaussians, "psnr": swag.result_psnr}
    try:
        bpy.ops.swag.train(resume=True)
    except RuntimeError as error:
        found["resumed"] = str(error)
    return found


def inspect(folder):
    bpy.context.scene.swag.scene_folder = folder
    bpy.ops.swag.inspect_scene()
    return bpy.context.scene.swag.found
