"""Give a scene its scale in metres, from a distance that the user knows."""

import bpy
import numpy as np
from bpy.props import FloatProperty, FloatVectorProperty
from bpy_extras import view3d_utils
from mathutils import Vector

from ..swag_blender import scene_import, splats, water

# A click takes the nearest splat to the eye among those this near, in pixels.
REACH = 12.0
# What is fainter is hardly seen, and not meant.
LEAST_OPACITY = 0.3


class SWAG_OT_set_scale(bpy.types.Operator):
    """Scale the scene to metres by the distance between two selected objects, such as cameras, or two points"""

    bl_idname = "swag.set_scale"
    bl_label = "Set Scale"
    bl_options = {"REGISTER", "UNDO"}

    distance: FloatProperty(
        name="Distance", description="Between the two, in metres", default=1.0, min=1e-4, soft_max=100, precision=3
    )
    start: FloatVectorProperty(name="From", size=3, options={"HIDDEN", "SKIP_SAVE"})
    end: FloatVectorProperty(name="To", size=3, options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("There is no imported scene and no splats; or several, and none of them is selected")
        return _top(context) is not None

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self)

    def execute(self, context: bpy.types.Context) -> set[str]:
        ends = [Vector(self.start), Vector(self.end)]
        if not self.properties.is_property_set("start"):
            ends = [obj.matrix_world.translation for obj in context.selected_objects]
        if len(ends) != 2 or (ends[0] - ends[1]).length < 1e-9:
            self.report({"ERROR"}, "Select two objects that stand apart, such as two cameras, or pick two points.")
            return {"CANCELLED"}
        top = _top(context)
        metres = top.matrix_world.median_scale * self.distance / (ends[0] - ends[1]).length
        water.set_metres_per_unit(top, metres)
        context.scene.swag.metres_per_unit = metres
        context.scene.unit_settings.system = "METRIC"
        self.report({"INFO"}, f"A unit of the photographs' scene is {metres:.4g} m; a Blender unit is a metre now.")
        return {"FINISHED"}


class SWAG_OT_pick_scale(bpy.types.Operator):
    """Click two points of the splats whose distance you know; the scene is then scaled to metres"""

    bl_idname = "swag.pick_scale"
    bl_label = "Pick Two Points"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return SWAG_OT_set_scale.poll(context) and context.area is not None and context.area.type == "VIEW_3D"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self._picked: list[Vector] = []
        context.window_manager.modal_handler_add(self)
        context.window.cursor_modal_set("EYEDROPPER")
        self._tell(context)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            return self._end(context, {"CANCELLED"})
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"PASS_THROUGH"}
        region = next(region for region in context.area.regions if region.type == "WINDOW")
        mouse = Vector((event.mouse_x - region.x, event.mouse_y - region.y))
        point = splat_under(context, region, mouse)
        if point is None:
            self.report({"WARNING"}, "There is no splat here.")
            return {"RUNNING_MODAL"}
        self._picked.append(point)
        context.scene.cursor.location = point  # shows what was picked
        self._tell(context)
        if len(self._picked) < 2:
            return {"RUNNING_MODAL"}
        bpy.ops.swag.set_scale("INVOKE_DEFAULT", start=self._picked[0], end=self._picked[1])
        return self._end(context, {"FINISHED"})

    def cancel(self, context: bpy.types.Context) -> None:
        self._end(context, set())

    def _tell(self, context: bpy.types.Context) -> None:
        which = ("first", "second", "second")[len(self._picked)]
        context.workspace.status_text_set(f"Click the {which} of two points whose distance you know; Escape: stop")

    def _end(self, context: bpy.types.Context, result: set[str]) -> set[str]:
        context.workspace.status_text_set(None)
        context.window.cursor_modal_restore()
        return result


def splat_under(context: bpy.types.Context, region: bpy.types.Region, mouse: Vector) -> Vector | None:
    """The splat nearest the eye within REACH pixels of `mouse` (in the region), in the world; None where none is."""
    view = context.space_data.region_3d
    eye, along = (
        f(region, view, mouse) for f in (view3d_utils.region_2d_to_origin_3d, view3d_utils.region_2d_to_vector_3d)
    )
    perspective = np.array(view.perspective_matrix, np.float64)
    best, found = np.inf, None
    for obj in context.visible_objects:
        if not splats.is_splats(obj):
            continue
        held = splats.read_splats(obj)
        world = held.positions @ np.array(obj.matrix_world, np.float64)[:3, :3].T + np.array(
            obj.matrix_world.translation, np.float64
        )
        clip = world @ perspective[:, :3].T + perspective[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = (clip[:, :2] / clip[:, 3:] * 0.5 + 0.5) * (region.width, region.height)
        depth = (world - np.array(eye)) @ np.array(along)
        near = np.linalg.norm(pixels - np.array(mouse), axis=1) < REACH
        near &= (clip[:, 3] > 0) & (depth > 0) & (held.opacities > LEAST_OPACITY)
        if near.any() and depth[near].min() < best:
            index = np.flatnonzero(near)[depth[near].argmin()]
            best, found = depth[index], Vector(world[index])
    return found


def _top(context: bpy.types.Context) -> bpy.types.Object | None:
    """What is scaled: the root of the scene, else the splats alone."""
    if root := scene_import.active_root(context):
        return root
    if splats.is_splats(context.active_object):
        return context.active_object
    alone = [obj for obj in context.scene.objects if splats.is_splats(obj)]
    return alone[0] if len(alone) == 1 else None


CLASSES = (SWAG_OT_set_scale, SWAG_OT_pick_scale)
