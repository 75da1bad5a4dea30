"""Properties of a scene (saved in the .blend) and of the jobs that run (not saved)."""

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, cast

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)
from bpy.types import PropertyGroup

from ..swag_engine.base.errors import InputError
from ..swag_engine.base.text import time_text
from ..swag_engine.formats.run_folder import RunFolder
from ..swag_engine.settings.field import Setting, settings_of
from ..swag_engine.settings.jerlov import JERLOV, MOST
from ..swag_engine.settings.presets import PRESETS, SIZES, Size, Surface
from ..swag_engine.settings.recipes import recipe_of
from ..swag_engine.settings.settings import TrainSettings
from . import WORDS, effects
from .blender_types import with_properties
from .setting_property import setting_property

SETTINGS = tuple(name for name, _, _ in settings_of(TrainSettings))
IN_TIME = "time"
"""Quality that stands for a time budget."""
OWN_WATER = "own"
"""Water type that stands for the user's own attenuation."""
WATER_TYPES = {
    "I": "Clearest open ocean",
    "IA": "Very clear open ocean",
    "IB": "Clear open ocean",
    "II": "Open ocean",
    "III": "Murky open ocean",
    "1C": "Clear coast",
    "3C": "Coast",
    "5C": "Murky coast",
    "7C": "Very murky coast",
    "9C": "Murkiest coast",
}
"""What each type of JERLOV is."""
assert list(WATER_TYPES) == list(JERLOV)


def size_property(name: str, described: Setting) -> Any:
    """Make the property of a setting that the quality chooses where the user does not.

    It shows the number of the next run, and `chosen_NAME` stores the user's own number, 0 for none.

    Args:
        name: One of SIZES.
        described: Label, help and range.

    Returns:
        What Blender takes as a property's annotation.
    """
    chosen = f"chosen_{name}"

    def value(swag: Any) -> int:
        return getattr(swag.run_size, name)

    def choose(swag: Any, number: int) -> None:
        setattr(swag, chosen, 0 if number == getattr(swag.size, name) else number)

    return IntProperty(
        name=described.label,
        description=described.help,
        min=0,
        soft_min=int(described.least),
        max=int(described.most),
        subtype="PIXEL" if described.unit == "px" else "NONE",
        translation_context=WORDS,
        get=value,
        set=choose,
    )


def _forget_sizes(swag: Any, context: bpy.types.Context) -> None:
    """Let the quality choose all sizes; called when another one is chosen."""
    for name in SIZES:
        setattr(swag, f"chosen_{name}", 0)


@with_properties
class SwagScene(PropertyGroup):
    """`scene.swag`: folders of the photos and of the run, settings of the next run, figures of the last one."""

    scene_folder: Annotated[
        str,
        StringProperty(
            name="Photos",
            description="Folder with the photos and their cameras",
            subtype="DIR_PATH",
        ),
    ]
    cameras_file: Annotated[
        str,
        StringProperty(
            name="Cameras",
            description="File with the cameras, such as the XML of Metashape or transforms.json",
            subtype="FILE_PATH",
        ),
    ]
    cameras_photos: Annotated[
        str,
        StringProperty(
            name="Photos",
            description="Folder with the photos of these cameras; empty: the folder of the file",
            subtype="DIR_PATH",
        ),
    ]
    cameras_points: Annotated[
        str,
        StringProperty(
            name="Points",
            description="PLY file of points in the coordinates of the cameras; empty: those of the file or the photos",
            subtype="FILE_PATH",
        ),
    ]
    run_folder: Annotated[
        str,
        StringProperty(
            name="Output Folder",
            description="Folder that the training writes to; empty: the folder swag_run beside the photos",
            subtype="DIR_PATH",
        ),
    ]
    found: Annotated[str, StringProperty(description="Counts and warnings of the folder of photos")]

    plan: Annotated[effects.SwagPlan, PointerProperty(type=effects.SwagPlan)]
    # The settings of the next run are added below the class, one for each field of TrainSettings. Blender has its own
    # properties for those that are texts on the command line; the effects are chosen in the plan.
    recipe: str
    masks: str
    metres_per_unit: float
    preset: Annotated[
        str,
        EnumProperty(
            name="Quality",
            description="How long to train and at which size",
            items=[
                *((name, name.capitalize(), size.description) for name, size in PRESETS.items()),
                (IN_TIME, "Time Budget", "As good as possible in a time; the size is chosen by measuring this machine"),
            ],
            default=TrainSettings.preset,
            update=_forget_sizes,
        ),
    ]
    minutes: Annotated[
        float,
        FloatProperty(
            name="Minutes", description="Time that the whole run may take", default=10.0, min=0.1, max=1e5, precision=1
        ),
    ]
    water_type: Annotated[
        str,
        EnumProperty(
            name="Water Type",
            description="Initial attenuation of the water: fitted to the photos, or that of a Jerlov type",
            items=[
                ("auto", "From Photos", "Fitted to the photos"),
                *((name, name, description) for name, description in WATER_TYPES.items()),
                (OWN_WATER, "Own Values", "Your own attenuation of red, green and blue"),
            ],
        ),
    ]
    attenuation: Annotated[
        Sequence[float],
        FloatVectorProperty(
            name="Attenuation",
            description="Initial attenuation of red, green and blue per metre",
            size=3,
            default=JERLOV["IB"],
            min=0.0,
            max=MOST,
            precision=3,
        ),
    ]

    forecast: Annotated[
        str, StringProperty(description="Forecast of each quality and the settings it was made for, as JSON")
    ]

    sizes: Annotated[
        str, StringProperty(description="Sizes that each quality gives the photos and what they depend on, as JSON")
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

    haze: Annotated[
        float,
        FloatProperty(
            name="Haze",
            description="Fraction of the splats in open water that is shown: 0 none, 1 as trained. At least as much is "
            "shown as of the water",
            min=0.0,
            max=1.0,
            subtype="FACTOR",
            update=lambda self, context: self.id_data.update_tag(),
        ),
    ]

    result_ply: Annotated[str, StringProperty(name="Result", description="Splats of the last run", subtype="FILE_PATH")]
    result_gaussians: Annotated[int, IntProperty(name="Gaussians")]
    result_psnr: Annotated[float, FloatProperty(name="PSNR", description="PSNR on held-out photos, in dB")]
    result_ssim: Annotated[float, FloatProperty(name="SSIM", description="SSIM on held-out photos")]
    result_seconds: Annotated[float, FloatProperty(name="Seconds", description="Duration of the last run")]
    result_interrupted: Annotated[
        bool, BoolProperty(name="Interrupted", description="Whether the last run was stopped before its end")
    ]

    @property
    def scene_path(self) -> str:
        """Absolute path of the chosen images; "" when none are chosen."""
        return _absolute(self.scene_folder)

    @property
    def plan_is_stale(self) -> bool:
        """Whether the plan was made for other photos than the chosen ones."""
        return bool(self.plan.lines) and self.plan.folder != self.scene_path

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
        return f"The run in {self.run_path} {where}."

    def train_settings(self) -> dict[str, Any]:
        """The settings for the engine."""
        in_time, own_water = self.preset == IN_TIME, self.water_type == OWN_WATER
        changed = {
            "preset": TrainSettings.preset if in_time else self.preset,
            "time_budget": f"{self.minutes:.1f}m" if in_time else "",
            "effects": self.plan.switches(),
            "masks": _absolute(self.masks),
            "water_type": ",".join(f"{beta:.4g}" for beta in self.attenuation) if own_water else self.water_type,
            **{name: getattr(self, f"chosen_{name}") for name in SIZES},
        }
        return {name: changed[name] if name in changed else getattr(self, name) for name in SETTINGS}

    def shown_settings(self) -> dict[str, Any]:
        """The settings for a training: with the sizes that the panel shows, where they are those of the photos."""
        return self.train_settings() | (self.run_size.numbers() if self.known_size else {})

    @property
    def size(self) -> Size:
        """Size that the quality gives these photos where it is known, else its typical size."""
        return self.known_size or PRESETS.get(self.preset, PRESETS[TrainSettings.preset])

    @property
    def run_size(self) -> Size:
        """Size of the next run: the user's own numbers, else those of the quality; no more Gaussians than are trained.

        More than one Gaussian for each pixel of the surface that the photos show are never trained.
        """
        own = {name: number for name in SIZES if (number := getattr(self, f"chosen_{name}"))}
        size = replace(self.size, **own)
        if known := self._known_sizes():
            most = Surface(**known["surface"]).gaussians(size.width)
            size = replace(size, max_gaussians=min(size.max_gaussians, most))
        return size

    @property
    def known_size(self) -> Size | None:
        """Size that the engine found for the quality, these photos and settings on this machine; None before that."""
        found = self._known_sizes().get("presets", {}).get(self.preset)
        return Size(*(found[name] for name in SIZES)) if found else None

    @property
    def is_lowered(self) -> bool:
        """Whether the known size was lowered to the free memory."""
        return bool(self.known_size) and self._known_sizes()["presets"][self.preset]["lowered"]

    def _known_sizes(self) -> dict[str, Any]:
        """What the engine found for these photos and settings on this machine; empty before that."""
        kept = json.loads(self.sizes) if self.sizes else {}
        known: dict[str, Any] = kept["found"] if kept.get("asked") == self.sized_by(self.train_settings()) else {}
        return known

    def sized_by(self, settings: dict[str, Any]) -> list[Any]:
        """What the sizes of all qualities depend on: the images, the computer, and what an iteration costs."""
        densify_until = recipe_of(settings["recipe"], settings["effects"]).densify_until
        return [self.scene_path, platform.node(), settings["backend"], settings["sh_degree"], densify_until]

    def keep_sizes(self, asked: list[Any], found: dict[str, Any]) -> None:
        """Store the sizes that the engine found, and what they depend on; none where it found none."""
        self.sizes = json.dumps({"asked": asked, "found": found}) if found else ""

    def _forecast_presets(self) -> dict[str, dict[str, Any]]:
        """What the forecast for the present settings says of each quality; empty without one."""
        known = json.loads(self.forecast) if self.forecast else {}
        return known["presets"] if known.get("question") == self.forecast_question() else {}

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
        lines = []
        for name, expected in self._forecast_presets().items():
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
        self.result_interrupted = event["interrupted"]


for _name, _default, _described in settings_of(TrainSettings):
    if _name in SIZES:
        SwagScene.__annotations__ |= {
            f"chosen_{_name}": IntProperty(options={"HIDDEN"}),
            _name: size_property(_name, _described),
        }
    elif _name not in ("preset", "time_budget", "effects", "water_type"):
        SwagScene.__annotations__[_name] = setting_property(_default, _described)


@with_properties
class SwagJob(PropertyGroup):
    """A job that runs or has ended; `name` is that of the job."""

    running: Annotated[bool, BoolProperty(description="Whether the job has not ended")]
    heavy: Annotated[bool, BoolProperty(description="Whether the job takes the whole machine")]
    folder: Annotated[str, StringProperty(description="Folder that no other job may work on; empty for none")]
    stopping: Annotated[bool, BoolProperty(description="Whether the job was asked to stop")]
    stopping_now: Annotated[bool, BoolProperty(description="Whether it was asked to leave out what is still to do")]
    paused: Annotated[bool, BoolProperty(description="Whether the training is paused")]
    curve: Annotated[str, StringProperty(description="PSNR on the validation photos so far, in dB")]
    factor: Annotated[float, FloatProperty(min=0.0, max=1.0, subtype="FACTOR")]
    text: Annotated[str, StringProperty(description="Step that the job does now")]
    evaluates: Annotated[bool, BoolProperty(description="Whether the training has ended and its result is evaluated")]
    message: Annotated[str, StringProperty(description="How the job ended")]
    failed: Annotated[bool, BoolProperty(description="Whether the job ended with an error, or had to be killed")]
    iteration: Annotated[int, IntProperty()]
    gaussians: Annotated[int, IntProperty()]
    max_gaussians: Annotated[int, IntProperty(description="Largest number of Gaussians of the training")]
    width: Annotated[int, IntProperty(description="Width of the training images in pixels")]
    loss: Annotated[float, FloatProperty()]
    psnr: Annotated[float, FloatProperty(description="PSNR on the validation photos in dB; 0 until measured")]
    speed: Annotated[float, FloatProperty(description="Iterations per second")]
    seconds_left: Annotated[float, FloatProperty()]

    @property
    def shown_text(self) -> str:
        """What the job does now, with what is still done where it was asked to stop."""
        if self.stopping_now:
            return "Stopping now"
        if self.stopping:
            return f"Stopping: {self.text[:1].lower()}{self.text[1:]}" if self.evaluates else "Stopping"
        return "Paused" if self.paused else self.text

    def show(self, event: dict[str, Any]) -> None:
        """Store the values of a `progress` event."""
        self.factor = event["iteration"] / max(1, event["iterations"])
        self.text = event.get("text") or progress_text(event)
        self.evaluates = event["stage"] == "evaluate"
        if event["stage"] == "train":
            self.iteration = event["iteration"]
            self.gaussians, self.max_gaussians = event["gaussians"], event["max_gaussians"]
            self.width = event["width"]
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
            f"Maximum {self.max_gaussians}",
            f"Photos {self.width} px wide",
            f"{self.speed:.1f} iterations/s",
            f"{time_text(self.seconds_left)} left",
        ]


@with_properties
class SwagStatus(PropertyGroup):
    """`window_manager.swag`: the jobs that run, and how those before ended, for panels and scripts."""

    jobs: Annotated[Sequence[SwagJob], CollectionProperty(type=SwagJob)]
    download_mb: Annotated[
        int, IntProperty(description="Megabytes that Install Engine would download; 0 until looked up")
    ]
    packages_mb: Annotated[int, IntProperty(description="Megabytes of all its packages; 0 until looked up")]
    cuda_instead: Annotated[
        bool,
        BoolProperty(description="Whether the look-up found a torch with CUDA, though one without it was asked for"),
    ]
    doctor: Annotated[str, StringProperty(description="What the last check of the engine's Python found, as JSON")]

    @property
    def running(self) -> list[SwagJob]:
        """The jobs that run, in the order of their start."""
        return [job for job in self.jobs if job.running]

    @property
    def job(self) -> str:
        """Name of the job that runs, of the one started last where several do; "" where none does."""
        return next((job.name for job in reversed(self.running)), "")

    @property
    def message(self) -> str:
        """How the last job ended."""
        return next((job.message for job in reversed(self.jobs) if not job.running), "")

    @property
    def failed(self) -> bool:
        """Whether the last job ended with an error."""
        return any(job.failed for job in [job for job in self.jobs if not job.running][-1:])

    def find(self, job: str) -> SwagJob | None:
        """The running job of a name; None where it does not run."""
        return next((one for one in self.running if one.name == job), None)

    def ended(self, *jobs: str) -> SwagJob | None:
        """The one of these jobs that ended last; None where none did, or one runs."""
        found = [one for one in self.jobs if one.name in jobs]
        return found[-1] if found and not any(one.running for one in found) else None

    def begin(self, job: str, heavy: bool = False, folder: str = "") -> SwagJob:
        """Add a job, in the place of an earlier one of its name."""
        self.forget(job)
        added = cast(Any, self.jobs).add()
        added.name, added.running, added.heavy, added.folder, added.text = job, True, heavy, folder, "Starting"
        return cast(SwagJob, added)

    def end(self, job: str, message: str, failed: bool) -> None:
        """Store how a job ended."""
        jobs = cast(Any, self.jobs)
        index = jobs.find(job)
        jobs[index].running, jobs[index].message, jobs[index].failed = False, message, failed
        jobs.move(index, len(jobs) - 1)

    def forget(self, job: str) -> None:
        """Remove a job from the list."""
        jobs = cast(Any, self.jobs)
        if (index := jobs.find(job)) >= 0:
            jobs.remove(index)


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
    """The jobs of Blender's session."""
    return cast(Any, context.window_manager).swag


_CLASSES = (SwagScene, SwagJob, SwagStatus)


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
