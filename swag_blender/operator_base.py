"""Base classes of operators."""

import os
import time

import bpy

from ..swag_engine.base.errors import InputError
from . import splats
from .blender_types import OperatorResult, present
from .engine_process import EngineError
from .runs import RUN_KEY
from .splat_selection import edited_objects
from .steps import Steps

STEP_SECONDS = 0.1
"""Time for steps of long work before the window is drawn again."""
TIMER_SECONDS = 0.01
"""Time between two turns of long work."""


class ReportingOperator(bpy.types.Operator):
    """Operator that gives `work`; what `work` returns or raises is reported to the user."""

    def work(self, context: bpy.types.Context) -> str:
        """Do it; returns what to tell the user, "" for nothing. Raises InputError or EngineError."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Call `work` and report the outcome; Blender calls this."""
        try:
            message = self.work(context)
        except (InputError, EngineError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if message:
            self.report({"INFO"}, message)
        return {"FINISHED"}


class SplatOperator(ReportingOperator):
    """Operator on the active splat object, which gives `change`. Undo takes the change back."""

    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object has splats."""
        return splats_are_active(cls, context)

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Do it to the active object; returns what to tell the user, "" for nothing. Raises as `work` does."""
        raise NotImplementedError

    def work(self, context: bpy.types.Context) -> str:
        """Call `change` with the active object."""
        return self.change(context, present(context.active_object))


class SplatsOperator(ReportingOperator):
    """Operator on the selected splat objects, which gives `work`. Undo takes the change back."""

    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether an object with splats is selected."""
        cls.poll_message_set("Select an object with splats first")
        return bool(edited_objects(context))


class SteppedOperator(SplatsOperator):
    """Operator on the selected splat objects that gives `steps`, long work whose results `work` then finds kept.

    A button takes the steps from a timer: the window shows how far they are, and Escape stops them. A script and Adjust
    Last Operation take them within `work`.
    """

    def steps(self, context: bpy.types.Context) -> Steps[None]:
        """Do the long part. Raises InputError."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Take the steps without blocking the window; Blender calls this for buttons."""
        if bpy.app.background:
            return self.execute(context)
        window_manager = present(context.window_manager)
        self._steps = self.steps(context)
        self._timer = window_manager.event_timer_add(TIMER_SECONDS, window=context.window)
        window_manager.progress_begin(0, 100)
        window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Take steps, or stop at Escape; Blender calls this for every event. The splats stay as they are meanwhile."""
        if event.type == "ESC" and event.value == "PRESS":
            self.cancel(context)
            self.report({"INFO"}, f"{self.bl_label} was stopped; nothing is changed.")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        begin = time.perf_counter()
        try:
            while time.perf_counter() - begin < STEP_SECONDS:
                fraction = next(self._steps)
            present(context.window_manager).progress_update(100 * fraction)
            present(context.workspace).status_text_set(f"{self.bl_label}: {fraction:.0%}; Escape: stop")
            return {"RUNNING_MODAL"}
        except StopIteration:
            self.cancel(context)
            return self.execute(context)
        except InputError as error:
            self.cancel(context)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Stop taking steps; Blender calls this when it removes the operator."""
        self._steps.close()
        window_manager = present(context.window_manager)
        window_manager.event_timer_remove(self._timer)
        window_manager.progress_end()
        present(context.workspace).status_text_set(None)


def splats_are_active(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether the active object has splats, for `poll` of an operator that needs them."""
    if not splats.is_splats(context.active_object):
        operator.poll_message_set("Select an object with splats first")
        return False
    return True


def active_run(context: bpy.types.Context) -> str:
    """Folder of the run of the active object; "" without one."""
    obj = context.active_object
    folder = obj.get(RUN_KEY) if obj else None
    return os.path.abspath(folder) if folder else ""
