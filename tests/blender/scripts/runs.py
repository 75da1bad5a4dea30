"""Runs that are opened from their folders, and compared."""

import json
import shutil
from pathlib import Path
from typing import Any

import bpy
from bl_ext.user_default.swag_splatting import operators
from bl_ext.user_default.swag_splatting.swag_blender import (
    labels,
    open_run,
    run_list,
    run_quality,
    scene_import,
    splats,
    water,
)
from files import import_splats, refusal
from mathutils import Vector


def up_of(obj, run):
    """Where the up direction of a run points in Blender's world."""
    up = Vector(json.loads(Path(run, "config.json").read_text())["up"])
    return [round(value, 4) + 0.0 for value in obj.matrix_world.to_3x3() @ up]


def state_of(obj):
    """What the scene knows of a run's object."""
    swag = bpy.context.scene.swag
    bpy.context.view_layer.update()
    return {
        "count": splats.count(obj),
        "run": Path(obj["swag_run"]).name,
        "water": water.water_of(obj) is not None,
        "background": [round(value, 3) for value in obj["swag_background"]],
        "labels": [entry.name for entry in labels.labels_of(obj).entries],
        "up": up_of(obj, obj["swag_run"]),
        "figures": run_list.figures_of(run_list.folder_of(obj)),
        "notes": run_list.notes_of(run_list.folder_of(obj)),
        "psnr": round(swag.result_psnr, 2),
        "plan": [line.name for line in swag.plan.lines],
        "folders": [Path(swag.scene_folder).name, Path(swag.run_folder).name, swag.plan_is_stale],
    }


def qualities(cases):
    """Words for the qualities of metrics, "" where there is none."""
    found = map(run_quality.quality_of, cases)
    return [quality[0].word if quality else "" for quality in found]


def open_folder_and_file(run):
    """The state after opening the folder, after its config.json, and the number of splat objects."""
    assert bpy.ops.swag.open_run(directory=run) == {"FINISHED"}
    found = {"folder": state_of(bpy.context.active_object)}
    assert bpy.ops.swag.open_run("INVOKE_DEFAULT", filepath=run + "/config.json") == {"FINISHED"}
    found["config"] = state_of(bpy.context.active_object)
    found["objects"] = len(run_list.runs_in(bpy.context.scene))
    return found


def open_beside(run):
    """What a splat file knows of the run beside it: its result as PLY and GLB, and a copy elsewhere."""
    copy = Path(run).parent / "copy.ply"
    shutil.copy(run + "/result.ply", copy)
    found = {}
    for name, path in (("ply", run + "/result.ply"), ("glb", run + "/result.glb"), ("copy", str(copy))):
        obj = import_splats(path)
        bpy.context.view_layer.update()
        found[name] = [obj.get("swag_run", ""), water.water_of(obj) is not None, up_of(obj, run)]
    return found


def refusals(run, other):
    """Messages for a folder without a run, a run without a result, and damaged files."""
    found = {"other": refusal(bpy.ops.swag.open_run, directory=other)}
    Path(run, "water.json").write_text("{")
    found["water"] = refusal(bpy.ops.swag.open_run, directory=run)
    config = Path(run, "config.json")
    kept = config.read_text()
    config.write_text("[]")
    found["config"] = refusal(bpy.ops.swag.open_run, directory=run)
    config.write_text(kept)
    Path(run, "result.ply").unlink()
    found["result"] = refusal(bpy.ops.swag.open_run, directory=run)
    return found


def adopt(run, scene):
    """Parent and place of a run's splats after the scene of its photos is imported, and without it before."""
    assert bpy.ops.swag.open_run(directory=run) == {"FINISHED"}
    obj = bpy.context.active_object
    root = bpy.data.objects.new("reef", None)
    root[scene_import.ROOT_KEY] = scene
    root.location = (1.0, 2.0, 3.0)
    bpy.context.scene.collection.objects.link(root)
    open_run.adopt_splats(root, bpy.context.scene)
    bpy.context.view_layer.update()
    assert bpy.ops.swag.open_run(directory=run) == {"FINISHED"}  # again: it finds its object
    return [obj.parent == root, list(obj.matrix_world.translation), len(run_list.runs_in(bpy.context.scene))]


def compare(first, second):
    """Names of the shown and the compared run, and where the compared one is: in its place, beside, and back."""
    assert bpy.ops.swag.open_run(directory=first) == {"FINISHED"}
    assert bpy.ops.swag.open_run(directory=second) == {"FINISHED"}
    compared = bpy.context.scene.swag_compare
    shown, other = run_list.shown_run(bpy.context), run_list.compared_run(bpy.context)
    places = []
    for beside in (False, True, False):
        compared.beside = beside
        bpy.context.view_layer.update()
        places.append([round(value, 3) for value in other.matrix_world.translation - shown.matrix_world.translation])
    bpy.ops.swag.select_run(name=other.name)
    return {
        "shown": [Path(shown["swag_run"]).name, Path(other["swag_run"]).name],
        "places": places,
        "swapped": Path(run_list.shown_run(bpy.context)["swag_run"]).name,
        "report": refusal(bpy.ops.swag.open_report),
    }


def missing_report(run):
    """Pages that Open Report opens where there is none as yet, and when pressed again."""
    assert bpy.ops.swag.open_run(directory=run) == {"FINISHED"}
    Path(run, "checkpoint-0000100.safetensors").touch()
    opened: list[str] = []
    module: Any = operators.open_report
    opening, module.open_page = module.open_page, lambda page: opened.append(page.read_text())
    try:
        bpy.ops.swag.open_report()
        Path(run, "report.html").write_text("the same report")
        bpy.ops.swag.open_report()
    finally:
        module.open_page = opening
    return opened


def cameras(run):
    """Numbers of cameras and parents after a run was opened by the engine."""
    assert bpy.ops.swag.open_run(directory=run) == {"FINISHED"}
    found = [obj.type for obj in bpy.context.scene.objects]
    runs = run_list.runs_in(bpy.context.scene)
    return {"cameras": found.count("CAMERA"), "runs": len(runs), "below the root": runs[0].parent is not None}
