"""How long a frame of Blender's window takes while splats arrive as they do in training, and its user orbits.

    SCRIPT=benchmarks/live_preview.py tests/blender/tour.sh ROOT EXTENSION.zip SCENE OUT

Runs inside the real Blender. Three times ten seconds: an empty viewport, one with SPLATS splats that stand still, and
one into which as many come anew every second, read beside the window as the Train operator reads them. Each frame the
view turns a little. Without a graphics card most of a frame is drawing; what the add-on itself takes of an update
(attributes, then nodes) is told apart. Writes report.json: milliseconds.
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

SPLATS, SECONDS = 200_000, 10.0
drawn: list[float] = []


def made():
    from bl_ext.user_default.swag_splatting.swag_engine.gaussians.splats import Splats

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
    """Steps in which the view turns for SECONDS; drawn holds when it was drawn."""
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
    times = 1000 * np.diff(drawn)
    report[name] = {"frames": len(times)} | {
        key: round(float(np.quantile(times, share)), 1) for key, share in (("median", 0.5), ("95 %", 0.95))
    }


def steps():
    install()
    yield 1.0
    from bl_ext.user_default.swag_splatting.operators import train
    from bl_ext.user_default.swag_splatting.swag_blender import scene_import
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
    train.show_splats(scene, read_ply(path), "run", "scene")
    yield 3.0
    yield from frames(lambda: None)
    summary("still")
    photograph("live")
    own, reading = [], []

    def arrive():
        if reading:
            times = [time.perf_counter()]
            for work in (lambda: train.show_splats(scene, reading.pop().result(), "run", "scene"), update_nodes):
                work()
                times.append(time.perf_counter())
            own.append(np.diff(times))
        reading.append(train._reader.submit(read_ply, path))

    update_nodes = bpy.context.view_layer.update
    yield from frames(arrive)
    summary("arriving")
    report["attributes"], report["nodes"] = (
        round(1000 * float(np.median(times)), 1) for times in zip(*own, strict=True)
    )
    report["done"] = True


start(steps())
