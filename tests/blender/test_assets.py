"""The node groups as an asset library."""

from tests.blender.splat_pictures import SETUP


def test_node_groups_are_assets_of_a_library(blender, tmp_path):
    """Written, listed, of use in another file; gone from the preferences with the extension."""
    blender.run(
        SETUP
        + """
import addon_utils, os
from pathlib import Path
from bl_ext.user_default.swag_splatting.swag_blender import assets, water
libraries = bpy.context.preferences.filepaths.asset_libraries
before = [(one.name, one.path) for one in libraries]
obj = splats.new_splat_object("one", random_splats(5, 1), scene.collection)
veil = [[0.1 * k, 0.2, -0.1] for k in range(9)]
water.remember_water(obj, {"beta_D": [0.4, 0.2, 0.1], "beta_B": [0.3, 0.2, 0.1], "veil_sh": veil, "light": "linear",
                           "per": "unit"}, 0.0)
blocks = lambda: [sorted(b.name for b in kind) for kind in (bpy.data.node_groups, bpy.data.materials)]
kept = blocks()
for _ in range(2):  # the second time in place of the first
    bpy.ops.swag.node_assets()
assert blocks() == kept and not any(group.asset_data for group in bpy.data.node_groups)
listed = [one for one in libraries if one.name == "SWAG Splatting"]
assert len(listed) == 1 and len(libraries) == len(before) + 1
path, = Path(listed[0].path).glob("*.blend")
assert Path(os.environ["BLENDER_USER_RESOURCES"]) in path.parents

# In another file.
bpy.ops.wm.read_homefile(use_empty=True)
scene = bpy.context.scene
with bpy.data.libraries.load(str(path), assets_only=True) as (there, here):
    assert sorted(there.node_groups) == ["SWAG Splat Preview", "SWAG Water"], there.node_groups
    here.node_groups = list(there.node_groups)
obj = splats.new_splat_object("one", random_splats(5, 1), scene.collection)
assert obj.modifiers[0].node_group in here.node_groups and len(bpy.data.materials) == 3
items = bpy.data.node_groups["SWAG Water"].interface.items_tree
inputs = {item.name: item.default_value for item in items if item.in_out == "INPUT"}
assert np.allclose(inputs["Attenuation"], [0.4, 0.2, 0.1]) and np.allclose(inputs["Background Light 8"], veil[8])

# A wall of light, seen through it at a distance of 5.
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
scene.camera, scene.render.resolution_x, scene.render.resolution_y = camera, 5, 5
bpy.ops.mesh.primitive_plane_add(size=50, location=(0, 0, -5))
wall = bpy.data.materials.new("wall")
wall.use_nodes = True
wall.node_tree.nodes.clear()
group, emission, output = (wall.node_tree.nodes.new(kind) for kind in (
    "ShaderNodeGroup", "ShaderNodeEmission", "ShaderNodeOutputMaterial"))
group.node_tree = bpy.data.node_groups["SWAG Water"]
group.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1)
wall.node_tree.links.new(group.outputs["Color"], emission.inputs["Color"])
wall.node_tree.links.new(emission.outputs[0], output.inputs["Surface"])
bpy.context.object.data.materials.append(wall)
splat_preview.prepare_render(scene, display_values=False)
obj.hide_render = True
for amount in (0.0, 1.0):
    group.inputs["Amount"].default_value = amount
    seen = point_sampled(5, 5)[2, 2, :3]
    left, gained = (np.exp(-np.array(beta) * 5 * amount) for beta in ([0.4, 0.2, 0.1], [0.3, 0.2, 0.1]))
    z = np.array(veil) * np.array([0.28209479, 0, -0.48860251, 0, 0, 0, 0.63078313, 0, 0])[:, None]
    expected = 0.5 * left + amount / (1 + np.exp(-z.sum(axis=0))) * (1 - gained)
    assert np.allclose(seen, expected, atol=1e-3), (amount, seen, expected)

addon_utils.disable(EXTENSION)
assert [(one.name, one.path) for one in libraries] == before
addon_utils.enable(EXTENSION)
assert len(libraries) == len(before) + 1
bpy.ops.swag.node_assets(remove=True)
assert not path.exists() and [(one.name, one.path) for one in libraries] == before
""",
        tmp_path,
    )
