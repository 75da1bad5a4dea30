"""What a scene remembers (saved in the .blend) and what Blender shows of the job that runs (not kept)."""

import json
import os
from pathlib import Path
from typing import Any, cast

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty
from bpy.types import PropertyGroup

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.run_folder import RunFolder
from ..swag_engine.settings.field import Setting, settings_of
from ..swag_engine.settings.settings import TrainSettings
from . import effects

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


class SwagScene(PropertyGroup):
    """`scene.swag`: folders of the photos and of the run, settings of the next run, figures of the last one."""

    scene_folder: StringProperty(
        name="Photographs",
        description="Folder with the photographs and their COLMAP model",
        subtype="DIR_PATH",
        update=lambda self, context: setattr(self.plan, "stale", True),
    )
    run_folder: StringProperty(
        name="Run",
        description="Folder that the training writes to; left empty: the folder swag_run beside the COLMAP model",
        subtype="DIR_PATH",
    )
    found: StringProperty(description="What the folder of photographs holds, in words")

    plan: PointerProperty(type=effects.SwagPlan)
    # The settings of the next run are added below the class, one for each field of TrainSettings.
    forecast: StringProperty(description="What the qualities would take, as JSON, with what was asked")

    water: FloatProperty(
        name="Water",
        description="How much of the fitted water is shown: 0 none, 1 as photographed; it can be animated",
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        # Drivers read the scene, and Blender does not see by itself that a property of an extension changed in it.
        update=lambda self, context: self.id_data.update_tag(),
    )

    result_ply: StringProperty(name="Result", description="Splats of the last run", subtype="FILE_PATH")
    result_gaussians: IntProperty(name="Gaussians")
    result_psnr: FloatProperty(name="PSNR", description="PSNR on photographs that the training never saw, in dB")
    result_ssim: FloatProperty(name="SSIM", description="SSIM on photographs that the training never saw")
    result_seconds: FloatProperty(name="Seconds", description="How long the last run took")
    result_water: StringProperty(name="Water", description="What the last run found of the water")
    result_interrupted: BoolProperty(name="Interrupted", description="The last run was stopped before its end")

    @property
    def scene_path(self) -> str:
        """Absolute path of the photographs; empty when none are chosen."""
        return _absolute(self.scene_folder)

    @property
    def run_path(self) -> str:
        """Absolute path of the run folder; empty when there are no photographs either."""
        if self.run_folder:
            return _absolute(self.run_folder)
        return os.path.join(self.scene_path, "swag_run") if self.scene_folder else ""

    @property
    def can_continue(self) -> bool:
        """Whether the run folder holds a run that did not come to its end."""
        run = RunFolder(Path(self.run_path))
        try:
            return bool(self.run_path) and run.config.exists() and not run.finished()
        except InputError:
            return True

    @property
    def stopped_at(self) -> str:
        """Where the run in the run folder stopped, in words."""
        saved = [path.stem.rpartition("-")[2] for path in Path(self.run_path).glob("checkpoint-*.safetensors")]
        where = f"stopped at iteration {int(max(saved))}" if saved else "stopped before its first checkpoint"
        return f"The run {os.path.basename(self.run_path)} {where}."

    def train_settings(self) -> dict[str, Any]:
        """The settings as the engine takes them; what the user says in the list of effects comes last."""
        switches = ",".join(filter(None, (self.effects, self.plan.switches())))
        own = {name: getattr(self, name) for name in SETTINGS}
        return own | {"effects": switches, "masks": _absolute(self.masks)}

    def forecast_question(self) -> str:
        """What a forecast depends on, as text: the photographs, and the settings that no quality has a say in."""
        asked = self.train_settings()
        for name in ("preset", "time_budget", "seed"):
            del asked[name]
        return json.dumps([self.scene_path, asked])

    def keep_forecast(self, question: str, presets: dict[str, dict[str, Any]]) -> None:
        """Remember the answer to a question: the presets of a forecast's `result` event."""
        self.forecast = json.dumps({"question": question, "presets": presets})

    def forecast_lines(self) -> list[tuple[str, str, str, str]]:
        """Quality, time, PSNR and memory for each quality; empty where nobody asked with the present settings."""
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
        """Keep the figures of a training's `result` event."""
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


class SwagStatus(PropertyGroup):
    """`window_manager.swag`: the job that runs now, for panels and scripts."""

    job: StringProperty(description="Name of the job that runs; empty when none does")
    last_job: StringProperty(description="Name of the last job that ended")
    stopping: BoolProperty(description="Somebody asked for the job to stop")
    paused: BoolProperty(description="The training is held where it is")
    doctor: StringProperty(description="What the engine's Python has, as JSON, when it was last looked at")
    curve: StringProperty(description="PSNR on the validation photographs so far, in dB")
    factor: FloatProperty(min=0.0, max=1.0, subtype="FACTOR")
    text: StringProperty(description="What the job does now")
    message: StringProperty(description="How the last job ended")
    failed: BoolProperty(description="The last job ended with an error")
    iteration: IntProperty()
    gaussians: IntProperty()
    loss: FloatProperty()
    psnr: FloatProperty(description="PSNR on the validation photographs in dB; 0 until measured")
    speed: FloatProperty(description="Iterations per second")
    seconds_left: FloatProperty()

    def begin(self, job: str) -> None:
        """Forget the last job."""
        for name in SwagStatus.__annotations__:
            if name != "doctor":
                self.property_unset(name)
        self.job, self.text = job, "Starting"

    def end(self, message: str, failed: bool) -> None:
        """Say how the job ended."""
        self.job, self.last_job, self.message, self.failed = "", self.job, message, failed

    def show(self, event: dict[str, Any]) -> None:
        """Keep what a `progress` event says."""
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
        """The figures of the training in words; empty before the first iteration."""
        if not self.iteration:
            return []
        return [
            f"PSNR {self.psnr:.2f} dB" if self.psnr else "PSNR not yet",
            f"{self.gaussians} Gaussians",
            f"{self.speed:.1f} iterations/s",
            f"{time_text(self.seconds_left)} left",
        ]


def progress_text(event: dict[str, Any]) -> str:
    """One `progress` event in a few words."""
    what = "Iteration" if event["stage"] == "train" else "Photograph"
    return f"{what} {event['iteration']} of {event['iterations']}"


def time_text(seconds: float) -> str:
    """A duration as m:ss, or h:mm:ss."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


def sparkline(values: list[float]) -> str:
    """Values as bars of text between the least and the largest of them."""
    bars = "▁▂▃▄▅▆▇█"
    low, span = min(values), max(max(values) - min(values), 1e-9)
    return "".join(bars[round((value - low) / span * (len(bars) - 1))] for value in values)


def _absolute(folder: str) -> str:
    return os.path.abspath(bpy.path.abspath(folder)) if folder else ""


def swag_of(scene: bpy.types.Scene | None) -> SwagScene:
    """What a scene remembers."""
    return cast(Any, scene).swag


def status_of(context: bpy.types.Context) -> SwagStatus:
    """The job that runs now."""
    return cast(Any, context.window_manager).swag


_CLASSES = (SwagScene, SwagStatus)


def register() -> None:
    effects.register()
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.swag = PointerProperty(type=SwagScene)
    bpy.types.WindowManager.swag = PointerProperty(type=SwagStatus)


def unregister() -> None:
    del bpy.types.WindowManager.swag
    del bpy.types.Scene.swag
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
    effects.unregister()
