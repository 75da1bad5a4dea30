"""Runs inside the real Blender, with a window: splats are selected with the pointer, deleted, and brought back by undo.

Environment: that of window.py, SWAG_ZIP the extension; in SWAG_OUT the file splats.ply.
"""

import os
import subprocess
import sys

import bpy
import numpy as np

sys.path.insert(0, os.environ["SWAG_OUT"])
from window import OUT, install, photograph, press, report, start, until, view3d

MODULE = "bl_ext.user_default.swag_splatting.swag_blender"


def module(name):
    return sys.modules[f"{MODULE}.{name}"]


def window_number():
    found = subprocess.run(["xdotool", "search", "--onlyvisible", "--class", "blender"], capture_output=True)
    return found.stdout.split()[-1]


def drag(region, points, key=None):
    """Drag from the first of the region's pixels over the others, with a key held, as steps."""
    height = bpy.context.window_manager.windows[0].height
    places = [(region.x + x, height - region.y - y) for x, y in points]

    def move(place):
        subprocess.run(["xdotool", "mousemove", "--window", window_number(), *map(str, place)], check=True)

    move(places[0])
    yield 0.5
    for command in [["keydown", key]] * bool(key) + [["mousedown", "1"]]:
        subprocess.run(["xdotool", *command], check=True)
        yield 0.3
    for place in places[1:]:
        move(place)
        yield 0.3
    for command in [["mouseup", "1"]] + [["keyup", key]] * bool(key):
        subprocess.run(["xdotool", *command], check=True)
        yield 0.3


def steps():
    install()
    yield 1.0
    window, area, _ = view3d()
    region = next(region for region in area.regions if region.type == "WINDOW")
    space = area.spaces.active
    space.overlay.show_overlays = space.show_gizmo = space.show_region_header = space.show_region_toolbar = False
    space.shading.background_type, space.shading.background_color = "VIEWPORT", (0.05, 0.1, 0.2)
    override = {"window": window, "area": area, "region": region}
    with bpy.context.temp_override(**override):
        bpy.ops.swag.import_splats("EXEC_DEFAULT", True, filepath=str(OUT / "splats.ply"))
    obj = bpy.context.object
    name = obj.name
    space.region_3d.view_location, space.region_3d.view_distance = (0, 0, 0), 12.0
    area.tag_redraw()
    yield 2.0

    def selected():
        mask = module("labels").attribute(bpy.data.objects[name], "swag:selected")
        return [] if mask is None else np.flatnonzero(mask).tolist()

    def use(operator, *arguments):
        with bpy.context.temp_override(**override):
            getattr(bpy.ops.swag, operator)("INVOKE_DEFAULT", True, *arguments)

    matrix = np.array(space.region_3d.perspective_matrix) @ np.array(obj.matrix_world)
    positions = np.c_[module("splats").positions(obj), np.ones(len(obj.data.points))] @ matrix.T
    pixels = (positions[:, :2] / positions[:, 3:] + 1) / 2 * (region.width, region.height)
    report["pixels"] = pixels.tolist()
    x, y = region.width // 2, region.height // 2
    report["box"] = [x - 120, y - 80, x + 60, y + 90]

    use("select_box")
    yield 0.3
    yield from drag(region, [(x - 120, y - 80), (x, y), (x + 60, y + 90)])
    yield from until(selected, 10)
    report["boxed"] = selected()
    use("select_box")
    yield 0.3
    yield from drag(region, [(x - 60, y - 40), (x, y), (x + 20, y + 30)], "ctrl")
    yield 1.0
    report["without inner box"] = selected()
    use("select_brush")
    yield 0.3
    press("Escape")
    yield 0.5
    report["after escape"] = len(selected())
    report["tools in use"] = len(module("viewport_tool")._handlers)

    # The tools of the toolbar, each with one press of the pointer.
    def choose(tool):
        with bpy.context.temp_override(**override):
            bpy.ops.wm.tool_set_by_id(name=f"swag.tool_{tool}")

    report["tools"] = {}
    near = pixels[np.linalg.norm(pixels - (x, y), axis=1).argmin()]
    for tool, points, key in (
        ("box", [(x - 120, y - 80), (x, y), (x + 60, y + 90)], None),
        ("box", [(x - 60, y - 40), (x, y), (x + 20, y + 30)], "ctrl"),
        ("circle", [(x, y), (x + 50, y), (x + 100, y)], None),
        ("brush", [(x - 80, y), (x, y), (x + 80, y)], None),
        ("sphere", [near, near + (40, 0), near + (90, 0)], None),
        ("flood", [near, near], None),
    ):
        choose(tool)
        yield 0.5
        before = selected()
        yield from drag(region, [(int(px), int(py)) for px, py in points], key)
        yield 1.0
        report["tools"][f"{tool} {key or ''}".strip()] = selected()
        if tool == "sphere":
            with bpy.context.temp_override(**override):
                bpy.ops.ed.undo()
            yield 0.5
            report["undone"] = selected() == before
    report["handlers"] = len(module("viewport_tool")._handlers)
    space.show_region_toolbar = True
    choose("box")
    yield from drag(region, [(x - 120, y - 80), (x, y), (x + 60, y + 90)])
    yield 0.5
    yield from drag(region, [(x - 60, y - 40), (x, y), (x + 20, y + 30)], "ctrl")
    yield 1.0
    photograph("tools.png")
    space.show_region_toolbar = False

    use("delete_splats")
    yield 1.5
    report["left"] = len(bpy.data.objects[name].data.points)
    photograph("deleted.bmp", window_number())
    to_view = np.array(space.region_3d.view_matrix) @ np.array(bpy.data.objects[name].matrix_world)
    report["pictures"] = {
        "deleted": {"projection": np.array(space.region_3d.window_matrix).tolist(), "view": to_view.tolist()}
    }
    report["region"] = [region.x, region.y, region.width, region.height]
    with bpy.context.temp_override(**override):
        bpy.ops.ed.undo()
    yield 1.0
    report["after undo"] = len(bpy.data.objects[name].data.points)


start(steps())
