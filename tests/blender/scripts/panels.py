"""The sidebar's data: plan, forecast, settings in the .blend, progress; and the menu of all operators."""

import threading
import time
from pathlib import Path
from typing import Any

import bpy
from bl_ext.user_default.swag_splatting import operators
from bl_ext.user_default.swag_splatting.swag_blender import properties
from bl_ext.user_default.swag_splatting.swag_engine.base.text import sparkline

swag, status = bpy.context.scene.swag, bpy.context.window_manager.swag


def save_and_open(folder):
    """The scene's settings after saving, an empty file and opening."""
    bpy.ops.wm.save_as_mainfile(filepath=folder + "/a.blend")
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=folder + "/a.blend")
    return bpy.context.scene.swag


def plan_and_overrule(folder):
    swag.scene_folder = folder
    bpy.ops.swag.plan()
    found = {"message": status.message}
    found["lines"] = [[e.name, e.title, e.state, e.reason, round(e.cost_ms, 2)] for e in swag.plan.lines]
    swag.effects = "water=on"
    swag.plan.lines["lamp"].choice, swag.plan.lines["attenuation"].choice = "ON", "OFF"
    found["settings"] = swag.train_settings()["effects"]
    bpy.ops.swag.plan()
    found["after another plan"] = swag.plan.switches()
    opened = save_and_open(folder)
    found["opened"] = [opened.plan.switches(), opened.plan.lines["lamp"].reason, opened.plan.stale]
    opened.scene_folder = "/elsewhere"
    found["stale"] = opened.plan.stale
    bpy.ops.swag.reset_effects()
    found["reset"] = [opened.plan.switches(), bpy.ops.swag.reset_effects.poll()]
    return found


def stopped_run(folder):
    """What the panel says of a run folder before and after its first checkpoints."""
    swag.scene_folder = folder
    run = Path(folder, "swag_run")
    run.mkdir()
    (run / "config.json").write_text("{}")
    messages = [swag.stopped_at]
    for iteration in (900, 1200):
        (run / f"checkpoint-{iteration:07d}.safetensors").touch()
    opened = save_and_open(folder)
    assert opened.can_continue
    return [*messages, opened.stopped_at]


class RecordingLayout:
    """Stands in for the layout of a menu."""

    def __init__(self):
        self.names = []

    def operator(self, name):
        self.names.append(name)

    def separator(self):
        pass


def operators_and_menu():
    """Names of all operators and of those in the menu, and classes and properties without a description."""
    classes = [cls for module in operators._MODULES for cls in module.CLASSES if issubclass(cls, bpy.types.Operator)]
    layout = RecordingLayout()
    menu: Any = type("Menu", (), {"layout": layout})
    operators.SWAG_MT_splatting.draw(menu, bpy.context)
    groups = (properties.SwagScene, properties.effects.SwagEffect)
    undescribed = [
        (cls.__name__, name)
        for cls in (*classes, *groups)
        for name in getattr(cls, "__annotations__", {})
        if name != "name"
        and name in cls.bl_rna.properties
        and not cls.bl_rna.properties[name].description
        and not cls.bl_rna.properties[name].is_hidden
        and cls.bl_rna.properties[name].type != "POINTER"
        and not name.startswith("result_")
    ]
    return {
        "names": sorted(cls.bl_idname.partition(".")[2] for cls in classes),
        "menu": sorted(name.partition(".")[2] for name in layout.names),
        "menu is in the Object menu": operators._menu in bpy.types.VIEW3D_MT_object.draw._draw_funcs,
        "without tooltip": [cls.__name__ for cls in classes if len(cls.__doc__ or "") < 10],
        "with undo": [cls.bl_idname for cls in classes if "UNDO" in getattr(cls, "bl_options", ())],
        "undescribed": undescribed,
    }


def curve_and_figures():
    status.begin("Training")
    for iteration, psnr in ((1, None), (2, 10.0), (3, 10.0), (4, 12.5), (5, 20.0)):
        status.show(
            {
                "event": "progress", "stage": "train", "iteration": iteration, "iterations": 5, "gaussians": 7,
                "loss": 0.5, "psnr": psnr, "iterations_per_second": 2.0, "seconds_left": 65.0,
            }
        )  # fmt: skip
    return {
        "curve": status.curve,
        "drawn": sparkline([float(value) for value in status.curve.split()]),
        "flat": sparkline([3.0, 3.0]),
        "figures": status.figures(),
    }


def forecast(folder):
    swag.scene_folder = folder
    found = {"before": swag.forecast_lines()}
    bpy.ops.swag.forecast()
    found["message"], found["failed"] = status.message, status.failed
    swag.preset, swag.time_budget = "high", "10m"  # a forecast has every quality, whatever is chosen
    opened = save_and_open(folder)
    found["opened"] = opened.forecast_lines()
    for name, value in (("iterations", 100), ("recipe", "3dgs"), ("scene_folder", "/elsewhere")):
        kept = getattr(opened, name)
        setattr(opened, name, value)
        assert not opened.forecast_lines(), name
        setattr(opened, name, kept)
        assert opened.forecast_lines(), name
    return found


def press_pause(paused):
    """Whether Pause is enabled without a training, and the state after pressing it in one."""
    enabled = bpy.ops.swag.pause.poll()
    status.begin("Training")
    status.paused = paused
    bpy.ops.swag.pause()
    return {"enabled when idle": enabled, "paused": status.paused}


def idle_after_training(folder):
    """Names of threads and seconds of processor time in a second after a training."""
    swag.scene_folder = folder
    bpy.ops.swag.train()
    time.sleep(0.2)
    threads = [thread.name for thread in threading.enumerate() if thread is not threading.main_thread()]
    before = time.process_time()
    time.sleep(1.0)
    return {"threads": threads, "processor seconds": time.process_time() - before}


def plan_by_the_engine(scene):
    """Reasons of all lines of a plan, and the settings with every effect on and off."""
    swag.scene_folder = scene
    bpy.ops.swag.plan()
    found = {"reasons": [line.reason for line in swag.plan.lines]}
    for choice in ("ON", "OFF"):
        for line in swag.plan.lines:
            line.choice = choice
        found[choice] = swag.train_settings()
    return found
