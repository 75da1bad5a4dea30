"""Runs inside the real Blender, with a window: what a person does in the sidebar, with the pointer.

Environment: SWAG_ZIP the extension, SWAG_SCENE the COLMAP scene, SWAG_OUT the folder for pictures and report.json,
SWAG_ENGINE_PYTHON the engine's Python. The file $READY tells the caller that all is done.
"""

import json
import os
import subprocess
import sys
import time
import traceback
from pathlib import Path

import bpy

# Before Blender draws for the first time: a splash screen would eat the first click.
bpy.context.preferences.view.show_splash = False
OUT = Path(os.environ["SWAG_OUT"])
# Where the buttons are on a screen of 1280 x 800, from its top left corner.
TRAIN, CONTINUE, PAUSE, CANCEL = (900, 470), (960, 470), (830, 424), (950, 424)
report = {"version": bpy.app.version_string}


def view3d():
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    return window, area, next(region for region in area.regions if region.type == "UI")


def photograph(name):
    subprocess.run(["import", "-window", "root", str(OUT / f"{name}.png")], check=True)


def click(x, y):
    # In steps: Blender highlights a button when the pointer moves over it, and clicks what is highlighted.
    for offset in (40, 20, 10, 0):
        subprocess.run(["xdotool", "mousemove", str(x - offset), str(y)], check=True)
        yield 0.2
    yield 0.5
    subprocess.run(["xdotool", "click", "1"], check=True)
    yield 0.2


def measured(function, seconds):
    """`function`, with the time of each call noted in `seconds`."""

    def timed(*arguments):
        started = time.perf_counter()
        try:
            return function(*arguments)
        finally:
            seconds.append(time.perf_counter() - started)

    return timed


def until(condition, seconds):
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"waited {seconds} s")
        yield 0.05


def steps():
    bpy.context.preferences.system.use_online_access = False
    bpy.ops.extensions.package_install_files(
        filepath=os.environ["SWAG_ZIP"], repo="user_default", enable_on_install=True, overwrite=True
    )
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    yield 2.0
    window, area, region = view3d()
    area.spaces.active.show_region_ui = True
    yield 1.0
    region.active_panel_category = "SWAG"
    yield 1.0
    photograph("1-empty")

    status, swag = bpy.context.window_manager.swag, bpy.context.scene.swag
    with bpy.context.temp_override(window=window, area=area):
        started = time.monotonic()
        bpy.ops.swag.import_scene("INVOKE_DEFAULT", directory=os.environ["SWAG_SCENE"])
        yield from until(lambda: not status.job, 90)
        report["import_seconds"] = time.monotonic() - started
        report["imported"] = {"failed": status.failed, "message": status.message, "found": swag.found}
        region.tag_redraw()
    swag.iterations = 100_000
    yield 1.0
    photograph("2-imported")

    yield from click(*TRAIN)
    yield from until(lambda: status.job == "Training", 90)
    yield from until(lambda: status.iteration > 0 and status.factor > 0, 90)
    clouds = lambda: [o for o in bpy.data.objects if "swag_run" in o]  # noqa: E731
    yield from until(clouds, 90)
    # What we take of Blender's time while the training runs (drawing in software takes most of it here).
    job = sys.modules["bl_ext.user_default.swag_splatting.swag_blender.job"]
    report["held_seconds"] = []
    job.Job._follow = measured(job.Job._follow, report["held_seconds"])
    yield 4.0
    report["training"] = {"iteration": status.iteration, "gaussians": status.gaussians, "figures": status.figures()}
    report["preview"] = len(clouds()[0].data.points)
    photograph("3-training")

    yield from click(*PAUSE)
    yield from until(lambda: status.paused, 90)
    yield 3.0  # what was on its way arrives
    paused_at = status.iteration
    yield 2.0
    report["went_on_by"] = status.iteration - paused_at
    yield from click(*PAUSE)
    yield from until(lambda: not status.paused and status.iteration > paused_at, 90)

    yield from click(*CANCEL)
    report["stopping"] = status.stopping or not status.job
    yield from until(lambda: not status.job, 90)
    yield 1.0
    report["end"] = {
        "failed": status.failed, "message": status.message, "interrupted": swag.result_interrupted,
        "points": len(clouds()[0].data.points), "gaussians": swag.result_gaussians, "continue": swag.can_continue,
    }  # fmt: skip
    photograph("4-cancelled")

    yield from click(*CONTINUE)
    yield from until(lambda: status.job == "Training" and status.iteration > report["training"]["iteration"], 90)
    subprocess.run(["xdotool", "key", "Escape"], check=True)
    yield from until(lambda: not status.job, 90)
    report["escaped"] = {"failed": status.failed, "message": status.message, "points": len(clouds()[0].data.points)}

    yield from click(*CONTINUE)
    yield from until(lambda: status.job == "Training", 90)
    bpy.ops.wm.read_homefile(use_empty=True)
    yield 0.5
    status = bpy.context.window_manager.swag
    engines = sys.modules["bl_ext.user_default.swag_splatting.swag_blender.engine_process"]._running
    report["loaded"] = {"job": status.job, "engines": len(engines), "message": status.message}


def run(generator):
    try:
        return next(generator)
    except StopIteration:
        report["done"] = True
    except Exception:
        report["traceback"] = traceback.format_exc()
        photograph("failed")
    (OUT / "report.json").write_text(json.dumps(report))
    Path(os.environ["READY"]).touch()
    bpy.app.timers.register(lambda: bpy.ops.wm.quit_blender() and None, first_interval=2.0)
    return None


sequence = steps()
bpy.app.timers.register(lambda: run(sequence), first_interval=2.0, persistent=True)
