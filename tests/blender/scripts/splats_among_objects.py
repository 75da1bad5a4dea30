"""Splats beside what else a Blender scene has: instances, other modifiers, meshes, holdouts, lamps."""

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import splats
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_colors, splat_preview
from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats
from mathutils import Matrix
from pictures import FIELDS, linked, load_splats, new_camera, pinhole_camera, psnr, render_pixel_centres

scene = bpy.context.scene

MOVED = Matrix.Translation((0.4, -0.3, 1.0)) @ Matrix.Rotation(0.2, 4, (0.3, 1.0, 0.2)) @ Matrix.Scale(0.7, 4)


def one_splat(z, sigma, opacity):
    return Splats(
        np.array([[0, 0, z]], "f4"),
        np.array([[1, 0, 0, 0]], "f4"),
        np.full((1, 3), sigma, "f4"),
        np.array([opacity], "f4"),
        np.full((1, 1, 3), 0.2 / 0.28209479, "f4"),
    )


def plane(z, size, left_half=False):
    mesh = bpy.data.meshes.new("plane")
    x = 0 if left_half else size
    mesh.from_pydata([(-size, -size, z), (x, -size, z), (x, size, z), (-size, size, z)], [], [(0, 1, 2, 3)])
    return linked("plane", mesh)


def set_shader(obj, kind, color=None):
    material = bpy.data.materials.new(kind)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    shader = tree.nodes.new(kind)
    if color:
        shader.inputs["Color"].default_value = (*color, 1)
    tree.links.new(shader.outputs[0], tree.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    obj.data.materials.append(material)


def add_geometry_nodes(obj, *kinds):
    """Add a modifier of these nodes in a row, and return the nodes."""
    tree = bpy.data.node_groups.new("other", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    nodes = [tree.nodes.new(kind) for kind in ("NodeGroupInput", *kinds, "NodeGroupOutput")]
    for before, after in zip(nodes, nodes[1:], strict=False):
        if "Geometry" in after.inputs and "Geometry" in before.outputs:
            tree.links.new(before.outputs["Geometry"], after.inputs["Geometry"])
    obj.modifiers.new("other", "NODES").node_group = tree
    return nodes[1:-1]


def compare_instances(folder):
    """PSNR of each kind of instance against the object itself at the same place."""
    pinhole_camera(80, 50, 75.0)
    hidden = bpy.data.collections.new("hidden")  # in no view layer
    scene.collection.children.link(hidden)
    bpy.context.view_layer.layer_collection.children["hidden"].exclude = True
    obj = splats.new_splat_object("heap", load_splats(folder + "/heap.npz"), scene.collection)
    splat_preview.prepare_render(scene, display_values=True)
    splat_preview.set_input(obj, splat_preview.PIXEL_SIZE, 1 / 75)

    def compare(instance):
        obj.matrix_world = MOVED
        direct = render_pixel_centres()
        obj.matrix_world = Matrix()
        scene.collection.objects.unlink(obj)
        hidden.objects.link(obj)
        instance.matrix_world = MOVED
        scene.collection.objects.link(instance)
        through_instance = render_pixel_centres()
        bpy.data.objects.remove(instance)
        hidden.objects.unlink(obj)
        scene.collection.objects.link(obj)
        assert direct[..., 3].mean() > 0.03
        return float(psnr(direct, through_instance))

    duplicate = obj.copy()
    assert duplicate.data == obj.data
    found = {"linked duplicate": compare(duplicate)}
    splat_preview.set_input(obj, splat_preview.FACE_CAMERA, False)
    splat_preview.set_input(obj, splat_preview.PIXEL_SIZE, 0.0)
    splat_preview.set_input(obj, splat_colors.SH_DEGREE, 0)
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", hidden
    found["collection"] = compare(empty)
    holder = bpy.data.objects.new("holder", bpy.data.meshes.new("holder"))
    (info,) = add_geometry_nodes(holder, "GeometryNodeObjectInfo")
    info.inputs["Object"].default_value, info.inputs["As Instance"].default_value = obj, True
    found["geometry nodes"] = compare(holder)
    return found


def other_modifiers(folder):
    root = pinhole_camera(80, 50, 75.0)
    all_splats = load_splats(folder + "/heap.npz")
    obj = splats.new_splat_object("heap", all_splats, scene.collection, root)
    splat_preview.prepare_render(scene, display_values=True)
    left = all_splats.positions[:, 0] < 0
    splats.replace_splats(obj, Splats(*(getattr(all_splats, name)[left] for name in FIELDS)))
    direct = render_pixel_centres()
    splats.replace_splats(obj, all_splats)
    everything = render_pixel_centres()
    (delete,) = add_geometry_nodes(obj, "GeometryNodeDeleteGeometry")
    tree = delete.id_data
    kinds = ("GeometryNodeInputPosition", "ShaderNodeSeparateXYZ", "ShaderNodeMath")
    position, parts, compare = (tree.nodes.new(kind) for kind in kinds)
    compare.operation, compare.inputs[1].default_value = "GREATER_THAN", 0.0
    tree.links.new(position.outputs[0], parts.inputs[0])
    tree.links.new(parts.outputs[0], compare.inputs[0])
    tree.links.new(compare.outputs[0], delete.inputs["Selection"])
    obj.modifiers.move(1, 0)
    before = render_pixel_centres()
    assert psnr(before, direct) > 60 > 40 > psnr(everything, direct), (psnr(before, direct), psnr(everything, direct))

    obj.modifiers.remove(obj.modifiers[0])
    splat_preview.set_input(obj, splat_preview.FACE_CAMERA, False)
    splat_preview.set_input(obj, splat_colors.SH_DEGREE, 0)
    obj.matrix_world = MOVED
    direct = render_pixel_centres()
    obj.matrix_world = Matrix()
    (transform,) = add_geometry_nodes(obj, "GeometryNodeTransform")
    transform.inputs["Translation"].default_value = MOVED.translation
    transform.inputs["Rotation"].default_value = MOVED.to_euler()
    transform.inputs["Scale"].default_value = MOVED.to_scale()
    after = render_pixel_centres()
    assert psnr(after, direct) > 60, psnr(after, direct)


def meshes_and_holdouts(renderer):
    root = pinhole_camera(40, 40, 40.0)
    obj = splats.new_splat_object("one", one_splat(4.0, 2.0, 0.6), scene.collection, root)
    splat_preview.use_shapes(obj, True)
    back, front = plane(6.0, 20), plane(3.0, 20, left_half=True)
    set_shader(back, "ShaderNodeEmission", (0.2, 0.5, 0.8))
    set_shader(front, "ShaderNodeEmission", (0.9, 0.1, 0.3))
    splat_preview.prepare_render(scene, False, renderer)
    back.hide_render = front.hide_render = True
    alone = render_pixel_centres()
    assert alone[..., 3].max() > 0.55
    back.hide_render = front.hide_render = False
    image = render_pixel_centres()
    over = alone[..., :3] + (1 - alone[..., 3:]) * (0.2, 0.5, 0.8)
    assert np.allclose(image[:, 25:, :3], over[:, 25:], atol=2e-3)
    assert np.allclose(image[:, :10, :3], (0.9, 0.1, 0.3), atol=2e-3)
    back.hide_render, front.is_holdout = True, True
    image = render_pixel_centres()
    assert image[:, :10].max() < 1e-3
    assert np.allclose(image[:, 25:], alone[:, 25:], atol=1e-3)
    # A holdout behind the splats does not change them.
    back.hide_render, front.hide_render, back.is_holdout, front.is_holdout = False, True, True, False
    assert np.allclose(render_pixel_centres(), alone, atol=2e-3)


def shadow():
    """A lamp at 45 degrees; lit values along a row through the shadow, without and with FACE_CAMERA."""
    camera = new_camera()
    camera.location, camera.data.type, camera.data.ortho_scale = (0, 0, 5), "ORTHO", 4
    scene.render.resolution_x = scene.render.resolution_y = 101
    set_shader(plane(0.0, 4), "ShaderNodeBsdfDiffuse")
    sun = linked("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.angle, sun.rotation_euler.y = 0.0, np.pi / 4  # shines down and to -x
    black = one_splat(1.0, 0.1, 0.8)
    black.sh[:] = -0.5 / 0.28209479
    obj = splats.new_splat_object("black", black, scene.collection)
    splat_preview.use_shapes(obj, True)
    splat_preview.prepare_render(scene, display_values=False)
    rows = []
    for facing in (False, True):
        splat_preview.set_input(obj, splat_preview.FACE_CAMERA, facing)
        rows.append(render_pixel_centres()[50, :, 0].tolist())
    return rows
