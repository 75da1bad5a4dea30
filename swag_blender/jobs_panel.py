"""The panel of all jobs that run, above the others in the sidebar."""

import bpy

from .blender_types import present
from .properties import status_of
from .sidebar import SwagPanel, draw_cancel, draw_outcome

INSTALLATION = "Installation"
"""Job that is started in the Preferences, which may be closed at its end."""


class SWAG_PT_jobs(SwagPanel):
    """Panel of the jobs that run, and of how the installation of the engine ended."""

    bl_label = "Running"
    bl_order = 0

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a job runs, or the last one was the installation of the engine."""
        status = status_of(context)
        return bool(status.running) or any(job.name == INSTALLATION for job in status.jobs[-1:])

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, status = present(self.layout), status_of(context)
        for job in status.running:
            row = layout.row(align=True)
            row.progress(factor=job.factor, text=f"{job.name}: {job.shown_text}")
            draw_cancel(row, job, text="")
        if not status.running:
            draw_outcome(layout, context, INSTALLATION)


register, unregister = bpy.utils.register_classes_factory((SWAG_PT_jobs,))
