"""Label the run of the splats."""

from typing import Any

import bpy

from ..swag_blender import labels
from ..swag_blender.blender_types import present, with_properties
from ..swag_blender.job import Job, may_start
from ..swag_blender.labelling import label_request, take_run_labels
from ..swag_blender.operator_base import active_run, splats_are_active


@with_properties
class SWAG_OT_label_run(Job):
    """Give every splat of the run a label: from your masks, from words or from salient regions"""

    bl_idname = "swag.label_run"
    bl_label = "Label"
    job = "Labelling"

    source: labels.Source
    words: labels.Words
    masks: labels.Masks
    download: labels.Download

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object has splats, and the job may start."""
        return may_start(cls, context, active_run(context)) and splats_are_active(cls, context)

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request for the run of the splats."""
        obj = present(context.active_object)
        request = label_request(context, obj, self.source, self.words, self.masks, self.download)
        self._object, self._run = obj.name, request["run"]
        return request

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Give the splats their labels."""
        return take_run_labels(self._object, self._run, event)


CLASSES = (SWAG_OT_label_run,)
