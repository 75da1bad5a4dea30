"""The water of the splats in Blender: remembered with each object, one slider for all, a panel."""

import json
from collections.abc import Sequence
from typing import Any

import bpy

from . import scene_import, splats
from .nodes import splat_preview, water_shader
from .water_values import WaterValues

KEY = "swag_water"  # on a splat object: its water per unit of its own space, as JSON


def remember_water(obj: bpy.types.Object, water: dict[str, Any] | None, metres_per_unit: float) -> None:
    """Give a splat object the water of its run (the contents of water.json; None for none) and the slider.

    A water network's table has no coefficients for the nodes and counts as none. metres_per_unit: of the run, for water
    per metre. Raises InputError where the water is damaged.
    """
    known = water is not None and "veil_sh" in water
    values = WaterValues.from_json(water, metres_per_unit) if known else WaterValues()
    if known:
        obj[KEY] = json.dumps(values.to_json())
    else:
        obj.pop(KEY, None)
    for name, value in values.inputs().items():
        splat_preview.set_input(obj, name, value)
    follow_slider(obj)
    if water_shader.GROUP_KEY in obj:
        node_group(obj)


def follow_slider(obj: bpy.types.Object) -> None:
    """Let the preview of a splat object take its amount of water from the slider of its scene."""
    path = splat_preview.input_path(obj, splat_preview.WATER)
    if path and obj.users_scene:
        water_shader.drive(obj, path, obj.users_scene[0])


def water_of(obj: bpy.types.Object | None) -> WaterValues | None:
    """The water of a splat object, None where it has none."""
    return WaterValues.from_json(json.loads(obj[KEY]), 0.0) if obj is not None and KEY in obj else None


def find(scene: bpy.types.Scene, active: bpy.types.Object | None) -> bpy.types.Object | None:
    """The splat object whose water is meant: the active one, else the scene's first that has any."""
    if active is not None and KEY in active:
        return active
    return next((obj for obj in scene.objects if KEY in obj and splats.is_splats(obj)), None)


def node_group(obj: bpy.types.Object) -> bpy.types.NodeTree:
    """The shader nodes of a splat object's water, which must have one."""
    return water_shader.node_group(obj, obj.users_scene[0], water_of(obj))


def set_world(scene: bpy.types.Scene, display_values: bool) -> None:
    """Let the scene's world be the open water of its splats, where they have a water."""
    if (obj := find(scene, None)) is not None:
        water_shader.set_world(scene, node_group(obj), display_values)


class SWAG_PT_water(bpy.types.Panel):
    bl_label = "Water"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "SWAG"
    bl_parent_id = "SWAG_PT_result"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return any(splats.is_splats(obj) for obj in context.scene.objects)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        obj = find(context.scene, context.active_object)
        values = water_of(obj)
        if values is None:
            layout.label(text="The splats have no fitted water.", icon="INFO")
        else:
            layout.prop(context.scene.swag, "water", slider=True)
            metres = metres_per_unit(obj)
            column = layout.column(align=True)
            column.label(text=f"Red, green, blue per {'metre' if metres else 'scene unit'}:")
            for name, betas in (("Lost", values.beta_D), ("Gained", values.beta_B)):
                row = column.split(factor=0.3)
                row.label(text=name)
                row.label(text=" ".join(f"{beta / (metres or 1):.3f}" for beta in betas))
            column = layout.column(align=True)
            column.operator("swag.water_objects", icon="MOD_OCEAN").remove = False
            column.operator("swag.water_objects", text="Take Out of the Water").remove = True
        row = layout.row(align=True)
        row.operator("swag.pick_scale", icon="EYEDROPPER")
        row.operator("swag.set_scale", text="Of Selected", icon="CON_DISTLIMIT")


class SWAG_PT_preview(bpy.types.Panel):
    bl_label = "Display"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "SWAG"
    bl_parent_id = "SWAG_PT_result"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        obj = context.active_object
        return splats.is_splats(obj) and splat_preview.modifier_of(obj) is not None

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        for name in splat_preview.SHOWN_INPUTS:
            splat_preview.draw_input(column, context.active_object, name)


def metres_per_unit(obj: bpy.types.Object) -> float:
    """Metres in a unit of the splats' own space; 0 where nobody said."""
    root = scene_import.find_root(obj) or obj
    return float(root.get(METRES_KEY, 0.0))


METRES_KEY = "swag_metres_per_unit"  # on a scene's root, or on splats without one


def set_metres_per_unit(top: bpy.types.Object, metres: float) -> None:
    """Scale a root, or splats without one, so that a Blender unit is a metre, about the world's origin."""
    factor = metres / top.matrix_world.median_scale
    top.matrix_world = _scaled(top.matrix_world, factor)
    for camera in top.children_recursive:
        if camera.type == "CAMERA":
            camera.data.clip_start *= factor
            camera.data.clip_end *= factor
    top[METRES_KEY] = metres


def _scaled(matrix: Any, factor: float) -> Sequence[Sequence[float]]:
    scaled = matrix.copy() * factor
    scaled[3] = (0.0, 0.0, 0.0, 1.0)
    return scaled


_CLASSES = (SWAG_PT_water, SWAG_PT_preview)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
