"""Compare the held-out PSNR of a run with and without the selected splats."""

import tempfile
from pathlib import Path
from typing import Any

import bpy

from ..swag_blender import edit_score
from ..swag_blender.blender_types import present
from ..swag_blender.job import Job, may_start
from ..swag_blender.operator_base import active_run, splats_are_active


class SWAG_OT_score_selection(Job):
    """Compute how the PSNR on the held-out photos changes when the selected splats are deleted; Escape stops"""

    bl_idname = "swag.score_selection"
    bl_label = "PSNR Without Selection"
    job = "PSNR"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object has splats, and the job may start."""
        return may_start(cls, context, active_run(context)) and splats_are_active(cls, context)

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request with the selected splats."""
        self._folder = tempfile.TemporaryDirectory()  # until the operator ends
        return edit_score.request(present(context.scene), present(context.active_object), Path(self._folder.name))

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Say how it changes."""
        return edit_score.describe(event)


CLASSES = (SWAG_OT_score_selection,)
