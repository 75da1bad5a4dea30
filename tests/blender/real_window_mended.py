"""Runs inside the real Blender, with a window: dialogs that are closed, failed jobs, undo, Escape, Repeat Last.

Environment: that of real_window.py.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, os.environ["SWAG_OUT"])
from window import install, press, press_until, report, start, until, view3d

OUT = Path(os.environ["SWAG_OUT"])


def swag():
    """The scene's properties; undo replaces them."""
    return bpy.context.scene.swag


def status():
    return bpy.context.window_manager.swag


def run_operator(name, *arguments, **properties):
    """Call an operator in the viewport, as a button there does; the error that it reports, or ""."""
    window, area, _ = view3d()
    region = next(region for region in area.regions if region.type == "WINDOW")
    module, _, name = name.partition(".")
    with bpy.context.temp_override(window=window, area=area, region=region):
        try:
            getattr(getattr(bpy.ops, module), name)(*arguments, **properties)
        except RuntimeError as error:
            return str(error)
    return ""


def press_in_viewport(*keys):
    """Move the pointer away from what popped up and into the viewport, and press keys."""
    window, area, _ = view3d()
    region = next(region for region in area.regions if region.type == "WINDOW")
    for x, y in ((0.9, 0.6), (0.4, 0.05), (0.25, 0.25), (0.23, 0.3)):
        # The X server counts pixels from above.
        place = region.x + x * region.width, window.height - region.y - y * region.height
        subprocess.run(["xdotool", "mousemove", *(str(int(pixel)) for pixel in place)], check=True)
        yield 0.1
    press(*keys)
    yield 0.4


def job(name, **properties):
    """Start a job and wait for its end."""
    run_operator(name, "INVOKE_DEFAULT", **properties)
    yield from until(lambda: not status().job)


def shading():
    return view3d()[1].spaces.active.shading.type


def runs():
    return len(list((OUT / "scene").glob("swag_run*")))


def shows_file_browser():
    windows = bpy.context.window_manager.windows
    return any(area.type == "FILE_BROWSER" for window in windows for area in window.screen.areas)


def steps():
    install()
    yield 0.5
    run_operator("swag.import_scene", "INVOKE_DEFAULT")  # opens a file browser
    yield from until(shows_file_browser)
    yield from press_until("Escape", lambda: not shows_file_browser())
    report["dialog closed"] = status().job

    yield from job("swag.import_scene", directory=str(OUT / "no/such/folder"))
    report["import failed"] = {"shading": shading(), "message": status().message}
    yield 0.5
    press("Escape")  # the report that popped up
    yield 0.2
    yield from job("swag.import_scene", directory=os.environ["SWAG_SCENE"])
    report["imported"] = {"shading": shading()}

    cameras = [obj for obj in bpy.data.objects if obj.type == "CAMERA"][:2]
    run_operator("object.select_all", action="DESELECT")
    cameras[0].select_set(True)
    report["one selected"] = run_operator("swag.set_scale", "INVOKE_DEFAULT")
    cameras[1].select_set(True)
    units = bpy.context.scene.unit_settings
    units.scale_length = 0.01
    run_operator("swag.set_scale", "INVOKE_DEFAULT")
    yield 0.5
    press("Escape")
    yield 0.2
    run_operator("swag.set_scale", "EXEC_DEFAULT", distance=200.0)  # what "2 m" becomes in the dialog
    bpy.context.view_layer.update()
    apart = (cameras[0].matrix_world.translation - cameras[1].matrix_world.translation).length * units.scale_length
    shown = bpy.utils.units.to_string("METRIC", "LENGTH", round(apart, 4), precision=4)
    report["scaled"] = {"metres apart": apart, "shown": shown}

    yield from job("swag.plan")
    report["plan"] = len(swag().plan.lines)
    swag().iterations = 100_000
    run_operator("ed.undo_push", message="Iterations")
    run_operator("swag.train", "INVOKE_DEFAULT")
    yield from until(lambda: any("swag_run" in obj for obj in bpy.data.objects))
    report["run"] = swag().run_path
    run_operator("transform.translate", "EXEC_DEFAULT", True, value=(1.0, 0.0, 0.0))
    name = cameras[0].name
    moved = bpy.data.objects[name].matrix_world.translation.x
    for _ in range(4):  # the move, a preview if there was one, the iterations, the plan
        yield from press_in_viewport("ctrl+z")
    yield from until(lambda: abs(bpy.data.objects[name].matrix_world.translation.x - moved) > 0.5)
    yield 0.5
    back = abs(bpy.data.objects[name].matrix_world.translation.x - moved) > 0.5
    kept = {"run": swag().run_path, "plan": len(swag().plan.lines)}
    report["undone"] = kept | {"object is back": back, "job": status().job}
    yield from press_in_viewport("Escape")
    report["after escape"] = "" if status().find("Training").stopping else status().job
    run_operator("swag.cancel", "INVOKE_DEFAULT")
    yield 0.5
    report["asked first"] = not status().find("Training").stopping
    yield from press_until("Return", lambda: not status().job or status().find("Training").stopping)
    yield from until(lambda: not status().job)
    report["stopped"], report["continues"] = status().message, swag().can_continue and swag().run_path

    # A training that is repeated in the main thread would take an hour.
    started = time.monotonic()
    run_operator("screen.repeat_last")
    report["repeated"] = {"seconds": time.monotonic() - started, "job": status().job, "runs": runs()}
    repeatable = [op.bl_idname for op in bpy.context.window_manager.operators if "REGISTER" in op.bl_options]
    report["repeatable"] = [name.partition("_OT_")[2] for name in repeatable]

    (OUT / "file").touch()
    swag().run_folder = str(OUT / "file" / "run")
    yield from job("swag.train")
    report["not writable"] = status().message
    swag().run_folder = str(OUT / "terminated")
    run_operator("swag.train", "INVOKE_DEFAULT")
    yield 0.5
    process = sys.modules["bl_ext.user_default.swag_splatting.swag_blender.engine_process"]
    os.kill(next(iter(process._running))._process.pid, signal.SIGTERM)
    yield from until(lambda: not status().job)
    report["terminated"] = status().message
    os.environ["SWAG_ENGINE_PYTHON"] = "/usr/bin/python3"
    yield from job("swag.train")
    report["missing"] = status().message


start(steps())
