"""Properties of a scene (saved in the .blend) and of the job that runs (not saved)."""

import json
import os
from pathlib import Path
from typing import Annotated, Any, cast

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty
from bpy.types import PropertyGroup

from ..swag_engine.base.errors import InputError
from ..swag_engine.base.text import time_text
from ..swag_engine.formats.run_folder import RunFolder
from ..swag_engine.settings.field import Setting, settings_of
from ..swag_engine.settings.settings import TrainSettings
from . import effects
from .blender_types import with_properties

SETTINGS = tuple(name for name, _, _ in settings_of(TrainSettings))


def setting_property(default: Any, described: Setting) -> Any:
    """Make the property of one setting of the engine.

    Args:
        default: Default value; its type chooses the kind of property.
        described: Label, help, range and choices.

    Returns:
        What Blender takes as a property's annotation.
    """
    words: dict[str, Any] = {"name": described.label, "description": described.description, "default": default}
    if described.choices:
        return EnumProperty(items=[(choice, choice, text) for choice, text in described.choices.items()], **words)
    if isinstance(default, bool):
        return BoolProperty(**words)
    if isinstance(default, str):
        return StringProperty(subtype="DIR_PATH" if described.is_folder else "NONE", **words)
    words["min"] = 0 if described.zero else described.least
    words["max"] = described.most
    if isinstance(default, int):
        return IntProperty(subtype="PIXEL" if described.unit == "px" else "NONE", **words)
    return FloatProperty(precision=4, **words)


@with_properties
class SwagScene(PropertyGroup):
    """`scene.swag`: folders of the photos and of the run, settings of the next run, figures of the last one."""

    scene_folder: Annotated[
        str,
        StringProperty(
            name="Photos",
            description="Folder with the photos and their COLMAP model",
            subtype="DIR_PATH",
            update=lambda self, context: setattr(self.plan, "stale", True),
        ),
    ]
    run_folder: Annotated[
        str,
        StringProperty(
            name="Run",
            description="Folder that the training writes to; empty: the folder swag_run beside the COLMAP model",
            subtype="DIR_PATH",
        ),
    ]
    found: Annotated[str, StringProperty(description="Counts and warnings of the folder of photos")]

    plan: Annotated[effects.SwagPlan, PointerProperty(type=effects.SwagPlan)]
    # The settings of the next run are added below the class, one for each field of TrainSettings. These are used here.
    effects: str
    masks: str
    metres_per_unit: float

    forecast: Annotated[
        str, StringProperty(description="Forecast of each quality and the settings it was made for, as JSON")
    ]

    water: Annotated[
        float,
        FloatProperty(
            name="Water",
            description="Fraction of the fitted water that is shown: 0 none, 1 as photographed; it can be animated",
            min=0.0,
            max=1.0,
            subtype="FACTOR",
            # Drivers read the scene, and Blender does not notice changes of an extension's property by itself.
            update=lambda self, context: self.id_data.update_tag(),
        ),
    ]

    result_ply: Annotated[str, StringProperty(name="Result", description="Splats of the last run", subtype="FILE_PATH")]
    result_gaussians: Annotated[int, IntProperty(name="Gaussians")]
    result_psnr: Annotated[float, FloatProperty(name="PSNR", description="PSNR on held-out photos, in dB")]
    result_ssim: Annotated[float, FloatProperty(name="SSIM", description="SSIM on held-out photos")]
    result_seconds: Annotated[float, FloatProperty(name="Seconds", description="Duration of the last run")]
    result_water: Annotated[str, StringProperty(name="Water", description="Water that the last run fitted")]
    result_interrupted: Annotated[
        bool, BoolProperty(name="Interrupted", description="Whether the last run was stopped before its end")
    ]

    @property
    def scene_path(self) -> str:
        """Absolute path of the chosen images; "" when none are chosen."""
        return _absolute(self.scene_folder)

    @property
    def run_path(self) -> str:
        """Absolute path of the run folder; "" when neither it nor images are chosen."""
        if self.run_folder:
            return _absolute(self.run_folder)
        return os.path.join(self.scene_path, "swag_run") if self.scene_folder else ""

    @property
    def can_continue(self) -> bool:
        """Whether the run folder holds an unfinished run."""
        run = RunFolder(Path(self.run_path))
        try:
            return bool(self.run_path) and run.config.exists() and not run.finished()
        except InputError:
            return True

    @property
    def stopped_at(self) -> str:
        """A sentence that says where the run in the run folder stopped."""
        saved = [path.stem.rpartition("-")[2] for path in Path(self.run_path).glob("checkpoint-*.safetensors")]
        where = f"stopped at iteration {int(max(saved))}" if saved else "stopped before its first checkpoint"
        return f"The run {os.path.basename(self.run_path)} {where}."

    def train_settings(self) -> dict[str, Any]:
        """The settings for the engine; choices in the list of effects overrule the setting `effects`."""
        switches = ",".join(filter(None, (self.effects, self.plan.switches())))
        own = {name: getattr(self, name) for name in SETTINGS}
        return own | {"effects": switches, "masks": _absolute(self.masks)}

    def forecast_question(self) -> str:
        """What a forecast depends on, as text: the images and the settings that qualities do not change."""
        asked = self.train_settings()
        for name in ("preset", "time_budget", "seed"):
            del asked[name]
        return json.dumps([self.scene_path, asked])

    def keep_forecast(self, question: str, presets: dict[str, dict[str, Any]]) -> None:
        """Store a forecast: the presets of its `result` event, and its question."""
        self.forecast = json.dumps({"question": question, "presets": presets})

    def forecast_lines(self) -> list[tuple[str, str, str, str]]:
        """Name, time, PSNR and memory of each quality; empty without a forecast for the present settings."""
        known = json.loads(self.forecast) if self.forecast else {}
        if known.get("question") != self.forecast_question():
            return []
        lines = []
        for name, expected in known["presets"].items():
            least, _, most = map(time_text, expected["seconds"])
            psnr = "{0:.1f}-{2:.1f} dB".format(*expected["psnr"]) if expected["psnr"] else "PSNR unknown"
            lines.append((name, f"{least}-{most}", psnr, f"{expected['memory_mb'] / 1000:.1f} GB"))
        return lines

    def show_metrics(self, event: dict[str, Any]) -> None:
        """Store the figures of a training's `result` event."""
        metrics = event["metrics"]
        self.result_ply = event["ply"]
        self.result_gaussians = metrics["gaussians"]
        self.result_psnr = metrics.get("test_psnr") or 0.0
        self.result_ssim = metrics.get("test_ssim") or 0.0
        self.result_seconds = metrics["seconds"]
        self.result_water = " ".join([metrics["water"], *metrics["notes"]]).strip()
        self.result_interrupted = event["interrupted"]


SwagScene.__annotations__ |= {
    name: setting_property(default, described) for name, default, described in settings_of(TrainSettings)
}


@with_properties
class SwagStatus(PropertyGroup):
    """`window_manager.swag`: the job that runs now, for panels and scripts."""

    job: Annotated[str, StringProperty(description="Name of the job that runs; empty when none does")]
    last_job: Annotated[str, StringProperty(description="Name of the last job that ended")]
    stopping: Annotated[bool, BoolProperty(description="Whether the job was asked to stop")]
    paused: Annotated[bool, BoolProperty(description="Whether the training is paused")]
    doctor: Annotated[str, StringProperty(description="What the last check of the engine's Python found, as JSON")]
    curve: Annotated[str, StringProperty(description="PSNR on the validation photos so far, in dB")]
    factor: Annotated[float, FloatProperty(min=0.0, max=1.0, subtype="FACTOR")]
    text: Annotated[str, StringProperty(description="Step that the job does now")]
    message: Annotated[str, StringProperty(description="How the last job ended")]
    failed: Annotated[bool, BoolProperty(description="Whether the last job ended with an error")]
    iteration: Annotated[int, IntProperty()]
    gaussians: Annotated[int, IntProperty()]
    loss: Annotated[float, FloatProperty()]
    psnr: Annotated[float, FloatProperty(description="PSNR on the validation photos in dB; 0 until measured")]
    speed: Annotated[float, FloatProperty(description="Iterations per second")]
    seconds_left: Annotated[float, FloatProperty()]

    def begin(self, job: str) -> None:
        """Reset everything for a new job."""
        for name in SwagStatus.__annotations__:
            if name != "doctor":
                self.property_unset(name)
        self.job, self.text = job, "Starting"

    def end(self, message: str, failed: bool) -> None:
        """Store how the job ended."""
        self.job, self.last_job, self.message, self.failed = "", self.job, message, failed

    def show(self, event: dict[str, Any]) -> None:
        """Store the values of a `progress` event."""
        self.factor = event["iteration"] / max(1, event["iterations"])
        self.text = event.get("text") or progress_text(event)
        if event["stage"] == "train":
            self.iteration = event["iteration"]
            self.gaussians = event["gaussians"]
            self.loss = event["loss"] or 0.0
            measured = f" {event['psnr'] or 0:.2f}"
            if event["psnr"] and not self.curve.endswith(measured):
                self.curve += measured
            self.psnr = event["psnr"] or 0.0
            self.speed = event["iterations_per_second"] or 0.0
            self.seconds_left = event["seconds_left"] or 0.0

    def figures(self) -> list[str]:
        """The figures of the training as texts; empty before the first iteration."""
        if not self.iteration:
            return []
        return [
            f"PSNR {self.psnr:.2f} dB" if self.psnr else "PSNR not yet",
            f"{self.gaussians} Gaussians",
            f"{self.speed:.1f} iterations/s",
            f"{time_text(self.seconds_left)} left",
        ]


def progress_text(event: dict[str, Any]) -> str:
    """Text of a `progress` event."""
    what = "Iteration" if event["stage"] == "train" else "Photo"
    return f"{what} {event['iteration']} of {event['iterations']}"


def _absolute(folder: str) -> str:
    return os.path.abspath(bpy.path.abspath(folder)) if folder else ""


def swag_of(scene: bpy.types.Scene | None) -> SwagScene:
    """Properties of a scene."""
    return cast(Any, scene).swag


def status_of(context: bpy.types.Context) -> SwagStatus:
    """The job that runs now."""
    return cast(Any, context.window_manager).swag


_CLASSES = (SwagScene, SwagStatus)


def register() -> None:
    """Register the properties with scenes and the window manager."""
    effects.register()
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    cast(Any, bpy.types.Scene).swag = PointerProperty(type=SwagScene)
    cast(Any, bpy.types.WindowManager).swag = PointerProperty(type=SwagStatus)


def unregister() -> None:
    """Undo `register`."""
    del cast(Any, bpy.types.WindowManager).swag
    del cast(Any, bpy.types.Scene).swag
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
    effects.unregister()
