"""The node groups as an asset library."""

import os
from pathlib import Path

import addon_utils
import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import splats, water
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview
from pictures import new_camera, random_splats, render_pixel_centres

EXTENSION = "bl_ext.user_default.swag_splatting"
BACKGROUND = [[0.1 * k, 0.2, -0.1] for k in range(9)]
WATER = {
    "beta_D": [0.4, 0.2, 0.1],
    "beta_B": [0.3, 0.2, 0.1],
    "background_sh": BACKGROUND,
    "light": "linear",
    "per": "unit",
}


def names_of_nodes_and_materials():
    return [sorted(block.name for block in kind) for kind in (bpy.data.node_groups, bpy.data.materials)]


def render_through_the_group():
    """Render a wall whose light goes through the water group at a distance of 5, without and with water."""
    scene = bpy.context.scene
    new_camera()
    scene.render.resolution_x = scene.render.resolution_y = 5
    bpy.ops.mesh.primitive_plane_add(size=50, location=(0, 0, -5))
    wall = bpy.data.materials.new("wall")
    wall.use_nodes = True
    wall.node_tree.nodes.clear()
    kinds = ("ShaderNodeGroup", "ShaderNodeEmission", "ShaderNodeOutputMaterial")
    group, emission, output = (wall.node_tree.nodes.new(kind) for kind in kinds)
    group.node_tree = bpy.data.node_groups["SWAG Water"]
    group.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1)
    wall.node_tree.links.new(group.outputs["Color"], emission.inputs["Color"])
    wall.node_tree.links.new(emission.outputs[0], output.inputs["Surface"])
    bpy.context.object.data.materials.append(wall)
    splat_preview.prepare_render(scene, display_values=False)
    for amount in (0.0, 1.0):
        group.inputs["Amount"].default_value = amount
        color = render_pixel_centres()[2, 2, :3]
        transmission, gained = (np.exp(-np.array(WATER[beta]) * 5 * amount) for beta in ("beta_D", "beta_B"))
        basis = np.array([0.28209479, 0, -0.48860251, 0, 0, 0, 0.63078313, 0, 0])
        background = 1 / (1 + np.exp(-basis @ np.array(BACKGROUND)))
        expected = 0.5 * transmission + amount * background * (1 - gained)
        assert np.allclose(color, expected, atol=1e-3), (amount, color, expected)


def write_use_and_remove():
    libraries = bpy.context.preferences.filepaths.asset_libraries
    before = [(library.name, library.path) for library in libraries]
    obj = splats.new_splat_object("one", random_splats(5, 1), bpy.context.scene.collection)
    water.remember_water(obj, WATER, 0.0)
    blocks = names_of_nodes_and_materials()
    for _ in range(2):  # the second call replaces the library of the first
        bpy.ops.swag.node_assets()
    assert names_of_nodes_and_materials() == blocks
    assert not any(group.asset_data for group in bpy.data.node_groups)
    listed = [library for library in libraries if library.name == "SWAG Splatting"]
    assert len(listed) == 1 and len(libraries) == len(before) + 1
    (path,) = Path(listed[0].path).glob("*.blend")
    assert Path(os.environ["BLENDER_USER_RESOURCES"]) in path.parents

    # The groups in another file.
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(path), assets_only=True) as (there, here):
        native = ["SWAG Native Splats"] if splat_preview.HAS_NATIVE else []
        assert sorted(there.node_groups) == [*native, "SWAG Splat Preview", "SWAG Water"], there.node_groups
        here.node_groups = list(there.node_groups)
    obj = splats.new_splat_object("one", random_splats(5, 1), bpy.context.scene.collection)
    assert obj.modifiers[0].node_group in here.node_groups and len(bpy.data.materials) == 3
    items = bpy.data.node_groups["SWAG Water"].interface.items_tree
    inputs = {item.name: item.default_value for item in items if item.in_out == "INPUT"}
    assert np.allclose(inputs["Attenuation"], [0.4, 0.2, 0.1]) and np.allclose(
        inputs["Background Light 8"], BACKGROUND[8]
    )
    obj.hide_render = True
    render_through_the_group()

    addon_utils.disable(EXTENSION)
    assert [(library.name, library.path) for library in libraries] == before
    addon_utils.enable(EXTENSION)
    assert len(libraries) == len(before) + 1
    bpy.ops.swag.node_assets(remove=True)
    assert not path.exists() and [(library.name, library.path) for library in libraries] == before
