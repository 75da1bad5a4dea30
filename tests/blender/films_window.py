"""Runs inside the real Blender, with a window: photos are compared with splats, and a film is cancelled.

Environment: that of window.py, SWAG_ZIP the extension, SWAG_SCENE the COLMAP scene, SWAG_PLY splats of it,
SWAG_ENGINE_PYTHON the engine's Python.
"""

import os
import subprocess
import sys

import bpy

sys.path.insert(0, os.environ["SWAG_OUT"])
from window import install, open_sidebar, photograph, report, start, until, view3d


def press(key):
    subprocess.run(["xdotool", "key", key], check=True)
    yield 1.0


def wipe_of(module):
    """Where the comparison draws: the camera's image on the screen (from the top left) and the line's place."""
    wipe = module._running
    left, bottom, right, top = wipe.frame()
    # The window reaches to the bottom of a screen of 1280 x 800; its title bar does not count as its height.
    height, x, y = 800, wipe.region.x, wipe.region.y
    return {
        "photo": wipe.names[wipe.index],
        "place": wipe.place,
        "frame": [left + x, height - (top + y), right + x, height - (bottom + y)],
    }


def drawn(window, area, wipe, index):
    """Wait until a photo is shown and drawn: the view's matrix is that of the last drawing."""
    yield from until(lambda: wipe._running.index == index)
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=2)
    yield 1.0


def state(space):
    scene = bpy.context.scene
    view = space.region_3d
    return {
        "camera": scene.camera.name,
        "size": [scene.render.resolution_x, scene.render.resolution_y],
        "perspective": view.view_perspective,
        "distance": view.view_distance,
        "backgrounds": [o.data.show_background_images for o in scene.objects if o.type == "CAMERA"],
        "images": len(bpy.data.images),
    }


def steps():
    install()
    yield 0.5
    window, area, _ = view3d()
    status, space = bpy.context.window_manager.swag, area.spaces.active
    package = "bl_ext.user_default.swag_splatting.swag_blender"
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.import_scene("INVOKE_DEFAULT", directory=os.environ["SWAG_SCENE"])
        yield from until(lambda: not status.job)
        bpy.ops.swag.import_splats(filepath=os.environ["SWAG_PLY"])
    space.shading.type = "SOLID"
    yield 1.0
    report["before"] = state(space)
    wipe = sys.modules[f"{package}.photo_wipe"]
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.compare_photos("INVOKE_DEFAULT")
    yield 1.0
    yield from drawn(window, area, wipe, 0)
    report["first"] = wipe_of(wipe)
    photograph("wipe-1.bmp")
    left, top, right, bottom = report["first"]["frame"]
    x, y = round(left + 0.75 * (right - left)), round((top + bottom) / 2)
    for position in (x - 60, x - 30, x):
        subprocess.run(["xdotool", "mousemove", str(position), str(y)], check=True)
        yield 0.2
    subprocess.run(["xdotool", "click", "1"], check=True)
    yield 1.0
    yield from press("Right")
    yield from press("Right")
    yield from drawn(window, area, wipe, 2)
    report["third"] = wipe_of(wipe)
    photograph("wipe-2.bmp")
    yield from press("Escape")
    report["running"] = wipe._running is not None
    report["after"] = state(space)
    yield from open_sidebar()
    report["warning"] = sys.modules[f"{package}.render_setup"].eevee_warning(bpy.context.scene, 32)
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.prepare_render("INVOKE_DEFAULT", engine="EEVEE")
    yield 0.5
    yield from press("Escape")
    scene = bpy.context.scene
    scene.frame_end, scene.swag_film.output = 2000, os.environ["SWAG_OUT"] + "/film"
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.render_film("INVOKE_DEFAULT")
        yield from until(lambda: not status.job or status.find("Film").factor > 0)
        bpy.ops.swag.cancel()
    yield from until(lambda: not status.job)
    report["film"] = {"message": status.message, "failed": status.failed, "frame": scene.frame_current}
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.compare_photos("INVOKE_DEFAULT")
    yield 1.0
    bpy.ops.preferences.addon_disable(module="bl_ext.user_default.swag_splatting")
    report["running after disable"] = wipe._running is not None
    yield 1.0
    report["at the end"] = state(space)


start(steps())
