"""The fitted water in Blender, on splats, behind them and before ordinary objects, against the engine's formula."""

import json

import numpy as np
import pytest

from tests.blender.splat_pictures import SETUP, drawn_by_the_engine, heap, psnr

WIDTH, HEIGHT, FOCAL = 96, 60, 90.0
MORE = """
from bl_ext.user_default.swag_splatting.swag_blender import water
"""


@pytest.fixture(scope="module", params=["linear", "srgb"])
def sea(request):
    """A water whose colour changes with the direction, as a run writes it, and as the engine computes it."""
    import torch

    from swag_engine.water.medium import Medium

    medium = Medium.starting(
        4.0, request.param, torch.tensor([0.20, 0.07, 0.04]), torch.tensor([0.15, 0.10, 0.08]),
        torch.tensor([0.05, 0.25, 0.4]),
    )  # fmt: skip
    medium.veil[1:] = torch.randn(8, 3, generator=torch.Generator().manual_seed(1)) * 0.5
    return medium


def through(sea, display, offsets, amount=1.0):
    import torch

    from swag_engine.water.medium import through_water

    colors, offsets = torch.tensor(display).float(), torch.tensor(offsets).float()
    return through_water(colors, offsets, sea, amount=amount, backend="torch").detach().numpy()


def test_splats_and_open_water_are_the_engines(blender, sea, tmp_path):
    """The slider's amount reaches the picture: colours of splats, and what is behind them."""
    amount = 0.7
    np.savez(tmp_path / "heap.npz", **heap())
    (tmp_path / "water.json").write_text(json.dumps(sea.to_json()))
    blender.run(
        SETUP
        + MORE
        + f"""
view({WIDTH}, {HEIGHT}, {FOCAL})
root = bpy.data.objects["root"]
obj = splats.new_splat_object("heap", saved(sys.argv[1]), scene.collection, root)
root.rotation_euler, root.location, root.scale = (0.3, -0.2, 0.7), (3, 1, -2), (2, 2, 2)
splat_preview.remember_training(obj, 1 / {FOCAL}, [0, 0, 0])
water.remember_water(obj, json.load(open(sys.argv[2])), 0.0)
scene.swag.water = {amount}
bpy.ops.swag.prepare_render(display_values=True)
render = point_sampled({WIDTH}, {HEIGHT}, transparent=False)
np.save(sys.argv[-1] + "/render.npy", render)
        """,
        tmp_path / "heap.npz",
        tmp_path / "water.json",
        tmp_path,
    )
    import torch

    from swag_engine.water.medium import open_water

    color, alpha = drawn_by_the_engine(
        heap(), WIDTH, HEIGHT, FOCAL, lambda colors, offsets: through(sea, colors, offsets, amount)
    )
    K = torch.tensor([[FOCAL, 0, WIDTH / 2 - 3], [0, FOCAL, HEIGHT / 2 + 2], [0, 0, 1]])
    behind = open_water(sea, torch.eye(4), K, WIDTH, HEIGHT, amount=amount, backend="torch").detach().numpy()
    render = np.load(tmp_path / "render.npy")[..., :3]
    expected = color + (1 - alpha[..., None]) * behind
    print(psnr(render, expected))
    assert psnr(render, expected) > 55


@pytest.mark.main_version
def test_objects_stand_in_the_same_water(blender, sea, tmp_path):
    """A glowing and a lit wall, near and far: their light without water, taken through the engine's formula.

    Light is exact to 2e-3 where the shader has the colour in hand. A lit surface is exact to that in a water of light,
    and to .06 of a display value in one of display values, which no renderer can apply to light to be found.
    """
    (tmp_path / "water.json").write_text(json.dumps(sea.to_json()))
    blender.run(
        SETUP
        + MORE
        + """
from mathutils import Euler, Matrix
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
scene.camera = camera
obj = splats.new_splat_object("splats", random_splats(1, 1), scene.collection)
# The splats' own space: turned, and a unit of it is two of Blender's. Out of the picture.
obj.matrix_world = Matrix.LocRotScale((0, 0, 50), Euler((0.4, 1.1, -0.6)), (2, 2, 2))
water.remember_water(obj, json.load(open(sys.argv[1])), 0.0)
scene.swag.water = 1
bpy.ops.swag.prepare_render(display_values=False)
lamp = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
lamp.data.energy = 2
scene.collection.objects.link(lamp)
walls = []
for distance in (2.0, 9.0):
    for shading, x in (("ShaderNodeBsdfDiffuse", -0.3), ("ShaderNodeEmission", 0.3)):
        bpy.ops.mesh.primitive_plane_add(size=0.5 * distance, location=(x * distance, 0.15 * distance, -distance))
        wall = bpy.context.object
        material = bpy.data.materials.new("wall")
        material.use_nodes = True
        wall.data.materials.append(material)
        tree = material.node_tree
        tree.nodes.remove(tree.nodes["Principled BSDF"])
        node = tree.nodes.new(shading)
        node.inputs["Color"].default_value = (0.6, 0.3, 0.1, 1)
        tree.links.new(node.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
        walls.append(wall)
shown = {}
def photographs(name):
    for distance, pair in ((2, walls[:2]), (9, walls[2:])):
        for wall in walls:
            wall.hide_render = wall not in pair
        shown[f"{name}{distance}"] = point_sampled(32, 32)
scene.render.resolution_x = scene.render.resolution_y = 32
photographs("dry")
for wall in walls:
    wall.select_set(True)
assert bpy.ops.swag.water_objects() == {"FINISHED"}
photographs("wet")
assert bpy.ops.swag.water_objects() == {"FINISHED"}
assert len(walls[0].active_material.node_tree.nodes) == 6, "a second call puts nothing twice"
assert bpy.ops.swag.water_objects(remove=True) == {"FINISHED"}
photographs("again")
turn = np.array(obj.matrix_world.to_3x3().normalized())
np.savez(sys.argv[-1] + "/shown.npz", turn=turn, angle=camera.data.angle_x, **shown)
        """,
        tmp_path / "water.json",
        tmp_path,
    )
    import torch

    from swag_engine.kernels.reference.transfer import to_display, to_light

    held = np.load(tmp_path / "shown.npz")
    steps = (np.arange(32) + 0.5 - 16) / 16 * np.tan(held["angle"] / 2)
    x, y = np.meshgrid(steps, -steps)
    for distance in (2, 9):
        dry, wet, again = (held[f"{name}{distance}"] for name in ("dry", "wet", "again"))
        wall = dry[..., 3] > 0
        assert np.array_equal(dry, again)
        # From the camera at the origin to the wall, in the splats' own space.
        offsets = distance * np.stack([x, y, -np.ones_like(x)], axis=-1)[wall] @ held["turn"] / 2
        light = torch.tensor(dry[wall][:, :3])
        expected = through(sea, to_display(light).numpy(), offsets)
        error = np.abs(to_display(torch.tensor(wet[wall][:, :3])).numpy() - expected)
        assert np.abs(to_light(torch.tensor(expected)).numpy() - light.numpy()).max() > 0.02
        print(sea.light, distance, error.max())
        assert error.max() < (2e-3 if sea.light == "linear" else 0.06)


def test_scale_by_a_known_distance(blender, tmp_path):
    """Two cameras 3 units apart that are 1.5 m apart: the scene in metres, its water per metre, and undo."""
    blender.run(
        SETUP
        + MORE
        + """
view(64, 48, 50.0)
root = bpy.data.objects["root"]
root["swag_scene"] = "/photographs"
root.scale = (2, 2, 2)
obj = splats.new_splat_object("reef", random_splats(10, 1), scene.collection, root)
data = {"beta_D": [0.2, 0.1, 0.05], "beta_B": [0.1] * 3, "veil_sh": [[0.1] * 3] * 9, "light": "linear", "per": "unit"}
water.remember_water(obj, data, 0.0)
ends = [bpy.data.objects.new(name, bpy.data.cameras.new(name)) for name in ("a", "b")]
for number, end in enumerate(ends):
    scene.collection.objects.link(end)
    end.parent, end.location = root, (1, 2 + 1.5 * number, 3)
bpy.context.view_layer.update()
for one in scene.objects:
    one.select_set(False)
assert "Select two objects" in str(failure(lambda: bpy.ops.swag.set_scale(distance=1.5)))
for end in ends:
    end.select_set(True)
bpy.ops.ed.undo_push()
assert bpy.ops.swag.set_scale(distance=1.5) == {"FINISHED"}
bpy.context.view_layer.update()
apart = (ends[0].matrix_world.translation - ends[1].matrix_world.translation).length
assert abs(apart - 1.5) < 1e-5
assert abs(scene.swag.metres_per_unit - 1) < 1e-6 and abs(water.metres_per_unit(obj) - 1) < 1e-6
assert scene.unit_settings.system == "METRIC"
# Points given by hand, as the picking does.
assert bpy.ops.swag.set_scale(distance=8, start=(0, 0, 0), end=(0, 0, 2)) == {"FINISHED"}
assert abs(scene.swag.metres_per_unit - 4) < 1e-5
        """
    )


def test_slider_stays_with_a_file_and_goes_with_copies(blender, tmp_path):
    """Saved, opened and separated splats keep the water; without one there is nothing to change."""
    blender.run(
        SETUP
        + MORE
        + """
from bl_ext.user_default.swag_splatting.swag_blender import labels
obj = splats.new_splat_object("reef", random_splats(10, 1), scene.collection)
data = {"beta_D": [0.2, 0.1, 0.05], "beta_B": [0.1] * 3, "veil_sh": [[0.1] * 3] * 9, "light": "srgb", "per": "metre"}
water.remember_water(obj, data, 2.0)
assert np.allclose(water.water_of(obj).beta_D, (0.4, 0.2, 0.1)) and water.water_of(obj).display
def amount(obj):
    owner, path, _ = splat_preview._input(obj, splat_preview.WATER)
    return owner.value if path == "value" else owner[path]
bpy.ops.wm.save_as_mainfile(filepath=bpy.app.tempdir + "water.blend")
bpy.ops.wm.open_mainfile(filepath=bpy.app.tempdir + "water.blend")
scene, obj = bpy.context.scene, bpy.data.objects["reef"]
scene.swag.water = 0.4
bpy.context.view_layer.update()
assert abs(amount(obj) - 0.4) < 1e-6
obj.data.attributes.new("swag:selected", "BOOLEAN", "POINT").data[0].value = True
made = labels.separate(obj)
scene.swag.water = 0.7
bpy.context.view_layer.update()
assert abs(amount(made) - 0.7) < 1e-6 and water.water_of(made) == water.water_of(obj)
water.remember_water(obj, None, 0.0)
assert water.water_of(obj) is None
table = {"ranges": [0, 1], "transmission": [[1] * 3] * 2, "backscatter": [[0] * 3] * 2, "light": "srgb", "per": "unit"}
water.remember_water(obj, table, 0.0)
assert water.water_of(obj) is None
broken = str(failure(lambda: water.remember_water(obj, data | {"beta_D": [1]}, 1.0)))
assert "water.json does not hold" in broken, broken
        """
    )
