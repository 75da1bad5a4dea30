"""Train the scene's photos; the splats appear during the training."""

from typing import Annotated, Any

import bpy
from bpy.props import BoolProperty

from ..swag_blender.blender_types import present, with_properties
from ..swag_blender.job import Job, can_work_on_photos
from ..swag_blender.training import Training


@with_properties
class SWAG_OT_train(Job):
    """Train 3D Gaussians on the photos; Cancel stops and keeps the result so far"""

    bl_idname = "swag.train"
    bl_label = "Train"
    job = "Training"
    heavy = True

    resume: Annotated[
        bool,
        BoolProperty(
            name="Continue", description="Continue the run in the run folder where it stopped", options={"SKIP_SAVE"}
        ),
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether photos are chosen, the engine is there, and the job may start."""
        return can_work_on_photos(cls, context)

    @classmethod
    def description(cls, context: bpy.types.Context, properties: Any) -> str:
        """Tooltip, another one for Continue; Blender calls this."""
        if properties.resume:
            return "Continue the run where it stopped, with the settings it was started with"
        return present(cls.__doc__)

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request for the training."""
        self._training = Training(context, self.resume)
        return self._training.request

    def on_event(self, context: bpy.types.Context, event: dict[str, Any]) -> None:
        """Start to read a preview; without a window nobody would see it."""
        if event["event"] == "preview" and not bpy.app.background:
            self._training.read_preview(event)

    def on_timer(self, context: bpy.types.Context) -> None:
        """Show the preview once it is read."""
        self._training.show_preview(context)

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Show the result."""
        return self._training.show_result(context, event)


CLASSES = (SWAG_OT_train,)
