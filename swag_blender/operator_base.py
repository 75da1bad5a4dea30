"""Base classes of operators."""

import os

import bpy

from ..swag_engine.base.errors import InputError
from . import splats
from .blender_types import OperatorResult, present
from .engine_process import EngineError
from .runs import RUN_KEY
from .splat_selection import edited_objects


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
