"""Splats beside what else a Blender scene has: instances, other modifiers, meshes, holdouts, lamps."""

import numpy as np

from tests.blender.splat_pictures import SETUP, heap

SCENE = (
    SETUP
    + """
from mathutils import Matrix

PLACE = Matrix.Translation((0.4, -0.3, 1.0)) @ Matrix.Rotation(0.2, 4, (0.3, 1.0, 0.2)) @ Matrix.Scale(0.7, 4)

def one_splat(z, sigma, opacity):
    return Splats(np.array([[0, 0, z]], "f4"), np.array([[1, 0, 0, 0]], "f4"), np.full((1, 3), sigma, "f4"),
                  np.array([opacity], "f4"), np.full((1, 1, 3), 0.2 / 0.28209479, "f4"))

def plane(z, size, left=False):
    mesh = bpy.data.meshes.new("plane")
    x = 0 if left else size
    mesh.from_pydata([(-size, -size, z), (x, -size, z), (x, size, z), (-size, size, z)], [], [(0, 1, 2, 3)])
    obj = bpy.data.objects.new("plane", mesh)
    scene.collection.objects.link(obj)
    return obj

def shaded(obj, kind, color=None):
    made = bpy.data.materials.new(kind)
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    shader = tree.nodes.new(kind)
    if color:
        shader.inputs["Color"].default_value = (*color, 1)
    tree.links.new(shader.outputs[0], tree.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    obj.data.materials.append(made)

def geometry_nodes(obj, *chain):
    # A modifier of these nodes one after the other; returns the nodes.
    tree = bpy.data.node_groups.new("other", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    nodes = [tree.nodes.new(kind) for kind in ("NodeGroupInput", *chain, "NodeGroupOutput")]
    for before, after in zip(nodes, nodes[1:]):
        if "Geometry" in after.inputs and "Geometry" in before.outputs:
            tree.links.new(before.outputs["Geometry"], after.inputs["Geometry"])
    obj.modifiers.new("other", "NODES").node_group = tree
    return nodes[1:-1]

def psnr(a, b):
    return -10 * np.log10(max(np.mean((a - b) ** 2), 1e-12))
"""
)


def test_instances_show_what_the_object_shows_there(blender, tmp_path):
    """A linked duplicate is exact. Instances of a collection or by geometry nodes share one geometry, which cannot face
    the camera for each of them: there the ellipsoids stand for the splats."""
    np.savez(tmp_path / "heap.npz", **{name: array[:80] for name, array in heap().items()})
    blender.run(
        SCENE
        + """
view(80, 50, 75.0)
root = bpy.data.objects["root"]
hidden = bpy.data.collections.new("hidden")  # in no view layer
scene.collection.children.link(hidden)
bpy.context.view_layer.layer_collection.children["hidden"].exclude = True
obj = splats.new_splat_object("heap", saved(sys.argv[1]), scene.collection)
splat_preview.prepare_render(scene, display_values=True)
splat_preview.set_input(obj, splat_preview.PIXEL_SIZE, 1 / 75)

def moved_and(instance):
    # The pictures of the object in its place and of the instance there.
    obj.matrix_world = PLACE
    direct = point_sampled(80, 50)
    obj.matrix_world = Matrix()
    scene.collection.objects.unlink(obj)
    hidden.objects.link(obj)
    instance.matrix_world = PLACE
    scene.collection.objects.link(instance)
    pictures = direct, point_sampled(80, 50)
    bpy.data.objects.remove(instance)
    hidden.objects.unlink(obj)
    scene.collection.objects.link(obj)
    assert direct[..., 3].mean() > 0.03
    return psnr(*pictures)

duplicate = obj.copy()
assert duplicate.data == obj.data
found = {"duplicate": moved_and(duplicate)}
splat_preview.set_input(obj, splat_preview.FACE_CAMERA, False)
splat_preview.set_input(obj, splat_preview.PIXEL_SIZE, 0.0)
splat_preview.set_input(obj, splat_preview.SH_DEGREE, 0)
empty = bpy.data.objects.new("instance", None)
empty.instance_type, empty.instance_collection = "COLLECTION", hidden
found["collection"] = moved_and(empty)
holder = bpy.data.objects.new("holder", bpy.data.meshes.new("holder"))
info, = geometry_nodes(holder, "GeometryNodeObjectInfo")
info.inputs["Object"].default_value, info.inputs["As Instance"].default_value = obj, True
found["geometry nodes"] = moved_and(holder)
print(found)
assert all(value > 60 for value in found.values()), found
""",
        tmp_path / "heap.npz",
        tmp_path,
    )


def test_other_modifiers_before_and_after_the_preview(blender, tmp_path):
    """Before it they change the splats, after it what is drawn."""
    np.savez(tmp_path / "heap.npz", **{name: array[:80] for name, array in heap().items()})
    blender.run(
        SCENE
        + """
view(80, 50, 75.0)
held = saved(sys.argv[1])
obj = splats.new_splat_object("heap", held, scene.collection, bpy.data.objects["root"])
splat_preview.prepare_render(scene, display_values=True)
few = held.positions[:, 0] < 0
chosen = Splats(*(getattr(held, name)[few] for name in ("positions", "rotations", "scales", "opacities", "sh")))
splats.replace_splats(obj, chosen)
direct = point_sampled(80, 50)
splats.replace_splats(obj, held)
everything = point_sampled(80, 50)
delete, = geometry_nodes(obj, "GeometryNodeDeleteGeometry")
tree = delete.id_data
position, parts, compare = (tree.nodes.new(kind) for kind in (
    "GeometryNodeInputPosition", "ShaderNodeSeparateXYZ", "ShaderNodeMath"))
compare.operation, compare.inputs[1].default_value = "GREATER_THAN", 0.0
tree.links.new(position.outputs[0], parts.inputs[0])
tree.links.new(parts.outputs[0], compare.inputs[0])
tree.links.new(compare.outputs[0], delete.inputs["Selection"])
obj.modifiers.move(1, 0)
before = point_sampled(80, 50)
assert psnr(before, direct) > 60 > 40 > psnr(everything, direct), (psnr(before, direct), psnr(everything, direct))

obj.modifiers.remove(obj.modifiers[0])
splat_preview.set_input(obj, splat_preview.FACE_CAMERA, False)
splat_preview.set_input(obj, splat_preview.SH_DEGREE, 0)
obj.matrix_world = PLACE
direct = point_sampled(80, 50)
obj.matrix_world = Matrix()
transform, = geometry_nodes(obj, "GeometryNodeTransform")
transform.inputs["Translation"].default_value = PLACE.translation
transform.inputs["Rotation"].default_value = PLACE.to_euler()
transform.inputs["Scale"].default_value = PLACE.to_scale()
after = point_sampled(80, 50)
assert psnr(after, direct) > 60, psnr(after, direct)
""",
        tmp_path / "heap.npz",
        tmp_path,
    )


def test_meshes_and_holdouts_before_and_behind_splats(blender, tmp_path):
    """A mesh hides what is behind it, splats blend over what is behind them, a holdout cuts the picture's alpha."""
    blender.run(
        SCENE
        + """
view(40, 40, 40.0)
obj = splats.new_splat_object("one", one_splat(4.0, 2.0, 0.6), scene.collection, bpy.data.objects["root"])
back, front = plane(6.0, 20), plane(3.0, 20, left=True)
shaded(back, "ShaderNodeEmission", (0.2, 0.5, 0.8))
shaded(front, "ShaderNodeEmission", (0.9, 0.1, 0.3))
cut = bpy.data.materials.new("cut")
for renderer in ("CYCLES", "EEVEE"):
    splat_preview.prepare_render(scene, False, renderer)
    back.hide_render = front.hide_render = True
    alone = point_sampled(40, 40)
    assert alone[..., 3].max() > 0.55
    back.hide_render = front.hide_render = False
    picture = point_sampled(40, 40)
    over = alone[..., :3] + (1 - alone[..., 3:]) * (0.2, 0.5, 0.8)
    assert np.allclose(picture[:, 25:, :3], over[:, 25:], atol=2e-3), renderer
    assert np.allclose(picture[:, :10, :3], (0.9, 0.1, 0.3), atol=2e-3), renderer
    back.hide_render, front.is_holdout = True, True
    picture = point_sampled(40, 40)
    assert picture[:, :10].max() < 1e-3, renderer
    assert np.allclose(picture[:, 25:], alone[:, 25:], atol=1e-3), renderer
    # Behind the splats a holdout leaves them as they are.
    back.hide_render, front.hide_render, back.is_holdout, front.is_holdout = False, True, True, False
    assert np.allclose(point_sampled(40, 40), alone, atol=2e-3), renderer
    back.is_holdout = False
""",
        tmp_path,
    )


def test_splats_cast_the_gaussians_shadow(blender, tmp_path):
    """Behind the middle of a splat of opacity .8 a fifth of a lamp's light is left: an ellipsoid casts the shadow of
    the Gaussian from every side, a rectangle in renders that of a flat disc."""
    blender.run(
        SCENE
        + """
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
camera.location, camera.data.type, camera.data.ortho_scale, scene.camera = (0, 0, 5), "ORTHO", 4, camera
scene.render.resolution_x = scene.render.resolution_y = 101
shaded(plane(0.0, 4), "ShaderNodeBsdfDiffuse")
sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
scene.collection.objects.link(sun)
sun.data.angle, sun.rotation_euler.y = 0.0, np.pi / 4  # shines down and to -x
black = one_splat(1.0, 0.1, 0.8)
black.sh[:] = -0.5 / 0.28209479
obj = splats.new_splat_object("black", black, scene.collection)
splat_preview.prepare_render(scene, display_values=False)
x = (np.arange(101) - 50) / 101 * 4 + 1.0  # from the middle of the shadow
near = abs(x) < 0.3
for facing, breadth in ((False, 0.1 / np.sqrt(0.5)), (True, 0.1)):
    splat_preview.set_input(obj, splat_preview.FACE_CAMERA, facing)
    lit = point_sampled(101, 101)[50, :, 0]
    share, expected = lit / lit[0], 1 - 0.8 * np.exp(-((x / breadth) ** 2) / 2)
    assert share[near].min() < 0.3 and np.allclose(share[near], expected[near], atol=0.01), (facing, share[near])
""",
        tmp_path,
    )
