"""The sidebar: its plan, what it keeps in the .blend, the offer to go on, and that everything can be found by F3."""

import sys

import pytest

from swag_engine.settings.settings import TrainSettings

SETUP = """
import json, sys, pathlib, bpy
from bl_ext.user_default.swag_splatting import operators
from bl_ext.user_default.swag_splatting.swag_blender import job, panels, properties
swag, status = bpy.context.scene.swag, bpy.context.window_manager.swag
"""


def test_plan_is_a_list_that_the_user_overrules(blender, fake_engine, tmp_path):
    printed = blender.run(
        SETUP
        + """
swag.scene_folder = sys.argv[-1]
bpy.ops.swag.plan()
print("SAID", json.dumps(status.message))
print("LINES", json.dumps([[l.name, l.title, l.state, l.reason, round(l.cost_ms, 2)] for l in swag.plan.lines]))
swag.effects = "water=on"
swag.plan.lines["lamp"].choice, swag.plan.lines["attenuation"].choice = "ON", "OFF"
print("SETTINGS", json.dumps(swag.train_settings()["effects"]))
bpy.ops.swag.plan()
print("KEPT", json.dumps(swag.plan.switches()))
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1] + "/a.blend")
bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.wm.open_mainfile(filepath=sys.argv[-1] + "/a.blend")
swag = bpy.context.scene.swag
print("SAVED", json.dumps([swag.plan.switches(), swag.plan.lines["lamp"].reason, swag.plan.stale]))
swag.scene_folder = "/elsewhere"
print("STALE", json.dumps(swag.plan.stale))
bpy.ops.swag.reset_effects()
print("RESET", json.dumps([swag.plan.switches(), bpy.ops.swag.reset_effects.poll()]))
""",
        tmp_path,
        SWAG_ENGINE_PYTHON=fake_engine,
    )
    assert blender.json_after("SAID", printed) == "Effects to model: attenuation."
    assert blender.json_after("LINES", printed) == [
        ["attenuation", "Attenuation", "on", "Red loses 75% over the scene.", 1.25],
        ["lamp", "Lamp", "off", "Light falls off by 0%.", 0.5],
        ["moving_objects", "Moving objects", "unknown", "Only training shows it.", 0.0],
    ]
    assert blender.json_after("SETTINGS", printed) == "water=on,attenuation=off,lamp=on"
    assert blender.json_after("KEPT", printed) == "attenuation=off,lamp=on"
    assert blender.json_after("SAVED", printed) == ["attenuation=off,lamp=on", "Light falls off by 0%.", False]
    assert blender.json_after("STALE", printed) is True
    assert blender.json_after("RESET", printed) == ["", False]


def test_an_unfinished_run_is_offered_when_the_file_is_opened_again(blender, fake_engine, tmp_path):
    (tmp_path / "endless").mkdir()
    printed = blender.run(
        SETUP
        + """
swag.scene_folder = sys.argv[-1]
run = pathlib.Path(sys.argv[-1]) / "swag_run"
run.mkdir()
(run / "config.json").write_text("{}")
print("FRESH", json.dumps(swag.stopped_at))
for iteration in (900, 1200):
    (run / f"checkpoint-{iteration:07d}.safetensors").touch()
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1] + "/a.blend")
bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.wm.open_mainfile(filepath=sys.argv[-1] + "/a.blend")
swag = bpy.context.scene.swag
print("OFFER", json.dumps([swag.can_continue, swag.stopped_at]))
""",
        tmp_path / "endless",
        SWAG_ENGINE_PYTHON=fake_engine,
    )
    assert blender.json_after("FRESH", printed) == "The run swag_run stopped before its first checkpoint."
    assert blender.json_after("OFFER", printed) == [True, "The run swag_run stopped at iteration 1200."]


def test_every_operator_has_a_tooltip_and_a_place_where_f3_finds_it(blender):
    printed = blender.run(
        SETUP
        + """
classes = [cls for module in operators._MODULES for cls in module.CLASSES if issubclass(cls, bpy.types.Operator)]
print("NAMES", json.dumps(sorted(cls.bl_idname.partition(".")[2] for cls in classes)))
class Layout:
    drawn = []
    separator = lambda self: None
layout = Layout()
layout.operator = Layout.drawn.append
operators.SWAG_MT_splatting.draw(type("Menu", (), {"layout": layout}), bpy.context)
print("MENU", json.dumps(sorted(name.partition(".")[2] for name in layout.drawn)))
print("APPENDED", json.dumps(operators._menu in bpy.types.VIEW3D_MT_object.draw._draw_funcs))
print("DUMB", json.dumps([cls.__name__ for cls in classes if len(cls.__doc__ or "") < 10]))
undone = [cls.bl_idname for cls in classes if "UNDO" in getattr(cls, "bl_options", ())]
print("UNDO", json.dumps(undone))
bare = [(cls.__name__, name) for cls in (*classes, properties.SwagScene, properties.effects.SwagEffect)
        for name in getattr(cls, "__annotations__", {}) if name != "name" and name in cls.bl_rna.properties
        and not cls.bl_rna.properties[name].description and not cls.bl_rna.properties[name].is_hidden
        and cls.bl_rna.properties[name].type != "POINTER" and not name.startswith("result_")]
print("BARE", json.dumps(bare))
"""
    )
    names, menu = blender.json_after("NAMES", printed), blender.json_after("MENU", printed)
    # These act on one line of the list of labels, and stand beside it.
    assert set(names) - set(menu) == {"isolate_label", "select_label", "keep_mask"}
    assert blender.json_after("APPENDED", printed) is True
    assert blender.json_after("DUMB", printed) == []
    assert {"swag.train", "swag.plan", "swag.import_scene", "swag.separate_splats"} <= set(
        blender.json_after("UNDO", printed)
    )
    assert blender.json_after("BARE", printed) == []


def test_curve_and_figures_of_a_training(blender):
    printed = blender.run(
        SETUP
        + """
status.begin("Training")
for iteration, psnr in ((1, None), (2, 10.0), (3, 10.0), (4, 12.5), (5, 20.0)):
    status.show({"event": "progress", "stage": "train", "iteration": iteration, "iterations": 5, "gaussians": 7,
                 "loss": 0.5, "psnr": psnr, "iterations_per_second": 2.0, "seconds_left": 65.0})
print("CURVE", json.dumps([status.curve, properties.sparkline([float(v) for v in status.curve.split()])]))
print("FLAT", json.dumps(properties.sparkline([3.0, 3.0])))
print("FIGURES", json.dumps(status.figures()))
"""
    )
    assert blender.json_after("CURVE", printed) == [" 10.00 12.50 20.00", "▁▃█"]
    assert blender.json_after("FLAT", printed) == "▁▁"
    assert blender.json_after("FIGURES", printed)[-1] == "1:05 left"


def test_a_forecast_is_shown_until_its_question_changes(blender, fake_engine, tmp_path):
    printed = blender.run(
        SETUP
        + """
swag.scene_folder = sys.argv[-1]
print("UNASKED", json.dumps(swag.forecast_lines()))
bpy.ops.swag.forecast()
print("SAID", json.dumps([status.message, status.failed]))
swag.preset, swag.time_budget = "high", "10m"  # a forecast is of every quality
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1] + "/a.blend")
bpy.ops.wm.open_mainfile(filepath=sys.argv[-1] + "/a.blend")
swag = bpy.context.scene.swag
print("SAVED", json.dumps(swag.forecast_lines()))
for name, value in (("iterations", 100), ("recipe", "3dgs"), ("scene_folder", "/elsewhere")):
    kept = getattr(swag, name)
    setattr(swag, name, value)
    assert not swag.forecast_lines(), name
    setattr(swag, name, kept)
    assert swag.forecast_lines(), name
""",
        tmp_path,
        SWAG_ENGINE_PYTHON=fake_engine,
    )
    lines = [["draft", "0:20-0:45", "24.0-26.0 dB", "0.6 GB"], ["high", "8:20-1:06:40", "PSNR unknown", "0.6 GB"]]
    assert blender.json_after("UNASKED", printed) == []
    assert blender.json_after("SAID", printed) == ["; ".join(" ".join(line) for line in lines), False]
    assert blender.json_after("SAVED", printed) == lines


@pytest.mark.parametrize("paused", [True, False])
def test_pause_is_a_switch_of_a_running_training(blender, paused):
    printed = blender.run(
        SETUP
        + f"""
print("IDLE", json.dumps(bpy.ops.swag.pause.poll()))
status.begin("Training")
status.paused = {not paused}
bpy.ops.swag.pause()
print("PAUSED", json.dumps(status.paused))
status.end("", False)
"""
    )
    assert blender.json_after("IDLE", printed) is False
    assert blender.json_after("PAUSED", printed) is paused


def test_nothing_runs_while_nothing_is_asked(blender, fake_engine, tmp_path):
    """After a job no thread, no timer and no child is left."""
    printed = blender.run(
        SETUP
        + """
import threading, time
swag.scene_folder = sys.argv[-1]
bpy.ops.swag.train()
time.sleep(0.2)
print("THREADS", json.dumps([t.name for t in threading.enumerate() if t is not threading.main_thread()]))
before = time.process_time()
time.sleep(1.0)
print("CPU", json.dumps(time.process_time() - before))
""",
        tmp_path,
        SWAG_ENGINE_PYTHON=fake_engine,
    )
    assert blender.json_after("THREADS", printed) == []
    assert blender.json_after("CPU", printed) < 0.05


def test_the_engine_plans_and_takes_every_choice_of_the_list(blender, tiny_scene):
    printed = blender.run(
        SETUP
        + """
swag.scene_folder = sys.argv[-1]
bpy.ops.swag.plan()
print("LINES", json.dumps([len(swag.plan.lines), all(line.reason for line in swag.plan.lines)]))
for choice in ("ON", "OFF"):
    for line in swag.plan.lines:
        line.choice = choice
    print(choice, json.dumps(swag.train_settings()))
""",
        tiny_scene,
        SWAG_ENGINE_PYTHON=sys.executable,
    )
    count, reasoned = blender.json_after("LINES", printed)
    assert count >= 10 and reasoned
    for choice in ("ON", "OFF"):
        settings = TrainSettings.from_json(blender.json_after(choice, printed))
        assert settings.effects.count(f"={choice.lower()}") == count
