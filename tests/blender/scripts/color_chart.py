"""The color chart in the photos of a run: its operator and its panel."""

import json
from pathlib import Path

import bpy
from bl_ext.user_default.swag_splatting.swag_blender import color_chart, splats
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
    return found
