"""The photos of a run without water: the engine's request, and their panel."""

from typing import Any

import bpy

from . import colors
from .blender_types import present
from .properties import swag_of
from .run_list import photographed_run, shown_run
from .sidebar import SwagPanel, draw_job, draw_outcome

JOB = "Restored photos"
"""Name of the job."""
FOLDER = "restored_photos"
"""Folder of the pictures in the folder of the run."""


def request(scene: bpy.types.Scene, obj: bpy.types.Object) -> dict[str, Any]:
    """The engine's request to write the photos of the run of a splat object without water, developed as in the scene.

    Raises:
        InputError: the splats are from no run.
    """
    run = photographed_run(obj)
    shown = colors.color_view(scene, obj).to_json()
    haze = swag_of(scene).haze
    return {"request": "restore", "run": str(run), "out": str(run / FOLDER), "colors": shown, "haze": haze}


class SWAG_PT_restored_photos(SwagPanel):
    """Panel of the photos without water."""

    bl_label = "Restored Photos"
    bl_parent_id = "SWAG_PT_colors"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a run."""
        return shown_run(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout = present(self.layout)
        if draw_job(layout, context, JOB):
            return
        layout.operator("swag.restore_photos", icon="IMAGE_DATA")
        draw_outcome(layout, context, JOB)


register, unregister = bpy.utils.register_classes_factory((SWAG_PT_restored_photos,))
