"""Mark the corners of a color chart in a photo, and have the engine read its patches there."""

import contextlib

import bpy
from bpy_extras.view3d_utils import region_2d_to_origin_3d, region_2d_to_vector_3d
from mathutils import Vector

from ..swag_blender import color_chart, scene_import, splats
from ..swag_blender.blender_types import OperatorResult, call_operator, present
from ..swag_blender.cameras import camera_of
from ..swag_blender.engine_process import engine_problem
from ..swag_blender.picking import splat_objects
from ..swag_blender.run_list import shown_run
from ..swag_blender.viewport_tool import Pixel, ViewportTool

CORNERS = 4


class SWAG_OT_mark_color_chart(ViewportTool):
    """Look through the camera of a photo and click the outer corners of the four corner patches, around the chart"""

    bl_idname = "swag.mark_color_chart"
    bl_label = "Mark Color Chart"
    bl_options = {"REGISTER"}
    hint = "Click the outer corners of the chart's four corner patches, going around it; Escape: cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a run and the engine, and a photo's camera is selected or looked through."""
        if shown_run(context) is None:
            cls.poll_message_set("Select an object with splats of a run first")
            return False
        if context.area is None or context.area.type != "VIEW_3D" or _photo_camera(context) is None:
            cls.poll_message_set("Select the camera of a photo that shows the chart, or look through it")
            return False
        if problem := engine_problem():
            cls.poll_message_set(problem)
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Look through the camera and show its photo instead of splats."""
        self._camera, self._run = present(_photo_camera(context)), present(shown_run(context))
        scene_import.look_through(present(context.scene), self._camera)
        present(context.region_data).view_perspective = "CAMERA"
        data = self._camera.data
        assert isinstance(data, bpy.types.Camera)
        self._photos = [(photo, photo.alpha, photo.display_depth) for photo in data.background_images]
        for photo, _, _ in self._photos:
            photo.alpha, photo.display_depth = 1.0, "FRONT"
        # Splats are drawn over photos, too.
        self._hidden = splat_objects(context)
        for obj in self._hidden:
            obj.hide_set(True)
        self._corners: list[tuple[float, float]] = []
        self._marks: list[Vector] = []
        return super().invoke(context, event)

    def on_event(
        self, context: bpy.types.Context, event: bpy.types.Event, region: bpy.types.Region, position: Pixel
    ) -> OperatorResult:
        """Set a corner by a click; the fourth ends the tool and has the chart read."""
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"PASS_THROUGH"}
        view = present(context.region_data)
        ray = region_2d_to_vector_3d(region, view, position)
        width, height, aspect = self._camera[scene_import.SIZE_KEY]
        camera = camera_of(self._camera, context.evaluated_depsgraph_get(), int(width), int(height), aspect)
        if (place := color_chart.position_in_photo(camera, ray)) is None:
            self.report({"WARNING"}, "Click inside the photo.")
            return {"RUNNING_MODAL"}
        self._corners.append(place)
        self._marks.append(region_2d_to_origin_3d(region, view, position) + ray)
        self.overlay.segments = [self._marks]
        if len(self._corners) < CORNERS:
            return {"RUNNING_MODAL"}
        self.on_end()
        splats.select_only(context, [self._run])
        call_operator(
            "find_color_chart", "INVOKE_DEFAULT", marked=color_chart.marked_corners(self._camera, self._corners)
        )
        return {"FINISHED"}

    def on_end(self) -> None:
        """Show the scene as before."""
        # Another file may have been opened.
        with contextlib.suppress(ReferenceError):
            for photo, alpha, depth in self._photos:
                photo.alpha, photo.display_depth = alpha, depth
            for obj in self._hidden:
                obj.hide_set(False)


def _photo_camera(context: bpy.types.Context) -> bpy.types.Object | None:
    """The selected camera of a photo, else the one that the viewport looks through; None without."""
    active, view = context.active_object, context.region_data
    if active is not None and active.get(scene_import.SIZE_KEY) is not None:
        return active
    camera = present(context.scene).camera
    looks = view is not None and view.view_perspective == "CAMERA"
    return camera if looks and camera is not None and camera.get(scene_import.SIZE_KEY) is not None else None


CLASSES = (SWAG_OT_mark_color_chart,)
