"""Mark the corners of a color chart in a photo, and have the engine read its patches there."""

import contextlib

import bpy
from bpy_extras.view3d_utils import region_2d_to_vector_3d

from ..swag_blender import color_chart, scene_import, splats
from ..swag_blender.blender_types import OperatorResult, call_operator, present
from ..swag_blender.cameras import camera_of
from ..swag_blender.engine_process import engine_problem
from ..swag_blender.run_list import shown_run

CORNERS = ("first", "second", "third", "last")


class SWAG_OT_mark_color_chart(bpy.types.Operator):
    """Look through the camera of a photo and click the outer corners of the four corner patches, around the chart"""

    bl_idname = "swag.mark_color_chart"
    bl_label = "Mark Color Chart"
    bl_options = {"REGISTER"}

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
        """Look through the camera, show its photo in front of all else, and wait for four clicks."""
        self._camera, self._run = present(_photo_camera(context)), present(shown_run(context))
        scene_import.look_through(present(context.scene), self._camera)
        present(context.region_data).view_perspective = "CAMERA"
        data = self._camera.data
        assert isinstance(data, bpy.types.Camera)
        self._photos = [(photo, photo.alpha, photo.display_depth) for photo in data.background_images]
        for photo, _, _ in self._photos:
            photo.alpha, photo.display_depth = 1.0, "FRONT"
        # Splats are drawn over photos, too.
        self._hidden = [obj for obj in context.visible_objects if splats.is_splats(obj)]
        for obj in self._hidden:
            obj.hide_set(True)
        self._corners: list[tuple[float, float]] = []
        present(context.window_manager).modal_handler_add(self)
        present(context.window).cursor_modal_set("CROSSHAIR")
        self._show_step(context)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Handle clicks and Escape; Blender calls this for every event, and navigation is left to the viewport."""
        if event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            return self._end(context, {"CANCELLED"})
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"PASS_THROUGH"}
        region = next(region for region in present(context.area).regions if region.type == "WINDOW")
        ray = region_2d_to_vector_3d(
            region, present(context.region_data), (event.mouse_x - region.x, event.mouse_y - region.y)
        )
        width, height, aspect = self._camera[scene_import.SIZE_KEY]
        camera = camera_of(self._camera, context.evaluated_depsgraph_get(), int(width), int(height), aspect)
        if (place := color_chart.position_in_photo(camera, ray)) is None:
            self.report({"WARNING"}, "Click inside the photo.")
            return {"RUNNING_MODAL"}
        self._corners.append(place)
        if len(self._corners) < len(CORNERS):
            self._show_step(context)
            return {"RUNNING_MODAL"}
        self._end(context, set())
        splats.select_only(context, [self._run])
        call_operator(
            "find_color_chart", "INVOKE_DEFAULT", marked=color_chart.marked_corners(self._camera, self._corners)
        )
        return {"FINISHED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """End; Blender calls this when it removes the operator, also when it opens another file."""
        with contextlib.suppress(ReferenceError):
            self._end(context, set())

    def _show_step(self, context: bpy.types.Context) -> None:
        present(context.workspace).status_text_set(
            f"Click the {CORNERS[len(self._corners)]} outer corner of the chart's corner patches, going around it; "
            "Escape: cancel"
        )

    def _end(self, context: bpy.types.Context, result: OperatorResult) -> OperatorResult:
        for photo, alpha, depth in self._photos:
            photo.alpha, photo.display_depth = alpha, depth
        for obj in self._hidden:
            obj.hide_set(False)
        present(context.workspace).status_text_set(None)
        present(context.window).cursor_modal_restore()
        return result


def _photo_camera(context: bpy.types.Context) -> bpy.types.Object | None:
    """The selected camera of a photo, else the one that the viewport looks through; None without."""
    active, view = context.active_object, context.region_data
    if active is not None and active.get(scene_import.SIZE_KEY) is not None:
        return active
    camera = present(context.scene).camera
    looks = view is not None and view.view_perspective == "CAMERA"
    return camera if looks and camera is not None and camera.get(scene_import.SIZE_KEY) is not None else None


CLASSES = (SWAG_OT_mark_color_chart,)
