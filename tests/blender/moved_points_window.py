"""Runs inside the real Blender, with a window: points of splats are turned with keys in edit mode, and undone.

Environment: that of window.py, SWAG_ZIP the extension; in SWAG_OUT the file splats.ply.
"""

import os
import subprocess
import sys

import bpy
import numpy as np

sys.path.insert(0, os.environ["SWAG_OUT"])
from window import OUT, install, press, report, start, until, view3d


def steps():
    install()
    yield 1.0
    window, area, _ = view3d()
    region = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.swag.import_splats("EXEC_DEFAULT", True, filepath=str(OUT / "splats.ply"))
    name = bpy.context.object.name
    splats = sys.modules["bl_ext.user_default.swag_splatting.swag_blender.splats"]

    def stored():
        made = splats._splats_as_stored(splats.pointcloud_of(bpy.data.objects[name]))
        return np.concatenate([made.positions, made.rotations, made.scales, made.sh.reshape(len(made), -1)], axis=1)

    def changes(before, columns=slice(None)):
        return not np.array_equal(stored()[:, columns], before[:, columns])

    shapes = slice(3, None)
    start_values = stored()
    place = (region.x + region.width // 2, window.height - region.y - region.height // 2)
    subprocess.run(["xdotool", "mousemove", *map(str, place)], check=True)
    yield 1.0
    press("Tab")
    yield from until(lambda: bpy.data.objects[name].mode == "EDIT")
    press("a")
    yield 1.0
    press("r")
    yield 1.0
    press("x", "4", "0")
    yield from until(lambda: changes(start_values))
    yield 1.0
    report["shapes change while points are moved"] = changes(start_values, shapes)
    press("Return")
    yield from until(lambda: changes(start_values, shapes))
    turned = stored()
    matrix = np.linalg.lstsq(np.c_[start_values[:, :3], np.ones(len(turned))], turned[:, :3], rcond=None)[0]
    transformed = sys.modules["bl_ext.user_default.swag_splatting.swag_engine.splats.transform"].transformed
    made = splats.Splats(
        start_values[:, :3], start_values[:, 3:7], start_values[:, 7:10], np.ones(len(turned), "f4"),
        start_values[:, 10:].reshape(len(turned), -1, 3),
    )  # fmt: skip
    wanted = transformed(made, np.vstack([matrix.T, [0, 0, 0, 1]]))
    errors = abs(turned[:, 7:10] - wanted.scales), abs(turned[:, 3:7] - wanted.rotations)
    report["error"] = float(np.max(np.concatenate(errors, axis=1)))
    for turn, values in (("undo", start_values), ("redo", turned)) * 2:
        press("ctrl+z" if turn == "undo" else "ctrl+shift+z")
        yield 2.0
        report.setdefault("after", []).append([turn, not changes(values)])
    press("Tab")
    yield 1.0


start(steps())
