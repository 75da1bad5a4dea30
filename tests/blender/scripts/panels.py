"""The sidebar's data: plan, forecast, settings in the .blend, progress; and the menu of all operators."""

import json
import threading
import time
import types
from pathlib import Path
from typing import Any

import bpy
from bl_ext.user_default.swag_splatting import operators
from bl_ext.user_default.swag_splatting.swag_blender import (
    color_chart,
    colors,
    edit_panel,
    effect_pictures,
    effects,
    film_panel,
    maps_panel,
    panels,
    properties,
    survey_panel,
    water,
)
from bl_ext.user_default.swag_splatting.swag_blender.sidebar import SwagPanel
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
    found["figures"] = {e.name: [[f.name, f.measured, f.needed, f.met] for f in e.figures] for e in swag.plan.lines}
    found["explained"] = [e.name for e in swag.plan.lines if e.explained]
    found["lines"] = [[e.name, e.title, e.state, e.reason, round(e.cost_ms, 2)] for e in swag.plan.lines]
    swag.plan.lines["lamp"].choice, swag.plan.lines["attenuation"].choice = "ON", "OFF"
    found["settings"] = swag.train_settings()["effects"]
    bpy.ops.swag.plan()
    found["after another plan"] = swag.plan.switches()
    opened = save_and_open(folder)
    found["opened"] = [opened.plan.switches(), opened.plan.lines["lamp"].reason, opened.plan_is_stale]
    opened.scene_folder = "/elsewhere"
    found["stale"] = opened.plan_is_stale
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
        "menu is in the Object menu": operators._object_menu in bpy.types.VIEW3D_MT_object.draw._draw_funcs,
        "without tooltip": [cls.__name__ for cls in classes if len(cls.__doc__ or "") < 10],
        "with undo": [cls.bl_idname for cls in classes if "UNDO" in getattr(cls, "bl_options", ())],
        "undescribed": undescribed,
    }


def curve_and_figures():
    training = status.begin("Training")
    for iteration, psnr in ((1, None), (2, 10.0), (3, 10.0), (4, 12.5), (5, 20.0)):
        training.show(
            {
                "event": "progress", "stage": "train", "iteration": iteration, "iterations": 5, "gaussians": 7,
                "max_gaussians": 90, "width": 640, "loss": 0.5, "psnr": psnr, "iterations_per_second": 2.0,
                "seconds_left": 65.0,
            }
        )  # fmt: skip
    return {
        "curve": training.curve,
        "drawn": sparkline([float(value) for value in training.curve.split()]),
        "flat": sparkline([3.0, 3.0]),
        "figures": training.figures(),
    }


def forecast(folder):
    swag.scene_folder = folder
    found = {"before": swag.forecast_lines()}
    bpy.ops.swag.forecast()
    found["message"], found["failed"] = status.message, status.failed
    swag.preset = "time"  # a forecast has every quality, whatever is chosen
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
    training = status.begin("Training")
    training.paused = paused
    bpy.ops.swag.pause()
    return {"enabled when idle": enabled, "paused": training.paused}


def idle_after_training(folder):
    """Names of threads that a training has left, and seconds of processor time in a second after it."""
    swag.scene_folder = folder
    earlier = threading.enumerate()
    bpy.ops.swag.train()
    time.sleep(0.2)
    threads = [thread.name for thread in threading.enumerate() if thread not in earlier]
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


class RecordingPanel:
    """Stands in for the layout of a panel: takes any call and keeps the texts, properties and operators drawn."""

    def __init__(self, drawn):
        object.__setattr__(self, "drawn", drawn)

    def __setattr__(self, name, value):
        pass

    def __getattr__(self, name):
        def call(*arguments, text="", **options):
            if name in ("prop", "template_list"):
                self.drawn.append(str(arguments[1] if name == "prop" else arguments[0]))
            elif name == "operator":
                self.drawn.append(arguments[0])
                return RecordingPanel([])
            elif name == "panel":
                return RecordingPanel(self.drawn), RecordingPanel(self.drawn)
            if text:
                self.drawn.append(text)
            return RecordingPanel(self.drawn)

        return call


def panel_classes():
    """The panels of the sidebar's tab."""
    modules = (panels, water, color_chart, colors, edit_panel, film_panel, maps_panel, survey_panel)
    classes = [cls for module in modules for cls in vars(module).values() if isinstance(cls, type)]
    return [cls for cls in dict.fromkeys(classes) if issubclass(cls, SwagPanel) and cls is not SwagPanel]


def draw_all(context):
    """What each panel that is shown draws, by its name."""
    found = {}
    for cls in panel_classes():
        if not hasattr(cls, "poll") or cls.poll(context):
            drawn: list[str] = []
            cls.draw(type("Panel", (), {"layout": RecordingPanel(drawn)})(), context)
            found[cls.__name__] = drawn
    return found


def context_of_a_sidebar():
    """A context with a region, which there is none of without a window."""
    own = bpy.context
    return types.SimpleNamespace(
        scene=own.scene, window_manager=own.window_manager, preferences=own.preferences, mode=own.mode,
        active_object=own.active_object, selected_objects=own.selected_objects, view_layer=own.view_layer,
        visible_objects=own.visible_objects,
        region=types.SimpleNamespace(width=280),
    )  # fmt: skip


def is_open_below(cls, parent):
    return getattr(cls, "bl_parent_id", "") == parent and "DEFAULT_CLOSED" not in getattr(cls, "bl_options", ())


def panels_by_stage(folder):
    """Order and closed panels of the tab, and what is drawn before photos are chosen, before and after training."""
    tops = [cls for cls in panel_classes() if not getattr(cls, "bl_parent_id", "")]
    found = {
        "order": [cls.bl_label for cls in sorted(tops, key=lambda cls: cls.bl_order)],
        "open": [cls.__name__ for cls in tops if "DEFAULT_CLOSED" not in getattr(cls, "bl_options", ())],
        "open below Result": [cls.__name__ for cls in panel_classes() if is_open_below(cls, "SWAG_PT_result")],
        "fresh": draw_all(context_of_a_sidebar()),
    }
    swag.scene_folder = folder
    bpy.ops.swag.plan()
    found["planned"] = draw_all(context_of_a_sidebar())
    bpy.ops.swag.train()
    found["trained"] = draw_all(context_of_a_sidebar())
    return found


def sizes():
    """Numbers that the panel shows, and settings of the engine, for several choices."""
    names = ("iterations", "width", "max_gaussians")

    def now():
        settings = swag.train_settings()
        return [[getattr(swag, name) for name in names], [settings[name] for name in names], settings["time_budget"]]

    found = {"standard": now()}
    swag.preset = "draft"
    found["draft"] = now()
    swag.iterations = 700
    found["own"] = now()
    swag.iterations = 1500  # the preset's own number
    found["as the preset"] = now()
    swag.iterations = 700
    swag.preset = "high"
    found["high"] = now()
    swag.preset, swag.minutes = "time", 2.5
    found["time"] = now()
    return found


def water_types():
    """The engine's setting for each water type of the menu."""
    found = {}
    swag.attenuation = (0.3, 0.1, 0.0625)
    for item in swag.bl_rna.properties["water_type"].enum_items:
        swag.water_type = item.identifier
        found[item.identifier] = swag.train_settings()["water_type"]
    return found


def reasons(folder):
    """For each operator: whether it can run, and the reason that its button shows, without and with a job."""
    found = {}
    for when in ("idle", "busy"):
        if when == "busy":
            status.begin("Training", heavy=True)
        for module in operators._MODULES:
            for cls in (cls for cls in module.CLASSES if issubclass(cls, bpy.types.Operator) and hasattr(cls, "poll")):
                said: list[str] = []
                stand_in: Any = type(cls.__name__, (cls,), {"poll_message_set": staticmethod(said.append)})
                found[f"{when} {cls.bl_idname}"] = [bool(stand_in.poll(bpy.context)), said]
    status.forget("Training")
    return found


def pictures():
    """Sizes of the pictures of all effects in pixels, and the largest size of a file in bytes."""
    names = list(effects.EFFECTS)
    files = [effect_pictures.FOLDER / f"{name}.jpg" for name in names]
    for name in names:
        effect_pictures.picture_of(name)  # 0 without a window
    loaded = [list(effect_pictures._pictures[name].image_size) for name in names]
    return [loaded, max(path.stat().st_size for path in files)]


def sizes_before_and_in_the_run(scene, folder):
    """For each choice of a user: the numbers in the panel, and those in config.json of the run."""
    swag.scene_folder = scene
    found: dict[str, Any] = {"unknown": swag.known_size is None}
    bpy.ops.swag.inspect_scene()
    for name, chosen in (("draft", {}), ("standard", {}), ("own", {"width": 40, "iterations": 20})):
        swag.preset = "standard" if name == "own" else name
        for setting, number in chosen.items():
            setattr(swag, setting, number)
        shown = {setting: getattr(swag, setting) for setting in ("iterations", "width", "max_gaussians")}
        request = swag.shown_settings()
        found[name] = {"known": swag.known_size is not None, "shown": shown, "asked": {k: request[k] for k in shown}}
    swag.run_folder = folder
    bpy.ops.swag.train()
    settings = json.loads((Path(swag.run_path) / "config.json").read_text())["settings"]
    found["own"]["config"] = {k: settings[k] for k in shown}
    return found


def known_sizes(folder):
    """Whether sizes are known after changes of the user; the numbers of Gaussians at own widths; what is lowered."""

    def gaussians(**own):
        for name, number in own.items():
            setattr(swag, name, number)
        return swag.max_gaussians

    swag.backend, swag.sh_degree = "torch", 1
    bpy.ops.swag.find_cameras(filepath=folder, scene_folder=folder + "_scene")
    found: dict[str, Any] = {"imported with other settings": swag.known_size is not None, "lowered": [swag.is_lowered]}
    found["gaussians"] = [gaussians(), gaussians(width=96), gaussians(width=480), gaussians(max_gaussians=10**6)]
    found["own"] = swag.known_size is not None
    swag.preset = "high"
    found["lowered"].append(swag.is_lowered)
    found["other quality"] = [swag.known_size is not None, swag.max_gaussians]
    swag.preset = "time"
    found["in time"] = [swag.known_size is not None, swag.shown_settings()["max_gaussians"]]
    swag.preset = "standard"
    for name, value in (("seed", 5), ("sh_degree", 3), ("scene_folder", folder)):
        before = getattr(swag, name)
        setattr(swag, name, value)
        found[name] = swag.known_size is not None
        setattr(swag, name, before)
    return found
