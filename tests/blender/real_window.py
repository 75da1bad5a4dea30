"""Runs inside the real Blender, with a window: import, train, pause and cancel in the sidebar with the pointer.

Environment: that of window.py, SWAG_ZIP the extension, SWAG_SCENE the COLMAP scene, SWAG_ENGINE_PYTHON the engine's
Python.
"""

import os
import sys
import time

import bpy

sys.path.insert(0, os.environ["SWAG_OUT"])
from window import click, install, open_sidebar, photograph, press_until, report, start, until, view3d

# Commands of the buttons, and their columns in the sidebar.
TRAIN, CONTINUE = ("bpy.ops.swag.train(resume=False)", 0.25), ("bpy.ops.swag.train(resume=True)", 0.62)
PAUSE, CANCEL = ("bpy.ops.swag.pause()", 0.25), ('bpy.ops.swag.cancel(job="Training")', 0.62)


def timed(function, seconds):
    """Wrap `function`: each call appends its duration to `seconds`."""

    def call(*arguments):
        started = time.perf_counter()
        try:
            return function(*arguments)
        finally:
            seconds.append(time.perf_counter() - started)

    return call


def steps():
    install()
    window, area, region = view3d()
    # Blender writes there whether it still compiles shaders, which changes between two pictures.
    area.spaces.active.overlay.show_text = False
    # The pointer's way over the sidebar then redraws no viewport, which takes long without a graphics card.
    bpy.context.preferences.system.use_region_overlap = False
    yield from open_sidebar()

    status, swag = bpy.context.window_manager.swag, bpy.context.scene.swag
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.import_scene("INVOKE_DEFAULT", directory=os.environ["SWAG_SCENE"])
        yield from until(lambda: not status.job)
        report["imported"] = {"failed": status.failed, "message": status.message, "found": swag.found}
        region.tag_redraw()

    # A job goes on when the window that it was started in is closed, as the Preferences are.
    bpy.ops.wm.window_new()
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[-1]):
        bpy.ops.swag.inspect_scene("INVOKE_DEFAULT")
        bpy.ops.wm.window_close()
    yield from until(lambda: not status.job)
    windows = len(bpy.context.window_manager.windows)
    report["checked"] = {"failed": status.failed, "message": status.message, "windows": windows}

    swag.iterations, swag.width = 50, 64
    viewport = next(region for region in area.regions if region.type == "WINDOW")
    report["viewport"] = [viewport.x, viewport.y, viewport.width, viewport.height]
    clouds = lambda: [o for o in bpy.data.objects if "swag_run" in o]  # noqa: E731
    drawn = sys.modules["bl_ext.user_default.swag_splatting.swag_blender.viewport"].drawing

    def draw_all():
        """Wait until the viewport has drawn all that it has to draw, as steps."""
        yield from until(drawn)
        frames = -1
        while drawn().is_waiting() or drawn().frames != frames:
            frames = drawn().frames
            yield 2.0

    def uploaded():
        """What is on the graphics card: its version, and how often it was numbered and drawn."""
        return {"version": drawn().store.version, "numbering": drawn().store.splats_version, "frames": drawn().frames}

    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.train("INVOKE_DEFAULT")
    yield from until(lambda: not status.job)
    yield from draw_all()
    report["uploaded at the end of training"] = uploaded()
    photograph("trained.bmp")
    drawn().store.mark_stale(None)
    area.tag_redraw()
    yield from draw_all()
    report["uploaded anew"] = uploaded()
    photograph("trained, drawn anew.bmp")
    bpy.data.objects.remove(clouds()[0])
    swag.iterations = 100_000

    yield from click(*TRAIN)
    yield from until(lambda: status.job == "Training")
    training = lambda: status.find("Training")  # noqa: E731
    yield from until(lambda: training().iteration > 0 and training().factor > 0)
    yield from until(clouds)
    # Time that the extension's timer blocks the window during training; drawing without a graphics card is not in it.
    job = sys.modules["bl_ext.user_default.swag_splatting.swag_blender.job"]
    report["blocked_seconds"] = []
    job.RunningJob._handle_events = timed(job.RunningJob._handle_events, report["blocked_seconds"])
    yield from until(lambda: len(report["blocked_seconds"]) > 30)
    report["training"] = {
        "iteration": training().iteration,
        "gaussians": training().gaussians,
        "figures": training().figures(),
    }
    report["preview"] = len(clouds()[0].data.points)

    yield from click(*PAUSE)
    yield from until(lambda: training().paused)
    paused_at = -1
    while paused_at != training().iteration:  # events under way arrive
        paused_at = training().iteration
        yield 1.5
    yield 1.5
    report["iterations_while_paused"] = training().iteration - paused_at
    yield from click(*PAUSE)
    yield from until(lambda: not training().paused and training().iteration > paused_at)

    yield from click(*CANCEL)
    yield 0.5
    report["asked first"] = not training().stopping
    yield from press_until("Return", lambda: not status.job or training().stopping)
    yield from until(lambda: not status.job)
    report["end"] = {
        "failed": status.failed, "message": status.message, "interrupted": swag.result_interrupted,
        "points": len(clouds()[0].data.points), "gaussians": swag.result_gaussians, "continue": swag.can_continue,
    }  # fmt: skip

    yield from click(*CONTINUE)
    yield from until(lambda: status.job == "Training" and training().iteration > report["training"]["iteration"])
    bpy.ops.wm.read_homefile(use_empty=True)
    yield 0.2
    status = bpy.context.window_manager.swag
    engines = sys.modules["bl_ext.user_default.swag_splatting.swag_blender.engine_process"]._running
    report["after_opening"] = {"job": status.job, "engines": len(engines), "message": status.message}


start(steps())
