"""Remove the engine's Python environment."""

import bpy

from ..swag_blender.blender_types import OperatorResult, present
from ..swag_blender.engine_process import environment_folder
from ..swag_blender.installation import remove_environment
from ..swag_blender.job import no_job_runs
from ..swag_blender.operator_base import ReportingOperator


class SWAG_OT_remove_engine(ReportingOperator):
    """Delete the engine's Python environment with all its packages; runs and splats stay"""

    bl_idname = "swag.remove_engine"
    bl_label = "Remove Engine"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is an environment and no job runs."""
        if not no_job_runs(cls, context):
            return False
        if not environment_folder().exists():
            cls.poll_message_set("No environment is installed")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for confirmation."""
        return present(context.window_manager).invoke_confirm(
            self, event, message=f"Deletes {environment_folder()}", confirm_text="Remove"
        )

    def work(self, context: bpy.types.Context) -> str:
        """Delete the environment."""
        remove_environment(context)
        return "The engine is removed."


CLASSES = (SWAG_OT_remove_engine,)
