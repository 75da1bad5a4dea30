"""Splats as Blender objects: their data, and what Cycles and EEVEE draw of them."""

import numpy as np
import pytest

from tests.blender.splat_pictures import SETUP, drawn_by_the_engine, heap, psnr


def test_what_goes_in_comes_out_bit_for_bit(blender):
    blender.run(
        SETUP
        + """
def equal(a, b):
    fields = ("positions", "rotations", "scales", "opacities", "sh")
    assert all(np.array_equal(getattr(a, n), getattr(b, n)) for n in fields)
    assert a.extras.keys() == b.extras.keys(), (a.extras.keys(), b.extras.keys())
    assert all(np.array_equal(a.extras[n], b.extras[n]) and a.extras[n].dtype == b.extras[n].dtype for n in a.extras)

for coefficients in (1, 4, 16):
    made = random_splats(1000, coefficients)
    obj = splats.new_splat_object("reef", made, scene.collection)
    assert splats.is_splats(obj) and not splats.is_splats(None)
    equal(splats.read_splats(obj), made)
# Another number of splats, in place.
obj.location = (1, 2, 3)
data_name, modifiers = obj.data.name, [m.name for m in obj.modifiers]
for count in (1, 1500, 700):
    made = random_splats(count, 4, seed=count)
    splats.replace_splats(obj, made)
    equal(splats.read_splats(obj), made)
assert obj.data.name == data_name and [m.name for m in obj.modifiers] == modifiers and tuple(obj.location) == (1, 2, 3)
assert len(bpy.data.pointclouds) == 3 and len(bpy.data.scenes) == 1 and len(bpy.data.meshes) == 0
assert {a.name for a in obj.data.attributes} >= {"scale", "rotation", "radius", "radiance:base", "radiance:sh_2"}
assert obj.data.attributes["rotation"].data_type == "QUATERNION"
# Saved and opened again.
name = obj.name
bpy.ops.wm.save_as_mainfile(filepath=bpy.app.tempdir + "splats.blend")
bpy.ops.wm.open_mainfile(filepath=bpy.app.tempdir + "splats.blend")
equal(splats.read_splats(bpy.data.objects[name]), made)
        """
    )


def test_an_ellipsoid_has_the_gaussians_alpha(blender, tmp_path):
    """The solid form, from the front: alpha = opacity exp(-r^2 / 2 sigma^2); BT.709 linear light of display grey .7."""
    blender.run(
        SETUP
        + """
one = Splats(np.zeros((1, 3), "f4"), np.array([[1, 0, 0, 0]], "f4"), np.full((1, 3), 0.1, "f4"), np.array([0.8], "f4"),
             np.full((1, 1, 3), 0.2 / 0.28209479, "f4"))
obj = splats.new_splat_object("one", one, scene.collection)
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
camera.location, camera.data.type, camera.data.ortho_scale, scene.camera = (0, 0, 5), "ORTHO", 1, camera
scene.render.resolution_x = scene.render.resolution_y = 101
for facing in (False, True):
    splat_preview.prepare_render(scene, display_values=facing)
    splat_preview.set_input(obj, splat_preview.FACE_CAMERA, facing)
    np.save(f"{sys.argv[-1]}/{facing}.npy", point_sampled(101, 101))
        """,
        tmp_path,
    )
    sigmas = np.arange(26) / 101 / 0.1
    for facing, colour in ((False, ((0.7 + 0.055) / 1.055) ** 2.4), (True, 0.7)):
        row = np.load(tmp_path / f"{facing}.npy")[50, 50:76]
        assert np.allclose(row[:, 3], 0.8 * np.exp(-(sigmas**2) / 2), atol=1e-3), facing
        assert np.allclose(row[:, :3] / row[:, 3:], colour, atol=1e-4), facing


# Turned, squeezed and sheared about the heap's middle.
UNEVEN = np.array([[1.6, 0.5, 0, -1], [-0.2, 0.5, 0.1, 0.5], [0.1, 0.3, 0.8, 2], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("renderer", "moved"), [("CYCLES", "still"), ("CYCLES", "together"), ("CYCLES", "uneven"), ("EEVEE", "uneven")]
)
def test_renders_are_the_engines_picture(blender, tmp_path, renderer, moved):
    """Display values, a camera with shift: equal to the rasteriser, also when scene and splats are turned together
    or the splats alone are scaled unevenly and sheared."""
    np.savez(tmp_path / "heap.npz", **heap())
    blender.run(
        SETUP
        + f"""
renderer, moved, uneven = "{renderer}", "{moved}", {UNEVEN.tolist()}
"""
        + """
view(160, 100, 150.0)
obj = splats.new_splat_object("heap", saved(sys.argv[1]), scene.collection, bpy.data.objects["root"])
if moved == "uneven":
    obj.parent = bpy.data.objects.new("shear", None)
    scene.collection.objects.link(obj.parent)
    from mathutils import Matrix
    obj.matrix_parent_inverse = Matrix(uneven)
if moved == "together":
    bpy.data.objects["root"].matrix_world = splats.FILE_FRAME
    bpy.data.objects["root"].rotation_euler.z = 0.7
    bpy.data.objects["root"].location = (3, 1, -2)
    bpy.data.objects["root"].scale = (2, 2, 2)
splat_preview.prepare_render(scene, display_values=True, engine=renderer)
splat_preview.set_input(obj, splat_preview.PIXEL_SIZE, 1 / 150)
assert renderer in scene.render.engine
assert scene.view_settings.view_transform == "Raw"
np.save(sys.argv[-1] + "/render.npy", point_sampled(160, 100))
        """,
        tmp_path / "heap.npz",
        tmp_path,
    )
    render = np.load(tmp_path / "render.npy")
    matrix = UNEVEN if moved == "uneven" else None
    color, alpha = drawn_by_the_engine(heap(), 160, 100, 150.0, matrix=matrix)
    print(psnr(render[..., :3], color), psnr(render[..., 3], alpha))
    assert psnr(render[..., :3], color) > 55 and psnr(render[..., 3], alpha) > 55


def test_linear_light_blends_light(blender, tmp_path):
    """Two splats over each other: the one behind shows through as light, after the sRGB curve."""
    blender.run(
        SETUP
        + """
colors = np.array([[0.9, 0.2, 0.03], [0.1, 0.8, 0.5]])
two = Splats(np.array([[0, 0, 4], [0, 0, 5]], "f4"), np.array([[1, 0, 0, 0]] * 2, "f4"), np.full((2, 3), 2.0, "f4"),
             np.array([0.6, 0.9], "f4"), ((colors - 0.5) / 0.28209479177387814)[:, None].astype("f4"))
view(33, 33, 400.0)
splats.new_splat_object("two", two, scene.collection, bpy.data.objects["root"])
splat_preview.prepare_render(scene, display_values=False)
assert scene.view_settings.view_transform == "Standard"
np.save(sys.argv[-1] + "/render.npy", point_sampled(33, 33))
        """,
        tmp_path,
    )
    display = np.array([[0.9, 0.2, 0.03], [0.1, 0.8, 0.5]])
    light = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    middle = np.load(tmp_path / "render.npy")[18, 13]
    assert np.allclose(middle[:3], 0.6 * light[0] + 0.4 * 0.9 * light[1], atol=1e-3)
    assert middle[3] == pytest.approx(1 - 0.4 * 0.1, abs=1e-3)


def test_background_of_the_training_is_behind_the_splats(blender, tmp_path):
    blender.run(
        SETUP
        + """
view(9, 9, 20.0)
obj = splats.new_splat_object("behind", random_splats(1, 1), scene.collection)
obj.location.y = 50
splat_preview.remember_training(obj, 0.01, [0.2, 0.02, 0.9])
for display in (True, False):
    splat_preview.prepare_render(scene, display)
    pixels = point_sampled(9, 9)
    assert pixels[..., 3].max() == 0
    scene.render.film_transparent = False
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    np.save(f"{sys.argv[-1]}/{display}.npy", np.array(image.pixels[:3]))
    bpy.data.images.remove(image)
        """,
        tmp_path,
    )
    display = np.array([0.2, 0.02, 0.9])
    light = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    assert np.allclose(np.load(tmp_path / "True.npy"), display, atol=1e-4)
    assert np.allclose(np.load(tmp_path / "False.npy"), light, atol=1e-4)


def test_viewport_shows_points_or_splats(blender):
    blender.run(
        SETUP
        + """
made = random_splats(500, 4)
obj = splats.new_splat_object("reef", made, scene.collection)
def shown():
    graph = bpy.context.evaluated_depsgraph_get()
    graph.update()
    return sum(i.is_instance for i in graph.object_instances)
assert shown() == 0
# Faint and long ones small, or they would hide what is behind them; what exporters read stays.
radius = np.empty(500, "f4")
obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.attributes["radius"].data.foreach_get("value", radius)
assert np.allclose(radius, 1.5 * np.median(made.scales, 1) * made.opacities, atol=1e-6)
obj.data.attributes["radius"].data.foreach_get("value", radius)
assert np.allclose(radius, made.scales.mean(1), atol=1e-6)
splat_preview.set_input(obj, splat_preview.POINTS_IN_VIEWPORT, False)
assert shown() == 500
        """
    )
