"""Operators that follow a child process: modal with a window, waiting and printing without one."""

import contextlib
import time
import traceback
from typing import Any

import bpy

from ..swag_engine.base.errors import InputError
from .engine_process import Engine, EngineError, stop_all, wait_for_result

TIMER_SECONDS = 0.1
# A redraw can take long on a machine without a graphics card.
REDRAW_SECONDS = 0.5
PRINT_SECONDS = 1.0
# What the engine wrote during the last job.
last_log: list[str] = []


class Job:
    """Mixin of such an operator, which gives `job` (a name to show), `start`, `on_event` and `on_result`.

    One job runs at a time. `window_manager.swag` shows it, and its `stopping` stops it; so does Escape.
    """

    job: str

    def start(self, context: bpy.types.Context) -> Engine:
        """The child process, with the request sent. Raises EngineError or InputError."""
        raise NotImplementedError

    def on_event(self, context: bpy.types.Context, event: dict[str, Any]) -> None:
        """Called for each event that is neither progress nor result."""

    def on_timer(self, context: bpy.types.Context) -> None:
        """Called ten times a second in a window, after the events."""

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Take in the `result` event; returns what to tell the user. Raises EngineError or InputError."""
        raise NotImplementedError

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return nothing_runs(cls, context)

    # -- without a window ---------------------------------------------------------------------------------------------

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.run_waiting(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return self.run_waiting(context) if bpy.app.background else self.run_modal(context)

    def run_waiting(self, context: bpy.types.Context) -> set[str]:
        """Run to the end and print progress. For `execute`: a call from a script returns when all is done."""
        status = context.window_manager.swag
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
            # Only an unforeseen exception leaves it set.
            status.job = ""

    # -- with a window ------------------------------------------------------------------------------------------------

    def run_modal(self, context: bpy.types.Context) -> set[str]:
        """Start, and follow from a timer while the user goes on working. For `invoke`."""
        context.window_manager.swag.begin(self.job)
        try:
            self._engine = self.start(context)
        except (EngineError, InputError) as error:
            return self._fail(context, error)
        self._drawn, self._paused = 0.0, False
        self._timer = context.window_manager.event_timer_add(TIMER_SECONDS, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        status = context.window_manager.swag
        if event.type == "ESC" and event.value == "PRESS":
            status.stopping = True
            redraw(context)
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if status.stopping:
            self._engine.cancel()
        elif status.paused != self._paused:
            self._paused = status.paused
            self._engine.send({"request": "pause" if self._paused else "go_on"})
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
        """Blender calls this when it takes the operator away: another file is opened, the window closes."""
        self._close(context)
        context.window_manager.swag.job = ""

    def _follow(self, context: bpy.types.Context) -> set[str] | None:
        events = self._engine.poll()
        # A pile of previews that came while Blender was busy: the last is enough.
        previews = [event for event in events if event["event"] == "preview"]
        for event in events:
            if event["event"] == "result":
                return self._succeed(context, event)
            if event["event"] == "progress":
                context.window_manager.swag.show(event)
            elif event not in previews[:-1]:
                self.on_event(context, event)
        self.on_timer(context)
        if events and time.monotonic() - self._drawn >= REDRAW_SECONDS:
            redraw(context)
            self._drawn = time.monotonic()
        return None

    def _close(self, context: bpy.types.Context) -> None:
        self._engine.stop()
        keep_log(self._engine)
        with contextlib.suppress(ReferenceError, RuntimeError):
            context.window_manager.event_timer_remove(self._timer)

    def _succeed(self, context: bpy.types.Context, event: dict[str, Any]) -> set[str]:
        message = self.on_result(context, event)
        context.window_manager.swag.end(message, False)
        self.report({"INFO"}, message)
        return {"FINISHED"}

    def _fail(self, context: bpy.types.Context, error: Exception) -> set[str]:
        context.window_manager.swag.end(str(error), True)
        self.report({"ERROR"}, str(error))
        return {"CANCELLED"}


class SceneJob(Job):
    """Mixin of a job that asks about the chosen photographs, which gives `job`, `question` and `take`.

    The answer goes to the Blender scene that asked, though another be open by then.
    """

    def question(self, swag: bpy.types.PropertyGroup) -> dict[str, Any]:
        """The request, without its folder."""
        raise NotImplementedError

    def take(self, swag: bpy.types.PropertyGroup, event: dict[str, Any]) -> str:
        """Take in the `result` event; returns what to tell the user."""
        raise NotImplementedError

    def start(self, context: bpy.types.Context) -> Engine:
        swag = context.scene.swag
        if not swag.scene_folder:
            raise EngineError("Choose the folder with the photographs and their COLMAP model first.")
        self._scene = context.scene.name
        engine = Engine()
        engine.send({**self.question(swag), "scene": swag.scene_path})
        return engine

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        scene = bpy.data.scenes.get(self._scene)
        if not scene:
            raise EngineError(f"The scene {self._scene} is gone; begin again.")
        return self.take(scene.swag, event)


def nothing_runs(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """For the `poll` of an operator that waits for the end of any job."""
    operator.poll_message_set("Something is running: wait for its end, or cancel it")
    return not context.window_manager.swag.job


def keep_log(engine: Engine) -> None:
    """Keep what the engine wrote, for Show Log."""
    last_log[:] = engine.log


def redraw(context: bpy.types.Context) -> None:
    """Draw the sidebars and the preferences again, and nothing else."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if (area.type, region.type) in {("VIEW_3D", "UI"), ("PREFERENCES", "WINDOW")}:
                    region.tag_redraw()


_stopped_by_load = ""


@bpy.app.handlers.persistent
def _before_load(*_: object) -> None:
    global _stopped_by_load
    _stopped_by_load = bpy.context.window_manager.swag.job
    stop_all()


@bpy.app.handlers.persistent
def _after_load(*_: object) -> None:
    # A .blend can have been saved while a job ran; the one that is open now has none.
    status = bpy.context.window_manager.swag
    status.begin(_stopped_by_load)
    if _stopped_by_load:
        status.end("Stopped, because another file was opened; what was saved until then is kept.", False)


def register() -> None:
    bpy.app.handlers.load_pre.append(_before_load)
    bpy.app.handlers.load_post.append(_after_load)


def unregister() -> None:
    bpy.app.handlers.load_post.remove(_after_load)
    bpy.app.handlers.load_pre.remove(_before_load)
