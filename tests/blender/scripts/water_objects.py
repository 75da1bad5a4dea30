"""The fitted water in Blender: on splats, behind them, on ordinary objects, with a scale."""

import json
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import labels, splats, water
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_colors, splat_preview
from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply
from mathutils import Euler, Matrix
from pictures import linked, load_splats, new_camera, pinhole_camera, random_splats, render_pixel_centres

scene = bpy.context.scene

WATER = {
    "beta_D": [0.2, 0.1, 0.05],
    "beta_B": [0.1] * 3,
    "background_sh": [[0.1] * 3] * 9,
    "light": "linear",
    "per": "unit",
}


def failure(call):
    """The message of the error that a call raises."""
    try:
        call()
    except Exception as error:
        return str(error)
    raise AssertionError("no error was raised")


def render_splats_and_background(folder, width, height, focal, amount):
    root = pinhole_camera(width, height, focal)
    obj = splats.new_splat_object("heap", load_splats(folder + "/heap.npz"), scene.collection, root)
    root.rotation_euler, root.location, root.scale = (0.3, -0.2, 0.7), (3, 1, -2), (2, 2, 2)
    splat_preview.remember_training(obj, 1 / focal, [0, 0, 0])
    water.remember_water(obj, json.loads(Path(folder, "water.json").read_text()), 0.0)
    scene.swag.water = amount
    bpy.ops.swag.prepare_render(display_values=True)
    np.save(folder + "/render.npy", render_pixel_centres(transparent=False))


def render_haze(folder, width, height, focal):
    """Render a heap of which some splats are haze, without haze, with half of it and all, and through water at 1."""
    root = pinhole_camera(width, height, focal)
    made = load_splats(folder + "/heap.npz")
    made.extras["haze"] = np.load(folder + "/haze.npy")
    obj = splats.new_splat_object("heap", made, scene.collection, root)
    splat_preview.remember_training(obj, 1 / focal, [0, 0, 0])
    water.remember_water(obj, None, 0.0)
    bpy.ops.swag.prepare_render(display_values=True)
    images = {}
    for name, haze, amount in (("none", 0.0, 0.0), ("half", 0.5, 0.2), ("all", 1.0, 0.0), ("water", 0.0, 1.0)):
        scene.swag.haze, scene.swag.water = haze, amount
        assert abs(water.shown_haze(scene) - max(haze, amount)) < 1e-6
        images[name] = render_pixel_centres()
    np.savez(folder + "/images.npz", **images)


def write_and_select_haze(folder):
    """Exports show the haze that is seen, films that of each frame; splats of open water can be selected."""
    made = random_splats(20, 1)
    made.extras["haze"] = np.array([0.9, 0.4, 0.05] + [0] * 17, "f4")
    made.opacities[:3] = 0.01
    obj = splats.new_splat_object("reef", made, scene.collection)
    water.remember_water(obj, None, 0.0)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)

    def written():
        bpy.ops.swag.export_splats(filepath=folder + "/out.ply", part="ALL")
        return read_ply(Path(folder, "out.ply"))

    scene.swag.haze = 0
    plain = written()
    assert np.allclose(plain.opacities, made.opacities, atol=1e-6) and np.allclose(plain.extras["haze"][:2], (0.9, 0.4))
    scene.swag.haze = 1
    seen = written()
    expected = made.opacities.copy()
    expected[:3] /= 1 - made.extras["haze"][:3]
    assert np.allclose(seen.opacities, expected, rtol=1e-4) and "haze" not in seen.extras
    by = bpy.ops.swag.select_by

    def selected():
        return np.flatnonzero(labels.mask_of(obj, labels.SELECTED)).tolist()

    by(kind="HAZE", fraction=0.5)
    assert selected() == [0]
    by(kind="HAZE", fraction=0.1)
    assert selected() == [0, 1]
    obj.data.attributes.remove(obj.data.attributes["swag:haze"])
    assert "No open water was found among the splats of reef" in failure(lambda: by(kind="HAZE"))


def render_walls(folder):
    """Render lit and glowing walls at two distances without water, with it, and after its removal."""
    camera = new_camera()
    obj = splats.new_splat_object("splats", random_splats(1, 1), scene.collection)
    # The splats are rotated, out of view, and one of their units is two of Blender's.
    obj.matrix_world = Matrix.LocRotScale((0, 0, 50), Euler((0.4, 1.1, -0.6)), (2, 2, 2))
    water.remember_water(obj, json.loads(Path(folder, "water.json").read_text()), 0.0)
    scene.swag.water = 1
    bpy.ops.swag.prepare_render(display_values=False)
    lamp = linked("sun", bpy.data.lights.new("sun", "SUN"))
    lamp.data.energy = 2
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
    images = {}

    def render(name):
        for distance, pair in ((2, walls[:2]), (9, walls[2:])):
            for wall in walls:
                wall.hide_render = wall not in pair
            images[f"{name}{distance}"] = render_pixel_centres()

    scene.render.resolution_x = scene.render.resolution_y = 32
    render("dry")
    for wall in walls:
        wall.select_set(True)
    assert bpy.ops.swag.water_objects() == {"FINISHED"}
    render("wet")
    assert bpy.ops.swag.water_objects() == {"FINISHED"}
    assert len(walls[0].active_material.node_tree.nodes) == 6, "a second call adds no nodes"
    assert bpy.ops.swag.water_objects(remove=True) == {"FINISHED"}
    render("removed")
    turn = np.array(obj.matrix_world.to_3x3().normalized())
    np.savez(folder + "/images.npz", turn=turn, angle=camera.data.angle_x, **images)


def set_scale():
    root = pinhole_camera(64, 48, 50.0)
    root["swag_scene"] = "/photographs"
    root.scale = (2, 2, 2)
    obj = splats.new_splat_object("reef", random_splats(10, 1), scene.collection, root)
    water.remember_water(obj, WATER, 0.0)
    ends = [linked(name, bpy.data.cameras.new(name)) for name in ("a", "b")]
    for number, end in enumerate(ends):
        end.parent, end.location = root, (1, 2 + 1.5 * number, 3)
    bpy.context.view_layer.update()
    for obj_to_deselect in scene.objects:
        obj_to_deselect.select_set(False)
    assert "Select two objects" in failure(lambda: bpy.ops.swag.set_scale(distance=1.5))
    for end in ends:
        end.select_set(True)
    assert bpy.ops.swag.set_scale(distance=1.5) == {"FINISHED"}
    bpy.context.view_layer.update()
    apart = (ends[0].matrix_world.translation - ends[1].matrix_world.translation).length
    assert abs(apart - 1.5) < 1e-5
    assert abs(scene.swag.metres_per_unit - 1) < 1e-6 and abs(water.metres_per_unit(obj) - 1) < 1e-6
    assert scene.unit_settings.system == "METRIC"
    # Two points instead of two objects, as picking them in the viewport gives.
    assert bpy.ops.swag.set_scale(distance=8, start=(0, 0, 0), end=(0, 0, 2)) == {"FINISHED"}
    assert abs(scene.swag.metres_per_unit - 4) < 1e-5
    # In a scene in centimetres and inches, the distance is shown as typed, and the engine still gets metres.
    scene.unit_settings.system, scene.unit_settings.scale_length = "IMPERIAL", 0.01
    assert bpy.ops.swag.set_scale(distance=200) == {"FINISHED"}
    bpy.context.view_layer.update()
    apart = (ends[0].matrix_world.translation - ends[1].matrix_world.translation).length
    assert abs(apart - 200) < 1e-3 and scene.unit_settings.system == "IMPERIAL"
    assert abs(scene.swag.metres_per_unit - 2 / 1.5) < 1e-5 and abs(water.metres_per_unit(obj) - 2 / 1.5) < 1e-5
    distance = bpy.ops.swag.set_scale.get_rna_type().properties["distance"]
    assert distance.unit == "LENGTH" and distance.subtype == "DISTANCE"


def nodes_of_an_earlier_version():
    """Show water on a preview and a group of the water that lack what later versions added."""
    obj = splats.new_splat_object("reef", random_splats(10, 1), scene.collection)
    water.remember_water(obj, WATER, 0.0)
    old = water.node_group(obj)
    preview = splat_preview.modifier_of(obj).node_group
    items = preview.interface.items_tree
    for item in [item for item in items if item.name.startswith("Background Light")]:
        preview.interface.remove(item)
    old.nodes.remove(old.nodes["Background Light 8"])
    water.remember_water(obj, WATER, 0.0)
    splat_preview.set_input(obj, "Background Light 8", (0.1, 0.2, 0.3))
    assert water.node_group(obj) != old and "Background Light 8" in water.node_group(obj).nodes


def save_copy_and_remove(folder):
    obj = splats.new_splat_object("reef", random_splats(10, 1), scene.collection)
    data = WATER | {"light": "srgb", "per": "metre"}
    water.remember_water(obj, data, 2.0)
    assert np.allclose(water.water_of(obj).beta_D, (0.4, 0.2, 0.1)) and water.water_of(obj).display

    def amount(obj):
        owner, path, _ = splat_preview._input(obj, splat_colors.WATER)
        return owner.value if path == "value" else owner[path]

    bpy.ops.wm.save_as_mainfile(filepath=folder + "/water.blend")
    bpy.ops.wm.open_mainfile(filepath=folder + "/water.blend")
    opened, obj = bpy.context.scene, bpy.data.objects["reef"]
    opened.swag.water = 0.4
    bpy.context.view_layer.update()
    assert abs(amount(obj) - 0.4) < 1e-6
    obj.data.attributes.new("swag:selected", "BOOLEAN", "POINT").data[0].value = True
    part = labels.separate(obj)
    opened.swag.water = 0.7
    bpy.context.view_layer.update()
    assert abs(amount(part) - 0.7) < 1e-6 and water.water_of(part) == water.water_of(obj)
    water.remember_water(obj, None, 0.0)
    assert water.water_of(obj) is None
    table = {
        "ranges": [0, 1], "transmission": [[1] * 3] * 2, "backscatter": [[0] * 3] * 2, "light": "srgb", "per": "unit"
    }  # fmt: skip
    water.remember_water(obj, table, 0.0)
    assert water.water_of(obj) is None
    broken = failure(lambda: water.remember_water(obj, data | {"beta_D": [1]}, 1.0))
    assert "water.json does not hold" in broken, broken
