"""Jobs without a window: options, dialogs, undo, messages."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
from bl_ext.user_default.swag_splatting import operators
from bl_ext.user_default.swag_splatting.swag_blender import job
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


def close_dialog():
    """The running job after Blender has closed the file dialog of another one, whose operator did not start."""
    status.begin("Training")
    asked: Any = SimpleNamespace(_engine=None)
    operators.import_scene.SWAG_OT_import_scene.cancel(asked, bpy.context)
    return status.job


def start_beside(folder):
    status.begin("Training")
    # As a file dialog calls it, which does not ask `poll`.
    told: list[Any] = []
    importer = operators.import_scene.SWAG_OT_import_scene
    asked: Any = SimpleNamespace(report=lambda kind, text: told.append(text))
    asked._must_wait = lambda context: importer._must_wait(asked, context)
    assert importer.run_blocking(asked, bpy.context) == {"CANCELLED"}
    return {"message": told[0], "job": status.job}


def cancel():
    """Whether the job is asked to stop, and whether one that ended before the answer is."""
    status.begin("Training")
    bpy.ops.swag.cancel()
    found = {"running": status.stopping}
    status.begin("")
    asked: Any = SimpleNamespace()
    operators.cancel.SWAG_OT_cancel.execute(asked, bpy.context)
    return found | {"ended": status.stopping}


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
