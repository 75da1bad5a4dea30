"""Base classes of operators that run a child process: modal with a window, blocking and printing without one."""

import contextlib
import tempfile
import time
import traceback
from typing import Any

import bpy

from ..swag_engine.base.errors import InputError
from . import open_run, scene_import, survey
from .blender_types import OperatorResult, present
from .engine_process import Engine, EngineError, engine_problem, stop_all, wait_for_result
from .properties import SwagScene, status_of, swag_of

TIMER_SECONDS = 0.1
"""Time between two looks at the child's events while a window is open."""
REDRAW_SECONDS = 0.5
"""Shortest time between two redraws of the sidebar: one can take long without a graphics card."""
PRINT_SECONDS = 1.0
"""Shortest time between two printed lines of progress."""
NO_PHOTOS = "Choose photos or a video first"
LOG_NAME = "SWAG Log"
last_log: list[str] = []
"""Lines that the engine wrote to its log during the last job."""


class Job(bpy.types.Operator):
    """Operator that gives `job` (a name to show), `request`, `on_event` and `on_result`.

    One job runs at a time. `window_manager.swag` shows it, and its `stopping` stops it.
    """

    # Without REGISTER: Adjust Last Operation and Repeat Last would call `execute`, which blocks the window to the end.
    bl_options = {"UNDO"}
    job: str
    _engine: Engine | None = None

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request for the engine. Raises EngineError or InputError."""
        raise NotImplementedError

    def start(self, context: bpy.types.Context) -> Engine:
        """Start the child process and send the request. Raises EngineError or InputError."""
        request = self.request(context)
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
        """Whether no job runs."""
        return no_job_runs(cls, context)

    # -- without a window ---------------------------------------------------------------------------------------------

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Run to the end for a script; without blocking the window after a dialog or file browser."""
        if bpy.app.background or not self.options.is_invoke:
            return self.run_blocking(context)
        return self.run_modal(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Run without blocking the window; Blender calls this for buttons."""
        return self.run(context)

    def run(self, context: bpy.types.Context) -> OperatorResult:
        """Run without blocking the window; to the end where there is none."""
        return self.run_blocking(context) if bpy.app.background else self.run_modal(context)

    def run_blocking(self, context: bpy.types.Context) -> OperatorResult:
        """Run to the end and print progress. For `execute`: a call from a script returns when all is done."""
        if self._must_wait(context):
            return {"CANCELLED"}
        status = status_of(context)
        status.begin(self.job)
        printed = -PRINT_SECONDS

        def on_event(event: dict[str, Any]) -> None:
            nonlocal printed
            if event["event"] != "progress":
                self.on_event(context, event)
                return
            status.show(event)
            if time.monotonic() - printed >= PRINT_SECONDS or event["iteration"] == event["iterations"]:
                printed = time.monotonic()
                print(f"{self.job}: {', '.join((status.text, *status.figures()))}", flush=True)

        try:
            with self.start(context) as engine:
                try:
                    result = wait_for_result(engine, on_event)
                finally:
                    keep_log(engine)
            return self._succeed(context, result)
        except (EngineError, InputError) as error:
            return self._fail(context, error)
        finally:
            # Only an unexpected exception leaves it set.
            status.job = ""

    # -- with a window ------------------------------------------------------------------------------------------------

    def run_modal(self, context: bpy.types.Context) -> OperatorResult:
        """Start, and read events from a timer while the user continues to work. For `invoke`."""
        if self._must_wait(context):
            return {"CANCELLED"}
        window_manager = present(context.window_manager)
        status_of(context).begin(self.job)
        try:
            self._engine = self.start(context)
        except (EngineError, InputError) as error:
            return self._fail(context, error)
        self._drawn, self._paused = 0.0, False
        self._timer = window_manager.event_timer_add(TIMER_SECONDS, window=context.window)
        window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Handle the timer; Blender calls this for every event."""
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        status, engine = status_of(context), present(self._engine)
        if status.stopping:
            engine.cancel()
        elif status.paused != self._paused:
            self._paused = status.paused
            engine.send({"request": "pause" if self._paused else "go_on"})
            redraw(context)
        try:
            outcome = self._follow(context)
        except (EngineError, InputError) as error:
            outcome = self._fail(context, error)
        except Exception as error:
            traceback.print_exc()
            outcome = self._fail(context, error)
        if outcome:
            self._close(context)
            redraw(context)
        return outcome or {"PASS_THROUGH"}

    def cancel(self, context: bpy.types.Context) -> None:
        """End the job; Blender calls this when another file is opened or a window or a dialog before it is closed."""
        if self._engine:
            self._close(context)
            status_of(context).job = ""

    def _must_wait(self, context: bpy.types.Context) -> bool:
        """Tell the user where another job was started while a dialog of this one was open; returns whether it was."""
        running = status_of(context).job
        if running:
            self.report({"ERROR"}, f"{running} is running: wait for its end, or cancel it.")
        return bool(running)

    def _follow(self, context: bpy.types.Context) -> OperatorResult | None:
        """Handle the events that arrived; returns how the operator ended, None while it runs."""
        events = present(self._engine).poll()
        # Several previews may have arrived while Blender was busy: only the last one is shown.
        previews = [event for event in events if event["event"] == "preview"]
        for event in events:
            if event["event"] == "result":
                return self._succeed(context, event)
            if event["event"] == "progress":
                status_of(context).show(event)
            elif event not in previews[:-1]:
                self.on_event(context, event)
        self.on_timer(context)
        if events and time.monotonic() - self._drawn >= REDRAW_SECONDS:
            redraw(context)
            self._drawn = time.monotonic()
        return None

    def _close(self, context: bpy.types.Context) -> None:
        engine = present(self._engine)
        engine.stop()
        keep_log(engine)
        with contextlib.suppress(ReferenceError, RuntimeError):
            present(context.window_manager).event_timer_remove(self._timer)

    def _succeed(self, context: bpy.types.Context, event: dict[str, Any]) -> OperatorResult:
        message = self.on_result(context, event)
        status_of(context).end(message, False)
        self.report({"INFO"}, message)
        return {"FINISHED"}

    def _fail(self, context: bpy.types.Context, error: Exception) -> OperatorResult:
        status = status_of(context)
        # What a user stops has not failed.
        status.end(str(error), not status.stopping)
        self.report({"INFO"} if status.stopping else {"ERROR"}, str(error))
        return {"CANCELLED"}


class SceneJob(Job):
    """Job that sends one request about the chosen images, and gives `job`, `question` and `take`.

    The result goes to the Blender scene that was open at the start, even if another one is open by then.
    """

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether photos are chosen, the engine is there and no job runs."""
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
        """Whether the engine is there and no job runs."""
        return can_run_engine(cls, context)

    def question(self) -> dict[str, Any]:
        """The request without the folder for arrays. Raises EngineError or InputError."""
        raise NotImplementedError

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The whole request."""
        question = self.question()
        self._scene = present(context.scene).name
        self._arrays = tempfile.TemporaryDirectory()
        return question | {"arrays": self._arrays.name}

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Build the objects, and put splats of this scene that were opened before below its root."""
        with self._arrays:
            root, message = scene_import.add_to_scene(self._scene, event)
        open_run.adopt_splats(root, bpy.data.scenes[self._scene])
        survey.adopt_surveys(root, bpy.data.scenes[self._scene])
        return message


def no_job_runs(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether no job runs, for `poll` of an operator that must wait for the end of any job."""
    if status_of(context).job:
        operator.poll_message_set("A job is running: wait for its end, or cancel it")
        return False
    return True


def can_run_engine(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether the engine is there and no job runs, for `poll` of an operator that needs both."""
    if not no_job_runs(operator, context):
        return False
    if problem := engine_problem():
        operator.poll_message_set(problem)
        return False
    return True


def can_work_on_photos(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether photos are chosen, the engine is there and no job runs, for `poll` of an operator that needs all."""
    if not swag_of(context.scene).scene_folder:
        operator.poll_message_set(NO_PHOTOS)
        return False
    return can_run_engine(operator, context)


def chosen_scene(swag: SwagScene) -> str:
    """Absolute path of the chosen images. Raises InputError when none are chosen."""
    if not swag.scene_folder:
        raise InputError(f"{NO_PHOTOS}.")
    return swag.scene_path


def keep_log(engine: Engine) -> None:
    """Keep the engine's log for show_log."""
    last_log[:] = engine.log


def show_log(context: bpy.types.Context) -> None:
    """Open the log of the last job in a text editor, in a new window if none is open; print it without a window."""
    text = bpy.data.texts.get(LOG_NAME) or bpy.data.texts.new(LOG_NAME)
    text.from_string("\n".join(last_log) + "\n")
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


_stopped_by_load = ""
"""Name of the job that was running when another file was opened."""


@bpy.app.handlers.persistent
def _before_load(*_: object) -> None:
    global _stopped_by_load
    _stopped_by_load = status_of(bpy.context).job
    stop_all()


@bpy.app.handlers.persistent
def _after_load(*_: object) -> None:
    # The file may have been saved while a job ran; no job runs now.
    status = status_of(bpy.context)
    status.begin(_stopped_by_load)
    if _stopped_by_load:
        status.end("Stopped, because another file was opened; what was saved until then is kept.", False)


def register() -> None:
    """Stop the running job when another file is opened."""
    bpy.app.handlers.load_pre.append(_before_load)
    bpy.app.handlers.load_post.append(_after_load)


def unregister() -> None:
    """Undo `register`."""
    bpy.app.handlers.load_post.remove(_after_load)
    bpy.app.handlers.load_pre.remove(_before_load)
