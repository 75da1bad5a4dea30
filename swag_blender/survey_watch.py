"""What the jobs of a survey do while they run outside of Blender: read from the survey's files by a timer.

A thread reads the files, because a network folder can be slow; it never touches Blender's data.
"""

import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, cast

import bpy
from bpy.props import BoolProperty, CollectionProperty, FloatProperty, IntProperty, PointerProperty, StringProperty
from bpy.types import PropertyGroup

from ..swag_engine.base.claim import WATCHED_SECONDS
from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.survey_folder import COARSE, Block, Survey, SurveyFolder
from ..swag_engine.formats.survey_state import Progress, progress_of
from .blender_types import present, with_properties
from .job import redraw
from .survey import chosen_survey
from .survey_map import color_map, make_map, map_of

SECONDS = 3.0
"""Time between two readings."""
POLL_SECONDS = 0.1
"""Time between two looks whether a reading is done."""


@dataclass(frozen=True)
class Reading:
    """A survey as its files say.

    Attributes:
        folder: The survey.
        version: Time of survey.json, ns: the blocks are read again when it changes.
        survey: What is in survey.json.
        parts: Its blocks and seams.
        statuses: State of the coarse model and of each block and seam by its name.
        beats: Last beat of each job that somebody works on, and the local clock (s) when it was first seen.
        merged: Whether it has been merged.
    """

    folder: SurveyFolder
    version: int
    survey: Survey
    parts: tuple[Block, ...]
    statuses: Mapping[str, Progress] = field(default_factory=dict)
    beats: Mapping[str, tuple[int, float]] = field(default_factory=dict)
    merged: bool = False


def read_survey(folder: SurveyFolder, before: Reading | None = None, now: float | None = None) -> Reading:
    """Read the states of all jobs of a survey.

    A job whose claim stands still for WATCHED_SECONDS is not running any more: its process was killed.

    Args:
        folder: the survey.
        before: the reading before this one.
        now: local clock, seconds; time.monotonic() by default.

    Raises:
        InputError: the survey was removed or is damaged.
    """
    try:
        version = folder.survey.stat().st_mtime_ns
    except OSError:
        version = 0
    if before is None or (before.folder, before.version) != (folder, version):
        survey = folder.read()
        before = Reading(folder, version, survey, tuple(folder.read_block(name) for name in survey.parts))
    now = time.monotonic() if now is None else now
    iterations = {COARSE: before.survey.coarse_settings.iterations}
    iterations |= {part.name: part.iterations for part in before.parts}
    statuses, beats = {}, {}
    for name, number in iterations.items():
        status = progress_of(folder, name, number)
        if status.state == "running":
            beat, seen = before.beats.get(name, (-1, now))
            beats[name] = (beat, seen) if beat == status.beat else (status.beat, now)
            if now - beats[name][1] > WATCHED_SECONDS:
                status = replace(status, state="begun")
        statuses[name] = status
    merged = (folder.merged / "tiles.json").is_file()
    return Reading(folder, version, before.survey, before.parts, statuses, beats, merged)


@with_properties
class SwagSurveyJob(PropertyGroup):
    """A job of a survey: the coarse model, a block or a seam."""

    state: Annotated[str, StringProperty(description="waiting, begun, running, failed or done")]
    psnr: Annotated[float, FloatProperty(description="PSNR in dB; 0 until it is measured")]
    fraction: Annotated[float, FloatProperty(description="Fraction of its iterations that is done, 0..1")]
    gaussians: Annotated[int, IntProperty(description="Number of Gaussians")]
    problem: Annotated[str, StringProperty(description="Why it failed")]


@with_properties
class SwagSurveyJobs(PropertyGroup):
    """`window_manager.swag_survey`: the jobs of the survey that was read last, for panels and scripts."""

    folder: Annotated[str, StringProperty(description="Folder of the survey")]
    problem: Annotated[str, StringProperty(description="Why the survey cannot be read")]
    merged: Annotated[bool, BoolProperty(description="Whether the survey has been merged")]
    jobs: Annotated["bpy.types.bpy_prop_collection_idprop[SwagSurveyJob]", CollectionProperty(type=SwagSurveyJob)]
    active: Annotated[int, IntProperty(description="Number of the chosen job")]

    def count(self, state: str) -> int:
        """Number of blocks and seams in a state, without the coarse model."""
        return sum(job.state == state for job in self.jobs if job.name != COARSE)


def jobs_of(context: bpy.types.Context) -> SwagSurveyJobs:
    """The jobs of the survey that was read last."""
    return cast(Any, context.window_manager).swag_survey


_last: Reading | None = None
_reading: Future[Reading] | None = None
_reader = ThreadPoolExecutor(1, thread_name_prefix="swag-survey")


def refresh(context: bpy.types.Context, folder: SurveyFolder) -> Reading:
    """Read a survey now, and show what was read in the panel and the maps of the scene.

    Raises:
        InputError: the survey is damaged.
    """
    global _last
    _last = read_survey(folder, _last)
    _show(context, present(context.scene), _last)
    return _last


def show_blocks(context: bpy.types.Context, folder: SurveyFolder) -> str:
    """Make the map of a survey in the scene; returns what to tell the user.

    Raises:
        InputError: the survey is damaged.
    """
    reading = refresh(context, folder)
    blocks = [part for part in reading.parts if not part.sides]
    obj = make_map(present(context.scene), folder, reading.survey, blocks)
    color_map(obj, reading.statuses)
    follow()
    done = sum(reading.statuses[block.name].state == "done" for block in blocks)
    return f"{len(blocks)} blocks of {reading.survey.images} photos, {done} finished."


def follow() -> None:
    """Start to read the survey of the open scene again and again; a panel may call this while it is drawn."""
    if not bpy.app.background and not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=0.0, persistent=True)


def _tick() -> float | None:
    """Start a reading, or show one that is done; Blender calls this. It ends where no scene has a survey."""
    global _last, _reading
    context = bpy.context
    scenes = [window.scene for window in present(context.window_manager).windows]
    found = next(((scene, folder) for scene in scenes if (folder := chosen_survey(scene)) is not None), None)
    if found is None:
        _reading = None
        return None
    scene, folder = found
    if _reading is None:
        _reading = _reader.submit(read_survey, folder, _last)
        return POLL_SECONDS
    if not _reading.done():
        return POLL_SECONDS
    reading, _reading = _reading, None
    try:
        _last = reading.result()
    except InputError as error:
        _show_problem(context, folder, str(error))
        return SECONDS
    if _last.folder == folder and _show(context, scene, _last):
        redraw(context)
    return SECONDS


def _show_problem(context: bpy.types.Context, folder: SurveyFolder, problem: str) -> None:
    shown = jobs_of(context)
    if (shown.folder, shown.problem) != (str(folder.path), problem):
        shown.jobs.clear()
        shown.folder, shown.problem = str(folder.path), problem
        redraw(context)


def _show(context: bpy.types.Context, scene: bpy.types.Scene, reading: Reading) -> bool:
    """Color the map by a reading and store it for the panel; returns whether the panel has changed."""
    shown = jobs_of(context)
    if (obj := map_of(scene, reading.folder)) is not None:
        color_map(obj, reading.statuses)
    values = [
        (name, one.state, one.psnr or 0.0, one.fraction, one.gaussians, one.problem)
        for name, one in reading.statuses.items()
    ]
    fields = ("name", *SwagSurveyJob.__annotations__)
    path = str(reading.folder.path)
    now = (path, "", reading.merged, [_rounded(value) for value in values])
    if now == (shown.folder, shown.problem, shown.merged, [_stored(job, fields) for job in shown.jobs]):
        return False
    shown.folder, shown.problem, shown.merged = path, "", reading.merged
    if len(shown.jobs) != len(values):
        shown.jobs.clear()
        for _ in values:
            shown.jobs.add()
    for job, value in zip(shown.jobs, values, strict=True):
        for name, one in zip(fields, value, strict=True):
            setattr(job, name, one)
    return True


def _rounded(values: tuple[Any, ...]) -> tuple[Any, ...]:
    """The values as they compare with stored ones, which are single floats."""
    return tuple(round(value, 3) if isinstance(value, float) else value for value in values)


def _stored(job: SwagSurveyJob, fields: tuple[str, ...]) -> tuple[Any, ...]:
    return _rounded(tuple(getattr(job, name) for name in fields))


_CLASSES = (SwagSurveyJob, SwagSurveyJobs)


def register() -> None:
    """Register the properties with the window manager."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    cast(Any, bpy.types.WindowManager).swag_survey = PointerProperty(type=SwagSurveyJobs)


def unregister() -> None:
    """Undo `register`, and stop reading."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    del cast(Any, bpy.types.WindowManager).swag_survey
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
