"""What renders and films show behind the splats of a run, and the worlds of scenes."""

import json
import os
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import background, colors, scene_import, splats, water
from bl_ext.user_default.swag_splatting.swag_blender.nodes import water_shader
from bl_ext.user_default.swag_splatting.swag_engine.base.transfer import linear_to_srgb
from pictures import new_camera, random_splats, render_pixel_centres

scene = bpy.context.scene
NO_LIGHT = [[-100.0] * 3] + [[0.0] * 3] * 8
WATER = {"beta_D": [0.2, 0.1, 0.05], "beta_B": [0.1] * 3, "light": "linear", "per": "unit"}


def opened(run, images):
    """Open a run with its cameras, look through the first one, hide splats of x > -1; returns the splat object."""
    bpy.ops.swag.import_scene(directory=images)
    assert bpy.ops.swag.open_run(directory=run) == {"FINISHED"}
    scene_import.look_through(scene, next(obj for obj in scene.objects if scene_import.SIZE_KEY in obj))
    obj = bpy.context.active_object
    hidden = obj.data.attributes.new("swag:hidden", "BOOLEAN", "POINT")
    hidden.data.foreach_set("value", splats.read_splats(obj).positions[:, 0] > -1)
    return obj


def render_run(run, images, amounts, out):
    """Render a run by Cycles at amounts of water, without and with development, and the last one in linear light.

    Returns:
        The development of each amount.
    """
    obj = opened(run, images)
    own, found, developments = scene.swag_colors, {}, []
    for develop, exposure in (("none", 0.0), ("auto", 0.4)):
        own.develop, own.exposure = develop, exposure
        bpy.ops.swag.prepare_render(display_values=True)
        for amount in amounts:
            scene.swag.water = amount
            found[f"{develop} {amount}"] = render_pixel_centres(transparent=False)[..., :3]
            developments.append(colors.picture_development(scene, obj).to_json())
    own.develop, own.exposure = "none", 0.0
    bpy.ops.swag.prepare_render(display_values=False)
    found["light"] = linear_to_srgb(render_pixel_centres(transparent=False)[..., :3])
    np.savez(out, **found)
    return developments[len(amounts) :]


def render_by_eevee(run, images, amount, out):
    opened(run, images)
    scene.swag_colors.develop = "none"
    scene.swag.water = amount
    bpy.ops.swag.prepare_render(engine="EEVEE", display_values=True)
    np.save(out, render_pixel_centres(transparent=False)[..., :3])
    # The world follows when the run has been trained again.
    color = scene.world.node_tree.nodes["Background"].inputs["Color"]
    before = color.default_value[:]
    color.default_value, scene.world["swag_background"] = (1, 0, 0, 1), (1.0, 0.0, 0.0, 1.0)
    assert bpy.ops.swag.open_run(directory=run) == {"FINISHED"} and color.default_value[:] == before


def film_without_run(run, images, amounts, out):
    """Film a run, whose folder is not on this machine any more, through one camera with an amount of water a frame."""
    obj = opened(run, images)
    del obj["swag_run"]
    scene.frame_start, scene.frame_end = 1, len(amounts)
    for number, amount in enumerate(amounts, 1):
        scene.swag.water = amount
        scene.swag.keyframe_insert("water", frame=number)
    scene.swag_film.output, scene.swag_colors.develop = out, "none"
    assert bpy.ops.swag.render_film() == {"FINISHED"}


def seen():
    """The color of an empty render in linear light."""
    return render_pixel_centres(transparent=False)[0, 0, :3].tolist()


def new_splats(color, light=None):
    """Splats out of view whose run has a background color, and water where `light` is its background light."""
    obj = splats.new_splat_object("reef", random_splats(1, 1), scene.collection)
    obj.location.z = 50
    obj["swag_background"] = color
    if light is not None:
        water.remember_water(obj, WATER | {"background_sh": light}, 0.0)
    return obj


def set_up(**options):
    return bpy.ops.swag.prepare_render("EXEC_DEFAULT", **options)


def worlds_of_users():
    """Worlds that a user made are kept by default, and stay in the file where a background replaces them."""
    new_camera()
    scene.render.resolution_x = scene.render.resolution_y = 4
    obj = new_splats((0.5, 0.25, 0.75))
    light = np.array([0.21404, 0.05088, 0.52252])
    scene.world = None

    def has_run_color():
        return np.allclose(seen(), light, atol=1e-4)

    set_up()
    assert has_run_color(), "a scene without a world gets one"
    first = scene.world
    set_up(display_values=True)
    assert scene.world == first and np.allclose(seen(), (0.5, 0.25, 0.75), atol=1e-4)
    obj["swag_background"] = (0.1, 0.1, 0.1)
    set_up()
    assert scene.world == first and not has_run_color(), "the color that was set before is no user's"
    obj["swag_background"] = (0.5, 0.25, 0.75)
    for name in ("default", "script"):
        world = bpy.data.worlds.new(name)
        world.use_nodes = True
        if name == "default":
            world.node_tree.nodes["Background"].inputs["Color"].default_value[:3] = [0.050876] * 3
        scene.world = world
        set_up()
        assert scene.world == world and has_run_color(), name
    del world["swag_background"]
    scene.world = world
    set_up(display_values=True)
    assert np.allclose(seen(), (0.5, 0.25, 0.75), atol=1e-4), "an earlier version set this color"

    def color(tree, node):
        node.inputs["Color"].default_value = (0.3, 0.1, 0.1, 1)

    def strength(tree, node):
        node.inputs["Strength"].default_value = 0.5

    def sky(tree, node):
        tree.links.new(tree.nodes.new("ShaderNodeTexEnvironment").outputs["Color"], node.inputs["Color"])

    def fog(tree, node):
        tree.links.new(
            tree.nodes.new("ShaderNodeVolumePrincipled").outputs[0], tree.nodes["World Output"].inputs["Volume"]
        )

    def changed_water(tree, node):
        group = tree.nodes.new("ShaderNodeGroup")
        group.node_tree = water_shader.free_group(water.WaterValues())
        mixed = tree.nodes.new("ShaderNodeHueSaturation")
        tree.links.new(group.outputs[water_shader.LIGHT], mixed.inputs["Color"])
        tree.links.new(mixed.outputs[0], node.inputs["Color"])

    for change in (color, strength, sky, fog, changed_water):
        world = scene.world = bpy.data.worlds.new(change.__name__)
        world.use_nodes = True
        change(world.node_tree, world.node_tree.nodes["Background"])
        before = [(link.from_node.name, link.to_node.name) for link in world.node_tree.links]
        set_up()
        assert scene.world == world and background.has_users_world(scene), change.__name__
        set_up(world="RUN")
        assert scene.world != world and has_run_color() and world.use_fake_user
        assert [(link.from_node.name, link.to_node.name) for link in world.node_tree.links] == before
        assert not background.has_users_world(scene), "pressed twice it knows its own world"
        set_up(world="KEEP", display_values=True)
        assert has_run_color(), "kept as it was"
    if bpy.app.version < (5, 0):
        world = scene.world = bpy.data.worlds.new("no nodes")
        world.use_nodes, world.color = False, (0.2, 0.3, 0.4)
        set_up()
        assert scene.world == world and not world.use_nodes
        world = scene.world = bpy.data.worlds.new("nodes switched off")
        world.use_nodes = True
        world.node_tree.nodes.clear()
        world.use_nodes = False
        set_up()
        assert scene.world == world and not world.use_nodes
        world = scene.world = bpy.data.worlds.new("default without nodes")
        set_up()
        assert scene.world == world and has_run_color()
    scene.world = bpy.data.worlds.new("plain")
    bpy.data.objects.remove(obj)
    splats.new_splat_object("file", random_splats(1, 1), scene.collection)
    set_up()
    assert scene.world.name == "plain" and "swag_background" not in scene.world, "no run, no background"


def first_object_with_water():
    """The background is that of splats with water, else of the active ones, and of none that renders leave out."""
    color = new_splats((0.1, 0.2, 0.3))
    other = new_splats((0.3, 0.2, 0.1))
    with_water = new_splats((0.0, 0.0, 0.0), [[0.1] * 3] * 9)
    every = [color, other, with_water]
    assert background.find(every, color) == with_water and background.color_behind(with_water) is None
    assert background.find(every[:2], other) == other and background.find(every[:2], None) == color
    assert background.find([splats.new_splat_object("file", random_splats(1, 1), scene.collection)], None) is None
    network = {"ranges": [0, 1], "transmission": [[1] * 3] * 2, "backscatter": [[0] * 3] * 2}
    water.remember_water(other, network, 0.0)
    assert background.color_behind(other) == (0.0, 0.0, 0.0), "without the water of a network all is black behind it"
    with_water.hide_render = True
    new_camera()
    scene.render.resolution_x = scene.render.resolution_y = 4
    set_up(display_values=True)
    assert np.allclose(seen(), (0.1, 0.2, 0.3), atol=1e-4)


def file_of_an_earlier_version(folder):
    """A file whose world shows the open water of a water that only attenuates is mended when it is opened."""
    new_camera()
    scene.render.resolution_x = scene.render.resolution_y = 4
    obj = new_splats((0.5, 0.25, 0.75), NO_LIGHT)
    scene.swag.water = 1.0
    found = {}
    for display in (True, False):
        set_up(display_values=display)
        node = scene.world.node_tree.nodes["Background"]
        group = scene.world.node_tree.nodes.new("ShaderNodeGroup")
        group.name, group.node_tree = water_shader.NAME, water.node_group(obj)
        output = water_shader.DISPLAY_VALUES if display else water_shader.LIGHT
        scene.world.node_tree.links.new(group.outputs[output], node.inputs["Color"])
        del scene.world["swag_background"]
        path = os.path.join(folder, f"{display}.blend")
        bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
        found[str(display)] = path
    for display, path in found.items():
        bpy.ops.wm.open_mainfile(filepath=path)
        found[display] = seen()
    return json.loads(json.dumps(found)) | {"files": sorted(file.name for file in Path(folder).iterdir())}
