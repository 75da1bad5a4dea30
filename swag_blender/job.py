"""Base classes of operators that run a child process: beside the user's work with a window, blocking without one."""

import os
import tempfile
import time
import traceback
from types import FunctionType, MethodType
from typing import Any, cast

import bpy

from ..swag_engine.base.computer_memory import free_memory
from ..swag_engine.base.errors import InputError
from . import open_run, scene_import, survey
from .blender_types import OperatorResult, present
from .engine_process import Engine, EngineError, engine_problem, stop_all, wait_for_result
from .properties import SwagScene, status_of, swag_of
from .sidebar import show_popup

TIMER_SECONDS = 0.1
"""Time between two looks at the child's events while a window is open."""
REDRAW_SECONDS = 0.5
"""Shortest time between two redraws of the sidebar: one can take long without a graphics card."""
PRINT_SECONDS = 1.0
"""Shortest time between two printed lines of progress."""
NO_PHOTOS = "Choose photos or a video first"
WRITE_TO_SCENE = ("plan", "scale")
"""Requests that write files to the folder of the photos."""
LOG_NAME = "SWAG Log"
logs: dict[str, list[str]] = {}
"""Lines that the engine wrote to its log during the last job of each name, the job that ended last at the end."""


class Job(bpy.types.Operator):
    """Operator that gives `job` (a name to show), `request`, `on_event` and `on_result`.

    With a window, the operator only starts the child, and a `RunningJob` follows it. `window_manager.swag` shows all
    jobs.

    Attributes:
        heavy: the job takes the whole machine; one such job runs at a time.
        goes_on: the job goes on when another file is opened.
        memory_mb: free memory without which the job does not start beside others, MB. The engine takes 420 before it
            has read Gaussians or photos (report of a tiny run).
    """

    # Without REGISTER: Adjust Last Operation and Repeat Last would call `execute`, which blocks the window to the end.
    bl_options = {"UNDO"}
    job: str
    heavy = goes_on = False
    memory_mb = 1500

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request for the engine. Raises EngineError or InputError."""
        raise NotImplementedError

    def start(self, context: bpy.types.Context) -> Engine:
        """Start the child process and send the request. Raises EngineError or InputError."""
        request = self.request(context)
        folder = folder_of(request)
        if reason := works_on(context, folder):
            raise InputError(f"{reason}.")
        present(status_of(context).find(self.job)).folder = folder
        engine = Engine()
        engine.send(request)
        return engine

    def on_event(self, context: bpy.types.Context, event: dict[str, Any]) -> None:
        """Handle an event that is neither progress nor result."""

    def on_timer(self, context: bpy.types.Context) -> None:
        """Do what is due ten times a second while a window is open, after the events."""

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Handle the `result` event; returns what to tell the user. Raises EngineError or InputError."""
        raise NotImplementedError

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the job may start beside those that run."""
        return may_start(cls, context)

    # -- without a window ---------------------------------------------------------------------------------------------

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Run to the end for a script; without blocking the window after a dialog or file browser."""
        if bpy.app.background or not self.options.is_invoke:
            return self.run_blocking(context)
        return self.run_beside(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Run without blocking the window; Blender calls this for buttons."""
        return self.run(context)

    def run(self, context: bpy.types.Context) -> OperatorResult:
        """Run without blocking the window; to the end where there is none."""
        return self.run_blocking(context) if bpy.app.background else self.run_beside(context)

    def run_blocking(self, context: bpy.types.Context) -> OperatorResult:
        """Run to the end and print progress. For `execute`: a call from a script returns when all is done."""
        if self._must_wait(context):
            return {"CANCELLED"}
        status = status_of(context)
        status.begin(self.job, self.heavy)
        printed = -PRINT_SECONDS

        def on_event(event: dict[str, Any]) -> None:
            nonlocal printed
            if event["event"] != "progress":
                self.on_event(context, event)
                return
            shown = present(status.find(self.job))
            shown.show(event)
            if time.monotonic() - printed >= PRINT_SECONDS or event["iteration"] == event["iterations"]:
                printed = time.monotonic()
                print(f"{self.job}: {', '.join((shown.text, *shown.figures()))}", flush=True)

        try:
            with self.start(context) as engine:
                try:
                    result = wait_for_result(engine, on_event)
                finally:
                    keep_log(self.job, engine)
            message = self.on_result(context, result)
        except (EngineError, InputError) as error:
            return self._fail(context, error)
        except BaseException:
            status.forget(self.job)
            raise
        status.end(self.job, message, False)
        self.report({"INFO"}, message)
        return {"FINISHED"}

    # -- with a window ------------------------------------------------------------------------------------------------

    def run_beside(self, context: bpy.types.Context) -> OperatorResult:
        """Start, and let a `RunningJob` read events while the user continues to work. For `invoke`."""
        if self._must_wait(context):
            return {"CANCELLED"}
        status_of(context).begin(self.job, self.heavy)
        try:
            engine = self.start(context)
        except (EngineError, InputError) as error:
            return self._fail(context, error)
        except BaseException:
            status_of(context).forget(self.job)
            raise
        follow(RunningJob(self, engine))
        # Neither FINISHED nor CANCELLED: the result makes the step of undo.
        return {"INTERFACE"}

    def _must_wait(self, context: bpy.types.Context) -> bool:
        """Tell the user where another job was started while a dialog of this one was open; returns whether it was."""
        reason = obstacle(type(self), context)
        if reason:
            self.report({"ERROR"}, f"{reason}.")
        return bool(reason)

    def _fail(self, context: bpy.types.Context, error: Exception) -> OperatorResult:
        status_of(context).end(self.job, str(error), True)
        self.report({"ERROR"}, str(error))
        return {"CANCELLED"}


class RunningJob:
    """A job that runs while the user works: Blender frees its operator before the end.

    It has the attributes that the operator had, and calls the methods of the operator's class.

    Args:
        operator: the operator that started the job.
        engine: its child process.
    """

    def __init__(self, operator: Job, engine: Engine) -> None:
        self.__dict__ |= vars(operator)
        self.operator, self.engine = type(operator), engine
        self._drawn, self._paused = 0.0, False

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.__dict__["operator"], name)
        return MethodType(value, self) if isinstance(value, FunctionType) else value

    def advance(self, context: bpy.types.Context) -> bool:
        """Pass on what the user asked for and handle the events that arrived; returns whether the job goes on."""
        status = status_of(context)
        shown = present(status.find(self.job))
        if shown.stopping:
            self.engine.cancel(shown.stopping_now)
        elif shown.paused != self._paused:
            self._paused = shown.paused
            self.engine.send({"request": "pause" if self._paused else "go_on"})
            redraw(context)
        try:
            message = self._handle_events(context)
            if message is None:
                return True
            status.end(self.job, message, False)
        except (EngineError, InputError) as error:
            self._fail(context, error)
        except Exception as error:
            traceback.print_exc()
            self._fail(context, error)
        else:
            if "UNDO" in self.bl_options:
                bpy.ops.ed.undo_push(message=self.bl_label)
        self.stop()
        redraw(context)
        return False

    def stop(self) -> None:
        """End the child."""
        self.engine.stop()
        keep_log(self.job, self.engine)

    def _handle_events(self, context: bpy.types.Context) -> str | None:
        """Handle the events that arrived; returns what to tell the user at the end, None before."""
        events = self.engine.poll()
        # Several previews may have arrived while Blender was busy: only the last one is shown.
        previews = [event for event in events if event["event"] == "preview"]
        for event in events:
            if event["event"] == "result":
                return str(self.on_result(context, event))
            if event["event"] == "progress":
                present(status_of(context).find(self.job)).show(event)
            elif event not in previews[:-1]:
                self.on_event(context, event)
        self.on_timer(context)
        if events and time.monotonic() - self._drawn >= REDRAW_SECONDS:
            redraw(context)
            self._drawn = time.monotonic()
        return None

    def _fail(self, context: bpy.types.Context, error: Exception) -> None:
        """Store how the job failed; what a user stops has not failed, unless it had to be killed."""
        status, message = status_of(context), str(error)
        failed = not present(status.find(self.job)).stopping or self.engine.terminated
        status.end(self.job, message, failed)
        if failed:
            # Beside the pointer, because its panel may be closed.
            show_popup([message], "ERROR", self.job)


class SceneJob(Job):
    """Job that sends one request about the chosen images, and gives `job`, `question` and `take`.

    The result goes to the Blender scene that was open at the start, even if another one is open by then.
    """

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether photos are chosen, the engine is there and the job may start."""
        return can_work_on_photos(cls, context)

    def question(self, swag: SwagScene) -> dict[str, Any]:
        """The request without the scene's folder."""
        raise NotImplementedError

    def take(self, swag: SwagScene, event: dict[str, Any]) -> str:
        """Handle the `result` event; returns what to tell the user."""
        raise NotImplementedError

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The whole request. Raises InputError when no images are chosen."""
        scene = present(context.scene)
        folder = chosen_scene(swag_of(scene))
        self._scene = scene.name
        return {**self.question(swag_of(scene)), "scene": folder}

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Give the result to the scene that was open at the start."""
        scene = bpy.data.scenes.get(self._scene)
        if not scene:
            raise InputError(f"The scene {self._scene} was removed; start again.")
        return self.take(swag_of(scene), event)


class ImportJob(Job):
    """Job that ends with a scene to import, and gives `job` and `question`.

    The scene is imported to the Blender scene that was open at the start, even if another one is open by then.
    """

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the engine is there and the job may start."""
        return can_run_engine(cls, context)

    def question(self) -> dict[str, Any]:
        """The request without the folder for arrays. Raises EngineError or InputError."""
        raise NotImplementedError

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The whole request."""
        question, scene = self.question(), present(context.scene)
        self._scene, self._settings = scene.name, swag_of(scene).train_settings()
        self._arrays = tempfile.TemporaryDirectory()
        return question | {"arrays": self._arrays.name, "settings": self._settings}

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Build the objects, and put splats of this scene that were opened before below its root."""
        with self._arrays:
            root, message = scene_import.add_to_scene(self._scene, event, self._settings)
        open_run.adopt_splats(root, bpy.data.scenes[self._scene])
        survey.adopt_surveys(root, bpy.data.scenes[self._scene])
        return message


def no_job_runs(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether no job runs, for `poll` of an operator that must wait for the end of any job."""
    if status_of(context).job:
        operator.poll_message_set("A job is running: wait for its end, or cancel it")
        return False
    return True


def may_start(operator: type[Job], context: bpy.types.Context, folder: str = "") -> bool:
    """Whether a job may start beside those that run, for its `poll`.

    Args:
        operator: the job.
        context: has the jobs that run.
        folder: the folder that the job would work on; "" where that is not known yet.
    """
    if reason := obstacle(operator, context) or works_on(context, folder):
        operator.poll_message_set(reason)
        return False
    return True


def obstacle(operator: type[Job], context: bpy.types.Context) -> str:
    """Why a job cannot start beside those that run; "" where it can."""
    running = status_of(context).running
    for job in running:
        if job.name == operator.job or job.heavy and operator.heavy:
            return f"{job.name} is running: wait for its end, or cancel it"
    free = free_memory() if running else None
    if free is not None and free < 1e6 * operator.memory_mb:
        return (
            f"{running[-1].name} is running, and {free / 1e9:.1f} GB of memory are free (at least "
            f"{operator.memory_mb / 1000:.1f} GB are needed): wait for its end, or cancel it"
        )
    return ""


def works_on(context: bpy.types.Context, folder: str) -> str:
    """A sentence without its point about the job that works on a folder; "" where none does."""
    for job in status_of(context).running:
        if folder and job.folder == folder:
            return f"{job.name} is working on {folder}: wait for its end, or cancel it"
    return ""


def folder_of(request: dict[str, Any]) -> str:
    """The folder that a request works on, which two must not do at once; "" for one that only reads photos."""
    names = ["out", "run", "survey"]
    if request["request"] in WRITE_TO_SCENE:
        names.append("scene")
    return next((os.path.abspath(request[name]) for name in names if request.get(name)), "")


def can_run_engine(operator: type[Job], context: bpy.types.Context, folder: str = "") -> bool:
    """Whether the engine is there and the job may start, as `may_start` does."""
    if not may_start(operator, context, folder):
        return False
    if problem := engine_problem():
        operator.poll_message_set(problem)
        return False
    return True


def can_work_on_photos(operator: type[Job], context: bpy.types.Context, folder: str = "") -> bool:
    """Whether photos are chosen, the engine is there and the job may start, as `may_start` does."""
    if not swag_of(context.scene).scene_folder:
        operator.poll_message_set(NO_PHOTOS)
        return False
    return can_run_engine(operator, context, folder)


def chosen_scene(swag: SwagScene) -> str:
    """Absolute path of the chosen images. Raises InputError when none are chosen."""
    if not swag.scene_folder:
        raise InputError(f"{NO_PHOTOS}.")
    return swag.scene_path


def keep_log(job: str, engine: Engine) -> None:
    """Keep the engine's log of a job for show_log."""
    logs.pop(job, None)
    logs[job] = list(engine.log)


def show_log(context: bpy.types.Context, job: str) -> None:
    """Open the log of a job in a text editor, in a new window if none is open; print it without a window.

    Args:
        context: has the windows.
        job: name of the job; "" for the one that ended last.
    """
    text = bpy.data.texts.get(LOG_NAME) or bpy.data.texts.new(LOG_NAME)
    lines = logs[job] if job in logs else list(logs.values())[-1]
    text.from_string("\n".join(lines) + "\n")
    if bpy.app.background:
        print(text.as_string())
        return
    windows = present(context.window_manager).windows
    areas = (area for window in windows for area in window.screen.areas)
    area = next((area for area in areas if area.type == "TEXT_EDITOR"), None)
    if area is None:
        bpy.ops.wm.window_new()
        area = windows[-1].screen.areas[0]
        area.type = "TEXT_EDITOR"
    editor: Any = area.spaces.active
    editor.text = text


def redraw(context: bpy.types.Context) -> None:
    """Redraw the sidebars and the preferences, and nothing else."""
    for window in present(context.window_manager).windows:
        for area in window.screen.areas:
            for region in area.regions:
                if (area.type, region.type) in {("VIEW_3D", "UI"), ("PREFERENCES", "WINDOW")}:
                    region.tag_redraw()


_jobs: list[RunningJob] = []
"""The jobs that run while the user works."""
_stopped_by_load: list[str] = []
"""Names of the jobs that were running when another file was opened."""


def follow(job: RunningJob) -> None:
    """Follow a job until its end. Blender's timers go on when the window that started it is closed."""
    _jobs.append(job)
    if not bpy.app.timers.is_registered(_advance):
        bpy.app.timers.register(_advance, first_interval=TIMER_SECONDS, persistent=True)


def _advance() -> float | None:
    """Advance all jobs; a timer's function."""
    context = bpy.context
    windows = present(context.window_manager).windows
    # Not one of the Preferences: results select objects. A result in the middle of a transform would be lost in undo.
    main = next(window for window in windows if window.parent is None)
    if any(operator.bl_idname.startswith("TRANSFORM_OT_") for window in windows for operator in window.modal_operators):
        return TIMER_SECONDS
    with context.temp_override(window=main):
        for job in list(_jobs):
            if not job.advance(context):
                _jobs.remove(job)
    return TIMER_SECONDS if _jobs else None


@bpy.app.handlers.persistent
def _before_load(*_: object) -> None:
    _jobs[:] = [job for job in _jobs if job.goes_on]
    kept = {job.job for job in _jobs}
    _stopped_by_load[:] = [job.name for job in status_of(bpy.context).running if job.name not in kept]
    stop_all(*(job.engine for job in _jobs))


@bpy.app.handlers.persistent
def _after_load(*_: object) -> None:
    # The file may have been saved while a job ran.
    status = status_of(bpy.context)
    cast(Any, status.jobs).clear()
    for name in _stopped_by_load:
        status.begin(name)
        status.end(name, "Stopped, because another file was opened; what was saved until then is kept.", False)
    for job in _jobs:
        status.begin(job.job, job.heavy)


def register() -> None:
    """Stop the running jobs when another file is opened."""
    bpy.app.handlers.load_pre.append(_before_load)
    bpy.app.handlers.load_post.append(_after_load)


def unregister() -> None:
    """Undo `register`."""
    bpy.app.handlers.load_post.remove(_after_load)
    bpy.app.handlers.load_pre.remove(_before_load)
    _jobs.clear()
    if bpy.app.timers.is_registered(_advance):
        bpy.app.timers.unregister(_advance)
