"""Measure the frame times of Blender's window while splats arrive as in training and the view orbits.

Run: `SCRIPT=benchmarks/live_preview.py tests/blender/tour.sh ROOT EXTENSION.zip SCENE OUT` (a real Blender)
Results: OUT/report.json in milliseconds; copied by hand to benchmarks/results/live_preview.json

Three times ten seconds: an empty viewport, one with SPLATS splats that do not change, and one that receives as many
new ones every second, read outside the window's thread as the Train operator does. The view turns a little in each
frame. Without a graphics card most of a frame is drawing; the add-on's own part of an update (attributes, then nodes)
is measured separately.
"""

import os
import sys
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Quaternion

sys.path.insert(0, os.environ["SWAG_OUT"])
from window import install, photograph, report, start, view3d

SPLATS = 200_000
"""Splats in the viewport."""
SECONDS = 10.0
"""Seconds of each part."""
drawn: list[float] = []
"""When each frame was drawn, seconds."""


def made():
    """Make random splats of SH degree 0."""
    from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats

    random = np.random.default_rng(0)
    directions = random.normal(size=(SPLATS, 4)).astype(np.float32)
    return Splats(
        positions=random.uniform(-3, 3, (SPLATS, 3)).astype(np.float32),
        rotations=directions / np.linalg.norm(directions, axis=1, keepdims=True),
        scales=random.uniform(0.005, 0.02, (SPLATS, 3)).astype(np.float32),
        opacities=random.uniform(0.3, 1, SPLATS).astype(np.float32),
        sh=random.uniform(-1, 1, (SPLATS, 1, 3)).astype(np.float32),
        extras={},
    )


def frames(each_second):
    """Turn the view for SECONDS and fill `drawn`; call each_second once a second."""
    _, area, _ = view3d()
    region = area.spaces.active.region_3d
    drawn.clear()
    end, update = time.monotonic() + SECONDS, time.monotonic()
    while time.monotonic() < end:
        region.view_rotation = Quaternion((0, 0, 1), 0.02) @ region.view_rotation
        area.tag_redraw()
        if time.monotonic() >= update:
            each_second()
            update += 1.0
        yield 0.0


def summary(name):
    """Write median and 95th percentile of the frame times (ms) to the report."""
    times = 1000 * np.diff(drawn)
    report[name] = {"frames": len(times)} | {
        key: round(float(np.quantile(times, share)), 1) for key, share in (("median", 0.5), ("95 %", 0.95))
    }


def steps():
    """Yield the waits (seconds) between the steps of the measurement."""
    install()
    yield 1.0
    from bl_ext.user_default.swag_splatting.swag_blender import runs, scene_import, training
    from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply, write_ply

    window, _, _ = view3d()
    scene_import.show_colors(window.screen)
    bpy.types.SpaceView3D.draw_handler_add(lambda: drawn.append(time.perf_counter()), (), "WINDOW", "POST_PIXEL")
    yield 2.0
    yield from frames(lambda: None)
    summary("empty")
    path = Path(os.environ["SWAG_OUT"]) / "preview.ply"
    write_ply(path, made())
    scene = bpy.context.scene
    runs.show_splats(scene, read_ply(path), "run", "scene")
    yield 3.0
    yield from frames(lambda: None)
    summary("still")
    photograph("live")
    own, reading = [], []

    def arrive():
        """Show the splats that were read and start reading the next."""
        if reading:
            times = [time.perf_counter()]
            for work in (lambda: runs.show_splats(scene, reading.pop().result(), "run", "scene"), update_nodes):
                work()
                times.append(time.perf_counter())
            own.append(np.diff(times))
        reading.append(training._reader.submit(read_ply, path))

    update_nodes = bpy.context.view_layer.update
    yield from frames(arrive)
    summary("arriving")
    report["attributes"], report["nodes"] = (
        round(1000 * float(np.median(times)), 1) for times in zip(*own, strict=True)
    )
    report["done"] = True


start(steps())
