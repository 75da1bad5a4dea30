"""Splats as Blender objects: their data, and what Cycles and EEVEE render."""

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import splats
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview
from bl_ext.user_default.swag_splatting.swag_blender.render_setup import prepare_render
from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats
from mathutils import Matrix
from pictures import (
    FIELDS,
    linked,
    load_splats,
    new_camera,
    pinhole_camera,
    random_splats,
    render_pixel_centres,
    shown_count,
)

scene = bpy.context.scene


def assert_equal(a, b):
    assert all(np.array_equal(getattr(a, name), getattr(b, name)) for name in FIELDS)
    assert a.extras.keys() == b.extras.keys(), (a.extras.keys(), b.extras.keys())
    assert all(np.array_equal(a.extras[n], b.extras[n]) and a.extras[n].dtype == b.extras[n].dtype for n in a.extras)


def round_trip(folder):
    for coefficients in (1, 4, 16):
        made = random_splats(1000, coefficients)
        obj = splats.new_splat_object("reef", made, scene.collection)
        assert splats.is_splats(obj) and not splats.is_splats(None)
        assert_equal(splats.read_splats(obj), made)
    # Another number of splats in the same object.
    obj.location = (1, 2, 3)
    data_name, modifiers = obj.data.name, [m.name for m in obj.modifiers]
    for count in (1, 1500, 700):
        made = random_splats(count, 4, seed=count)
        splats.replace_splats(obj, made)
        assert_equal(splats.read_splats(obj), made)
    assert obj.data.name == data_name and [m.name for m in obj.modifiers] == modifiers
    assert tuple(obj.location) == (1, 2, 3)
    assert len(bpy.data.pointclouds) == 3 and len(bpy.data.scenes) == 1 and len(bpy.data.meshes) == 0
    assert {a.name for a in obj.data.attributes} >= {"scale", "rotation", "radius", "radiance:base", "radiance:sh_2"}
    assert obj.data.attributes["rotation"].data_type == "QUATERNION"
    # Saved and opened again.
    name = obj.name
    bpy.ops.wm.save_as_mainfile(filepath=folder + "/splats.blend")
    bpy.ops.wm.open_mainfile(filepath=folder + "/splats.blend")
    assert_equal(splats.read_splats(bpy.data.objects[name]), made)


def render_one_ellipsoid(folder):
    """Render a splat of sigma 0.1 and opacity 0.8 from the front, as an ellipsoid and as a rectangle."""
    one = Splats(
        np.zeros((1, 3), "f4"),
        np.array([[1, 0, 0, 0]], "f4"),
        np.full((1, 3), 0.1, "f4"),
        np.array([0.8], "f4"),
        np.full((1, 1, 3), 0.2 / 0.28209479, "f4"),
    )
    obj = splats.new_splat_object("one", one, scene.collection)
    camera = new_camera()
    camera.location, camera.data.type, camera.data.ortho_scale = (0, 0, 5), "ORTHO", 1
    scene.render.resolution_x = scene.render.resolution_y = 101
    splat_preview.use_shapes(obj, True)
    for facing in (False, True):
        splat_preview.prepare_render(scene, display_values=facing)
        splat_preview.use_shapes(obj, True)
        splat_preview.set_input(obj, splat_preview.FACE_CAMERA, facing)
        np.save(f"{folder}/{facing}.npy", render_pixel_centres())


def render_heap(folder, renderer, moved, matrix):
    """Render heap.npz of the folder; `moved` is nothing, "together" with the camera, or "uneven" by the matrix."""
    root = pinhole_camera(160, 100, 150.0)
    obj = splats.new_splat_object("heap", load_splats(folder + "/heap.npz"), scene.collection, root)
    if moved == "uneven":
        obj.parent = linked("shear")
        obj.matrix_parent_inverse = Matrix(matrix)
    if moved == "together":
        root.matrix_world = splats.FILE_FRAME
        root.rotation_euler.z = 0.7
        root.location = (3, 1, -2)
        root.scale = (2, 2, 2)
    splat_preview.prepare_render(scene, display_values=True, engine=renderer)
    splat_preview.set_input(obj, splat_preview.PIXEL_SIZE, 1 / 150)
    assert renderer in scene.render.engine
    assert scene.view_settings.view_transform == "Raw"
    np.save(folder + "/render.npy", render_pixel_centres())


def render_two_in_linear_light(folder, colors):
    """Render two splats behind each other whose display colors are `colors` (2, 3)."""
    two = Splats(
        np.array([[0, 0, 4], [0, 0, 5]], "f4"),
        np.array([[1, 0, 0, 0]] * 2, "f4"),
        np.full((2, 3), 2.0, "f4"),
        np.array([0.6, 0.9], "f4"),
        ((np.array(colors) - 0.5) / 0.28209479177387814)[:, None].astype("f4"),
    )
    root = pinhole_camera(33, 33, 400.0)
    obj = splats.new_splat_object("two", two, scene.collection, root)
    splat_preview.use_shapes(obj, True)
    splat_preview.prepare_render(scene, display_values=False)
    assert scene.view_settings.view_transform == "Standard"
    np.save(folder + "/render.npy", render_pixel_centres())


def render_background(color):
    """The color of an empty render with display values and with linear light, by the name of the first."""
    pinhole_camera(9, 9, 20.0)
    obj = splats.new_splat_object("behind", random_splats(1, 1), scene.collection)
    obj.location.y = 50
    splat_preview.remember_training(obj, 0.01, color)
    found = {}
    for display in (True, False):
        prepare_render(scene, display, "CYCLES")
        assert render_pixel_centres()[..., 3].max() == 0
        found["display" if display else "light"] = render_pixel_centres(transparent=False)[0, 0, :3].tolist()
    return found


def show_points_or_splats():
    made = random_splats(500, 4)
    obj = splats.new_splat_object("reef", made, scene.collection)

    def shown_radius():
        radius = np.empty(500, "f4")
        bpy.context.view_layer.update()
        shown = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        shown.attributes["radius"].data.foreach_get("value", radius)
        return radius

    # The extension draws the splats itself; Blender draws the box of their points, which have no size as shapes.
    assert obj.display_type == "BOUNDS"
    splat_preview.use_shapes(obj, True)
    assert shown_count() == 0 and not shown_radius().any()
    obj.swag_display.style = "POINTS"
    # Transparent and elongated splats are drawn small, so as not to hide others; the stored radius is unchanged.
    assert shown_count() == 0 and obj.display_type == "TEXTURED"
    assert np.allclose(shown_radius(), 1.5 * np.median(made.scales, 1) * made.opacities, atol=1e-6)
    radius = np.empty(500, "f4")
    obj.data.attributes["radius"].data.foreach_get("value", radius)
    assert np.allclose(radius, made.scales.mean(1), atol=1e-6)
    obj.swag_display.density = 40
    assert 150 < len(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.points) < 250
    obj.swag_display.density = 100
    # In Rendered shading Cycles and EEVEE draw the shapes that renders have.
    splat_preview.set_input(obj, splat_preview.RENDERED_IN_VIEWPORT, True)
    assert shown_count() == 500
