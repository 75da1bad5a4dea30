"""Jobs without a window: options, dialogs, undo, messages."""

import gc
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
from bl_ext.user_default.swag_splatting import operators
from bl_ext.user_default.swag_splatting.swag_blender import engine_process, job, splats
from bl_ext.user_default.swag_splatting.swag_blender.training import Training
from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import write_ply
from pictures import random_splats

status = bpy.context.window_manager.swag


def failure(function, **arguments):
    try:
        function(**arguments)
    except RuntimeError as error:
        return str(error)
    raise AssertionError("it did not fail")


def options():
    """Options of every job's operator."""
    classes = [cls for module in operators._MODULES for cls in module.CLASSES if issubclass(cls, job.Job)]
    return {cls.bl_idname: sorted(cls.bl_options) for cls in classes}


def start_beside(folder):
    status.begin("Training", heavy=True)
    # As a file dialog calls it, which does not ask `poll`.
    told: list[Any] = []
    importer = operators.find_cameras.SWAG_OT_find_cameras
    asked: Any = object.__new__(
        type(
            "Asked",
            (),
            dict(_must_wait=importer._must_wait, job=importer.job, heavy=importer.heavy, memory_mb=importer.memory_mb),
        )
    )
    asked.report = lambda kind, text: told.append(text)
    assert importer.run_blocking(asked, bpy.context) == {"CANCELLED"}
    return {"message": told[0], "job": status.job}


def cancel():
    """What Cancel and Stop Now ask a job for, and what Cancel does once it has ended."""
    status.begin("Training")
    status.begin("Maps")
    found = []
    for _ in range(2):
        bpy.ops.swag.cancel(job="Training")
        found.append([(job.stopping, job.stopping_now) for job in status.running])
    status.end("Training", "", False)
    found.append(list(bpy.ops.swag.cancel(job="Training")))
    bpy.ops.swag.cancel()
    return [*found, [(job.name, job.stopping) for job in status.running]]


def texts_while_stopping():
    """What a training shows that is cancelled before and during its evaluation, and then stopped at once."""
    training = status.begin("Training")
    bpy.ops.swag.cancel()
    found = [training.shown_text]
    step = {"event": "progress", "stage": "evaluate", "text": "Evaluating test photo 3 of 7"}
    training.show(step | {"iteration": 3, "iterations": 7})
    found.append(training.shown_text)
    bpy.ops.swag.cancel()
    return [*found, training.shown_text]


def reasons(*names):
    """Why the buttons of operators are disabled; "" for those that are not."""
    found = {}
    for cls in (cls for module in operators._MODULES for cls in module.CLASSES):
        if cls.bl_idname in names:
            said: list[str] = []
            stand_in: Any = type(cls.__name__, (cls,), {"poll_message_set": staticmethod(said.append)})
            found[cls.bl_idname] = "" if stand_in.poll(bpy.context) else said[0]
    return [found[name] for name in names]


def train_beside():
    """Start a training as with a window."""
    cls: Any = job.Job
    blocking, cls.execute = cls.execute, cls.run_beside
    try:
        return bpy.ops.swag.train()
    finally:
        cls.execute = blocking


def advance_until(condition):
    """Let time pass for the jobs that run beside the user's work, as with a window."""
    started = time.monotonic()
    while not condition():
        assert time.monotonic() - started < 30
        job._jobs[:] = [running for running in job._jobs if running.advance(bpy.context)]
        time.sleep(0.01)


def beside(folder):
    """Jobs that run beside a training whose operator has ended, and what undo takes back."""
    scene = bpy.context.scene
    scene.swag.scene_folder = folder
    other = splats.new_splat_object("other", random_splats(20, 1), scene.collection)
    splats.select_only(bpy.context, [other])
    bpy.ops.ed.undo_push(message="before")
    found: dict[str, Any] = {"started": list(train_beside())}
    gc.collect()
    advance_until(lambda: status.find("Training").iteration == 6)
    other["swag_run"] = scene.swag.run_folder
    names = ("swag.train", "swag.find_cameras", "swag.inspect_scene", "swag.make_orthomosaic", "swag.label_run")
    found["same run"] = reasons(*names)
    other["swag_run"] = folder
    found["other run"] = reasons(*names)
    enough, job.free_memory = job.free_memory, lambda: 2 * 10**8
    found["no memory"] = reasons("swag.inspect_scene")
    job.free_memory = enough
    bpy.ops.swag.inspect_scene()
    found["checked"] = [status.message, [one.name for one in status.running]]
    bpy.ops.swag.cancel()
    advance_until(lambda: not status.job)
    found["message"], found["failed"] = status.message, status.failed
    found["workers"] = len(engine_process._running)
    found["objects"] = [len(obj.data.points) for obj in bpy.data.objects if obj.name != "other"]
    bpy.ops.ed.undo()
    found["undone"] = [obj.name for obj in bpy.data.objects]
    return found


def killed(folder):
    """How a training ended that ignores Cancel: its message, and whether it is shown as a warning."""
    engine_process.CANCEL_SECONDS = engine_process.TERMINATE_SECONDS = 0.3
    bpy.context.scene.swag.scene_folder = folder
    train_beside()
    advance_until(lambda: status.find("Training").iteration == 6)
    bpy.ops.swag.cancel()
    advance_until(lambda: not status.job)
    return [status.message, status.failed]


def load_beside_an_installation():
    """Jobs that run after another file was opened, and how the others ended."""
    for name in ("Training", "Installation"):
        status.begin(name)
    stopped: list[str] = []
    for name in ("Training", "Installation"):
        engine: Any = type("Engine", (), {"stop": lambda self, name=name: stopped.append(name)})()
        engine_process._running.add(engine)
        running: Any = SimpleNamespace(job=name, engine=engine, goes_on=name == "Installation", heavy=True)
        job._jobs.append(running)
    bpy.ops.wm.read_homefile(use_empty=True)
    now = bpy.context.window_manager.swag
    found = {"stopped": stopped, "running": [one.name for one in now.running], "message": now.message}
    job._jobs.clear()
    engine_process._running.clear()
    return found


def state():
    swag = bpy.context.scene.swag
    return {
        "scene_folder": swag.scene_folder,
        "run_folder": swag.run_folder,
        "plan": [[line.name, line.state] for line in swag.plan.lines],
        "stale": swag.plan_is_stale,
        "lamp": swag.plan.lines["lamp"].choice,
        "cube": "cube" in bpy.data.objects,
    }


def undo(folder):
    """The scene after undo to before its photos were chosen, after redo, and after undo of what the user chose."""
    bpy.ops.ed.undo_push(message="empty")
    bpy.context.scene.swag.scene_folder = folder
    bpy.ops.swag.plan()
    bpy.context.scene.swag.plan.lines["lamp"].choice = "ON"
    Training(bpy.context, resume=False)
    bpy.context.collection.objects.link(bpy.data.objects.new("cube", None))
    bpy.ops.ed.undo_push(message="cube")
    bpy.ops.ed.undo()
    found = {"undone": state()}
    bpy.ops.ed.redo()
    found["redone"] = state()
    swag = bpy.context.scene.swag
    swag.plan.lines["lamp"].choice = "PLAN"
    bpy.ops.ed.undo_push(message="follow the plan")
    swag.plan.lines["lamp"].choice = "OFF"
    swag.run_folder = "/elsewhere"
    bpy.ops.ed.undo_push(message="choose")
    bpy.ops.ed.undo()
    swag = bpy.context.scene.swag
    return found | {"choice": swag.plan.lines["lamp"].choice, "typed": swag.run_folder}


def undo_a_choice(folder):
    bpy.ops.ed.undo_push(message="empty")
    bpy.context.scene.swag.run_folder = folder
    bpy.ops.ed.undo_push(message="choose")
    bpy.ops.ed.undo()
    return bpy.context.scene.swag.run_folder


def train_to(scene, run):
    swag = bpy.context.scene.swag
    swag.scene_folder, swag.run_folder = scene, run
    return failure(bpy.ops.swag.train).strip().removeprefix("Error: ")


def undo_previews(folder):
    """Points of the splat objects and place of an object that the user moved, after undo and redo between previews."""
    context = bpy.context
    preview = folder + "/preview.ply"
    context.scene.swag.scene_folder = folder
    bpy.ops.object.empty_add()
    for step in range(3):
        bpy.data.objects["Empty"].location.x = step
        context.view_layer.update()
        bpy.ops.ed.undo_push(message=f"move {step}")
    training = Training(context, resume=False)

    def show(size):
        write_ply(Path(preview), random_splats(size, 1))
        training.read_preview({"path": preview, "background": [0.25, 0.5, size / 100]})
        training._preview[0].result()
        training.show_preview(context)
        context.view_layer.update()

    def state():
        context.view_layer.update()
        points = [len(obj.data.points) for obj in bpy.data.objects if "swag_run" in obj]
        return {"points": points, "x": bpy.data.objects["Empty"].location.x}

    show(30)
    show(50)
    assert [list(obj["swag_background"]) for obj in bpy.data.objects if "swag_run" in obj] == [[0.25, 0.5, 0.5]]
    found = {"before": state()}
    undone = 0
    while undone < 6 and bpy.data.objects["Empty"].location.x > 0:
        bpy.ops.ed.undo()
        undone += 1
        show(40)
    found["undone"] = state()
    for _ in range(undone):
        bpy.ops.ed.redo()
    show(60)
    found["redone"] = state()
    bpy.data.objects.remove(next(obj for obj in bpy.data.objects if "swag_run" in obj))
    show(70)
    return found | {"deleted": state()}
