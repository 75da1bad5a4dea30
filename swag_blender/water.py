"""The fitted water of splats in Blender: stored with each object, one slider for all, its panels."""

import json
from collections.abc import Iterable
from typing import Any, cast

import bpy

from ..swag_engine.splats.haze import haze_amount
from . import splats
from .blender_types import present, set_button
from .nodes import splat_colors, splat_preview, water_shader
from .properties import swag_of
from .scale import metres_per_unit
from .sidebar import SwagPanel, draw_wrapped
from .water_values import WaterValues

KEY = "swag_medium"
"""Property of a splat object: its water per unit of its own space, as JSON."""


def remember_water(obj: bpy.types.Object, water: dict[str, Any] | None, metres_per_unit: float) -> None:
    """Store the water of a run with its splat object, and let the slider drive the object's preview.

    Args:
        obj: a splat object.
        water: the contents of water.json; None for none. The table of a water network has no coefficients for the
            nodes: the splats are shown without it, over black, as the engine renders them without water.
        metres_per_unit: of the run, for water per metre.

    Raises:
        InputError: the water is damaged.
    """
    if water is not None and "background_sh" in water:
        values = WaterValues.from_json(water, metres_per_unit)
        obj[KEY] = json.dumps(values.to_json())
    else:
        values = WaterValues()
        obj.pop(KEY, None)
        if water is not None:  # a network, whose background goes with its water
            obj[splat_preview.BACKGROUND_KEY] = (0.0, 0.0, 0.0)
    for name, value in values.inputs().items():
        splat_preview.set_input(obj, name, value)
    follow_slider(obj)
    if obj.get(water_shader.GROUP_KEY) is not None:
        node_group(obj)


def follow_slider(obj: bpy.types.Object) -> None:
    """Let the sliders of its scene drive the amounts of water and haze in the preview of a splat object."""
    for name, slider in ((splat_colors.WATER, "swag.water"), (splat_colors.HAZE, "swag.haze")):
        path = splat_preview.input_path(obj, name)
        if path and obj.users_scene:
            water_shader.drive(obj, path, obj.users_scene[0], slider=slider)


def shown_haze(scene: bpy.types.Scene, water: float | None = None) -> float:
    """Fraction of the haze in open water that is shown, 0..1.

    Args:
        scene: its sliders count.
        water: fraction of the water that is shown; by default that of the slider.
    """
    swag = swag_of(scene)
    return haze_amount(swag.water if water is None else water, swag.haze)


def water_of(obj: bpy.types.Object | None) -> WaterValues | None:
    """The water of a splat object; None where it has none."""
    stored = obj.get(KEY) if obj is not None else None
    return None if stored is None else WaterValues.from_json(json.loads(stored), 0.0)


def find(scene: bpy.types.Scene, active: bpy.types.Object | None) -> bpy.types.Object | None:
    """The active object if it has a water, else the scene's first splat object that has one."""
    return splats.find_with(scene, active, KEY)


def node_group(obj: bpy.types.Object) -> bpy.types.NodeTree:
    """The shader nodes of the water of a splat object that has one."""
    return water_shader.node_group(obj, obj.users_scene[0], present(water_of(obj)))


def objects_with_materials(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The selected objects that can be shown through the water: those with materials that are no splats."""
    return [obj for obj in context.selected_objects if hasattr(obj.data, "materials") and not splats.is_splats(obj)]


def add_to_objects(objects: Iterable[bpy.types.Object], source: bpy.types.Object) -> int:
    """Show objects through the water of a splat object; returns the number of their materials that have it now.

    Objects without a material get one.
    """
    for obj in objects:
        if not any(slot.material for slot in obj.material_slots):
            made = bpy.data.materials.new(obj.name)
            made.use_nodes = True
            cast(Any, obj.data).materials.append(made)
    materials = _materials(objects)
    for material in materials:
        material.use_nodes = True
        water_shader.add_water(material, node_group(source))
    return sum(water_shader.has_water(material) for material in materials)


def remove_from_objects(objects: Iterable[bpy.types.Object]) -> int:
    """Remove the water from the materials of objects; returns the number of materials that had it."""
    materials = [material for material in _materials(objects) if material.node_tree]
    return sum(water_shader.remove_water(material) for material in materials)


def _materials(objects: Iterable[bpy.types.Object]) -> set[bpy.types.Material]:
    return {slot.material for obj in objects for slot in obj.material_slots if slot.material}


def _draw_haze(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Draw the slider of the haze where splats have any."""
    shown = [splats.pointcloud_of(obj) for obj in scene.objects if splats.is_splats(obj)]
    if any(splat_colors.HAZE_SCORE in pointcloud.attributes for pointcloud in shown):
        layout.prop(swag_of(scene), "haze", slider=True)


class SWAG_PT_water(SwagPanel):
    """Panel of the fitted water: slider, coefficients, water for other objects."""

    bl_label = "Water"
    bl_parent_id = "SWAG_PT_result"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, scene = present(self.layout), present(context.scene)
        obj = find(scene, context.active_object)
        values = water_of(obj)
        if obj is None or values is None:
            draw_wrapped(
                layout,
                "These splats have no water. It comes with the run that trained them: press Open Run in Result.",
                present(context.region).width,
                icon="INFO",
            )
            _draw_haze(layout, scene)
        else:
            layout.prop(swag_of(scene), "water", slider=True)
            _draw_haze(layout, scene)
            header, body = layout.panel("swag_water_values", default_closed=True)
            header.label(text="Water Values")
            if body is None:
                return
            layout = body
            metres = metres_per_unit(obj)
            column = layout.column(align=True)
            column.label(text=f"Red, green, blue per {'metre' if metres else 'scene unit'}:")
            for name, betas in (("Attenuation", values.beta_D), ("Backscatter", values.beta_B)):
                row = column.split(factor=0.4)
                row.label(text=name)
                row.label(text=" ".join(f"{beta / (metres or 1):.3f}" for beta in betas))
            column = layout.column(align=True)
            set_button(column.operator("swag.water_objects", icon="MOD_OCEAN"), remove=False)
            set_button(column.operator("swag.water_objects", text="Remove Water from Objects"), remove=True)


register, unregister = bpy.utils.register_classes_factory((SWAG_PT_water,))
