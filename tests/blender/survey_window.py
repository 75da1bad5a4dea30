"""Runs inside the real Blender, with a window: a survey is watched while its files change, opened, and refined.

Environment: that of window.py, SWAG_ZIP the extension, SWAG_SURVEY the folder of a survey, SWAG_FINISH a folder with
files that are copied into it while it is watched.
"""

import os
import shutil
import sys

import bpy
from mathutils import Vector

sys.path.insert(0, os.environ["SWAG_OUT"])
from window import install, open_panels, open_sidebar, report, start, until, view3d

SURVEY, FINISH = os.environ["SWAG_SURVEY"], os.environ["SWAG_FINISH"]


def steps():
    install()
    open_panels("SWAG_PT_survey")
    yield 0.5
    window, area, region = view3d()
    space, scene = area.spaces.active, bpy.context.scene
    space.overlay.show_text = False
    yield from open_sidebar()
    package = "bl_ext.user_default.swag_splatting.swag_blender"
    watch, splats = sys.modules[f"{package}.survey_watch"], sys.modules[f"{package}.splats"]
    jobs = lambda: {job.name: job.state for job in bpy.context.window_manager.swag_survey.jobs}  # noqa: E731

    scene.swag_survey.folder = SURVEY
    region.tag_redraw()
    yield from until(jobs)  # the panel was drawn and reads
    report["at first"] = jobs()
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.show_blocks()
    space.overlay.show_floor = False
    space.region_3d.view_rotation = Vector((0, -0.3, 1)).to_track_quat("Z", "Y")
    space.region_3d.view_location, space.region_3d.view_distance = (0, 0, 0), 12
    shutil.copytree(FINISH, SURVEY, dirs_exist_ok=True)
    yield from until(lambda: jobs().get("B-001") == "done")
    report["followed"] = jobs()
    made = next(obj for obj in scene.objects if "swag_survey_blocks" in obj and obj.type == "MESH")
    report["faces"] = [face.material_index for face in made.data.polygons]
    yield 1.0

    scene.swag_survey.budget = 1000
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.swag.open_survey("INVOKE_DEFAULT", True, directory=SURVEY)
    obj = bpy.context.view_layer.objects.active
    report["opened"] = splats.count(obj)
    report["map is hidden"] = made.hide_viewport
    corner = obj.matrix_world @ Vector((1.0, -0.1, 1.0))
    yield 1.0
    space.region_3d.view_location, space.region_3d.view_distance = corner, 4.0
    area.tag_redraw()
    yield 2.0
    with bpy.context.temp_override(window=window, area=area, region=region):
        report["load view"] = list(bpy.ops.swag.load_view("INVOKE_DEFAULT", True))
    report["near"] = [splats.count(obj), obj["swag_survey_levels"]]
    yield 1.0
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.ed.undo()
    yield 1.0
    obj = bpy.context.view_layer.objects.active
    report["undone"] = [splats.count(obj), obj["swag_survey_levels"]]
    bpy.context.scene.swag.water = 1.0  # undo has made another scene
    area.tag_redraw()
    yield 1.0
    bpy.ops.wm.read_homefile(use_empty=True)
    yield from until(lambda: not bpy.app.timers.is_registered(watch._tick), 30)
    report["timer after another file"] = bpy.app.timers.is_registered(watch._tick)


start(steps())
