"""The color chart in the photos of a run: its operator and its panel."""

import json
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import color_chart, scene_import, splats
from bl_ext.user_default.swag_splatting.swag_blender.cameras import camera_of
from mathutils import Vector
from panels import RecordingPanel, context_of_a_sidebar
from pictures import random_splats

scene, status = bpy.context.scene, bpy.context.window_manager.swag


def drawn():
    """What the panel shows."""
    texts: list[str] = []
    context = context_of_a_sidebar()
    assert color_chart.SWAG_PT_color_chart.poll(context)
    color_chart.SWAG_PT_color_chart.draw(type("Panel", (), {"layout": RecordingPanel(texts)})(), context)
    return texts


def failure():
    """The message with which the operator refuses."""
    try:
        bpy.ops.swag.find_color_chart()
    except RuntimeError as error:
        return str(error)
    raise AssertionError("no error was raised")


def find(run, bare):
    """Messages and panels before and after a chart is found, and with a damaged file."""
    obj = splats.new_splat_object("reef", random_splats(5, 1), scene.collection)
    splats.select_only(bpy.context, [obj])
    found = {"no run": failure(), "shown without run": color_chart.SWAG_PT_color_chart.poll(context_of_a_sidebar())}
    obj["swag_run"] = bare
    found["no chart"] = failure()
    obj["swag_run"] = run
    found["before"] = drawn()
    assert bpy.ops.swag.find_color_chart() == {"FINISHED"}
    found["message"], found["after"] = status.message, drawn()
    file = Path(run, "chart.json")
    damaged = []
    for text in ("{", "[]", '{"delta_e": 3, "photos": {}}', json.dumps({"delta_e": {"photos": None}, "beta_D": []})):
        file.write_text(text)
        damaged.append(drawn())
    found["damaged"] = damaged
    pinhole = {"width": 400, "height": 300, "fx": 200, "fy": 200, "cx": 200, "cy": 150}
    pose = np.eye(4)
    pose[:3, :3] = [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]
    camera = scene_import.camera_object(
        {"name": "a photo.jpg", "world_to_camera": pose, **pinhole}, None, scene.collection
    )
    bpy.context.view_layer.update()
    seen = camera_of(camera, bpy.context.evaluated_depsgraph_get(), 400, 300, 1.0)
    rays = [Vector(pose[:3, :3].T @ np.array(ray)) for ray in ((0, 0, 1), (-0.5, -0.375, 1), (0, 0, -1))]
    found["places"] = [color_chart.position_in_photo(seen, ray) for ray in rays]
    found["request"] = color_chart.request(obj, color_chart.marked_corners(camera, [(0.25, 0.5)] * 4))
    return found
