"""Runs inside the real Blender, with a window: choose photos in the file browser, cancel, find their cameras.

Environment: that of window.py, SWAG_ZIP the extension, SWAG_PHOTOS the folder of photos, which has a folder of its own,
SWAG_ENGINE_PYTHON the engine's Python.
"""

import os
import sys
from pathlib import Path

import bpy

sys.path.insert(0, os.environ["SWAG_OUT"])
from window import install, open_sidebar, report, start, until, view3d

PHOTOS = Path(os.environ["SWAG_PHOTOS"])


def file_browser():
    """Window and area of the open file browser; None where there is none."""
    found = ((w, a) for w in bpy.context.window_manager.windows for a in w.screen.areas if a.type == "FILE_BROWSER")
    return next(found, None)


def steps():
    install()
    window, area, _ = view3d()
    space = area.spaces.active
    yield from open_sidebar()
    status, swag = bpy.context.window_manager.swag, bpy.context.scene.swag

    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.open_photos("INVOKE_DEFAULT")
    yield from until(lambda: file_browser() and file_browser()[1].spaces.active.params)
    browser, files = file_browser()
    files.spaces.active.params.directory = os.fsencode(f"{PHOTOS}/")
    yield 0.5
    with bpy.context.temp_override(window=browser, area=files):
        bpy.ops.file.execute()
    yield from until(lambda: status.job == "Find Cameras" and status.find("Find Cameras").text == "Matching photos")
    bpy.ops.swag.cancel()
    yield from until(lambda: not status.job)
    report["cancelled"] = {
        "message": status.message, "failed": status.failed, "objects": len(bpy.data.objects),
        "left": sorted(path.name for path in PHOTOS.parent.iterdir()), "shading": space.shading.type,
    }  # fmt: skip

    for photo in sorted(PHOTOS.iterdir())[6:]:
        photo.unlink()
    space.region_3d.view_location = (500, 0, 0)
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.find_cameras("INVOKE_DEFAULT", filepath=str(PHOTOS))
    yield from until(lambda: not status.job)
    yield 1.0
    points = next(obj for obj in bpy.data.objects if obj.type == "POINTCLOUD")
    view = space.region_3d
    seen = [view.perspective_matrix @ obj.matrix_world.translation.to_4d() for obj in bpy.data.objects]
    report["found"] = {
        "message": status.message, "failed": status.failed, "lines": swag.found.splitlines(),
        "folder": swag.scene_folder, "cameras": sum(obj.type == "CAMERA" for obj in bpy.data.objects),
        "points": len(points.data.points), "shading": space.shading.type,
        "in view": [abs(p.x) <= p.w and abs(p.y) <= p.w and p.w > 0 for p in seen],
        "size of the scene in the view": max(abs(v / p.w) for p in seen for v in (p.x, p.y)),
    }  # fmt: skip


start(steps())
