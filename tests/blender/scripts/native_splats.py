"""Splats that Blender 5.3 draws itself: what the nodes give it, and files of other versions."""

import contextlib
import io
import types
from typing import Any

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import colors, display_panel, file_versions, labels, splats, water
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_colors, splat_preview
from bl_ext.user_default.swag_splatting.swag_engine.splats.development import Development
from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats
from mathutils import Matrix
from pictures import linked, load_splats, new_camera, pinhole_camera, random_splats, render_pixel_centres, shown_count

bpy.context.preferences.edit.use_global_undo = True
scene = bpy.context.scene
SH_0 = 0.28209479177387814
WATER = {
    "beta_D": [0.2, 0.1, 0.05],
    "beta_B": [0.1] * 3,
    "background_sh": [[0.1] * 3] * 9,
    "light": "linear",
    "per": "unit",
}


def shown_colors(obj):
    """sRGB colors (N, 3) that the nodes give Blender, where they give one for all directions."""
    splat_preview.set_input(obj, splat_preview.RENDERED_IN_VIEWPORT, True)
    bpy.context.view_layer.update()
    data = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    assert data.type == "GAUSSIAN_SPLAT" and "radiance:sh_0" not in data.attributes
    return splats.splats_of(data).sh[:, 0].astype("f8") * SH_0 + 0.5


def colored_splats(folder, values, amount):
    """Show heap.npz through water from two cameras; writes the colors that the nodes give as colors.npz."""
    root = pinhole_camera(160, 100, 150.0)
    obj = splats.new_splat_object("heap", load_splats(folder + "/heap.npz"), scene.collection, root)
    water.remember_water(obj, values, 0.0)
    scene.swag.water = amount
    first, second = scene.camera, linked("second", bpy.data.cameras.new("second"))
    second.location = (3, 1, -2)
    found = {"first": shown_colors(obj)}
    scene.camera = second
    found["second"] = shown_colors(obj)
    scene.camera = first
    # Animated: half of the amount at frame 11.
    for frame, value in ((1, amount), (21, 0.0)):
        scene.swag.water = value
        scene.swag.keyframe_insert("water", frame=frame)
    for layer in scene.animation_data.action.layers:
        for strip in layer.strips:
            for curve in strip.channelbags[0].fcurves:
                for key in curve.keyframe_points:
                    key.interpolation = "LINEAR"
    scene.frame_set(11)
    found["animated"] = shown_colors(obj)
    np.savez(folder + "/colors.npz", **found)


def labels_hidden_crop_and_density():
    made = random_splats(400, 16)
    obj = splats.new_splat_object("reef", made, scene.collection)
    splat_preview.set_input(obj, splat_preview.RENDERED_IN_VIEWPORT, True)
    own = obj.swag_display
    # Nothing depends on the camera: Blender gets all coefficients.
    bpy.context.view_layer.update()
    data = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    assert np.array_equal(splats.splats_of(data).sh, made.sh)
    own.sh_degree = 0
    assert np.allclose(shown_colors(obj), np.maximum(0.5 + SH_0 * made.sh[:, 0], 0), atol=1e-5)
    labels.select(obj, np.arange(400) < 100)
    tint = np.array(labels.SELECTED_COLOR)
    display = np.where(tint[:3] <= 0.0031308, tint[:3] * 12.92, 1.055 * tint[:3] ** (1 / 2.4) - 0.055)
    plain = np.maximum(0.5 + SH_0 * made.sh[:100, 0], 0)
    assert np.allclose(shown_colors(obj)[:100], plain + (display - plain) * tint[3], atol=1e-5)
    splats.select_only(bpy.context, [obj])
    bpy.ops.swag.hide_splats()
    assert shown_count() == 300
    bpy.ops.swag.reveal_splats()
    own.density = 25
    assert 60 < shown_count() < 140
    own.density = 100
    bpy.ops.swag.add_crop_box()
    own.crop.scale = (0.3, 0.3, 0.3)
    bpy.context.view_layer.update()
    assert 0 < shown_count() < 200


def developed():
    """Viewports develop each splat; a render that is set up is developed by the compositor alone."""
    made = random_splats(200, 1)
    obj = splats.new_splat_object("reef", made, scene.collection)
    known = Development(0.7, (1.1, 1.0, 0.8), 1.2, ((0.9, 0.1, 0), (0, 1, 0), (0.1, 0, 0.9)), 0.8)
    colors.remember_developments(obj, {"auto": known.to_json()})
    scene.swag_colors.exposure = -0.5
    plain = np.maximum(0.5 + SH_0 * made.sh[:, 0], 0)
    knee_off = colors.color_view(scene, obj).at(0.0)
    wanted = Development(knee_off.exposure, knee_off.white, knee_off.contrast, knee_off.matrix).apply(plain)
    assert np.allclose(shown_colors(obj), wanted, atol=2e-4), abs(shown_colors(obj) - wanted).max()
    bpy.ops.swag.prepare_render(display_values=False)
    bpy.context.view_layer.update()
    data = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    assert np.array_equal(splats.splats_of(data).sh, made.sh)


def pane(color=(0.8, 0.2, 0.5)):
    """A wide opaque splat of one sRGB color."""
    return Splats(
        np.array([[0, 0, 4]], "f4"), np.array([[0.9, 0.3, 0.2, 0.2]], "f4") / np.float32(np.sqrt(0.98)),
        np.array([[3, 2, 2.5]], "f4"), np.array([1], "f4"), ((np.array(color) - 0.5) / SH_0)[None, None].astype("f4"),
    )  # fmt: skip


def rendered_color():
    """Linear color and alpha of the middle of a render by Cycles."""
    splat_preview.prepare_render(scene, display_values=False)
    return render_pixel_centres()[8:24, 8:24].reshape(-1, 4).max(axis=0).tolist()


def renders(folder, values):
    """Cycles draws the colors of the nodes: as they are, through water, of a copy, an instance, and linked objects."""
    root = pinhole_camera(32, 32, 100.0)
    obj = splats.new_splat_object("pane", pane(), scene.collection, root)
    found = {"own": rendered_color()}
    water.remember_water(obj, values, 0.0)
    scene.swag.water = 1.0
    found["water"] = rendered_color()
    copy = obj.copy()
    scene.collection.objects.link(copy)
    obj.hide_render = True
    found["linked copy"] = rendered_color()
    copy.data = obj.data.copy()
    found["copy"] = rendered_color()
    bpy.data.objects.remove(copy)
    hidden = bpy.data.collections.new("hidden")
    scene.collection.children.link(hidden)
    scene.collection.objects.unlink(obj)
    hidden.objects.link(obj)
    obj.hide_render = False
    bpy.context.view_layer.layer_collection.children["hidden"].exclude = True
    instance = linked("instance")
    instance.instance_type, instance.instance_collection = "COLLECTION", hidden
    found["instance"] = rendered_color()
    labels.set_attribute(obj, splat_colors.HIDDEN, "BOOLEAN", np.ones(1, bool))
    found["hidden"] = rendered_color()
    labels.set_attribute(obj, splat_colors.HIDDEN, "BOOLEAN", np.zeros(1, bool))
    bpy.data.libraries.write(folder + "/pane.blend", {obj})
    for link in (True, False):
        bpy.ops.wm.read_homefile(use_empty=True)
        new_scene = bpy.context.scene
        globals()["scene"] = new_scene
        pinhole_camera(32, 32, 100.0)
        with bpy.data.libraries.load(folder + "/pane.blend", link=link) as (there, here):
            here.objects = ["pane"]
        new_scene.collection.objects.link(here.objects[0])
        found["linked" if link else "appended"] = rendered_color()
    return found


def save(folder, version, display_values):
    """Save splats with water, hidden splats and a crop box."""
    made = random_splats(300, 16)
    obj = splats.new_splat_object("reef", made, scene.collection)
    water.remember_water(obj, WATER, 0.0)
    splat_preview.set_input(obj, splat_preview.BLEND_DISPLAY, display_values)
    if display_values:
        splat_preview.use_shapes(obj, True)
    obj.swag_display.density = 90
    labels.select(obj, np.arange(300) < 50)
    splats.select_only(bpy.context, [obj])
    bpy.ops.swag.hide_splats()
    box = linked("box")
    box.empty_display_type, box.empty_display_size = "CUBE", 30
    obj.swag_display.crop = box
    bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/{version}.blend")


def open_other(path, native):
    """Open what another version saved; everything is as there, and drawn as this version does."""
    made = random_splats(300, 16)
    bpy.ops.wm.open_mainfile(filepath=path)
    obj, swag = bpy.data.objects["reef"], bpy.context.scene.swag
    back = splats.read_splats(obj)
    for name in ("positions", "rotations", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(back, name), getattr(made, name)), name
    assert splat_preview.is_native(obj) == native and splat_preview.has_current_nodes(obj)
    if splat_preview.HAS_NATIVE:
        assert obj.data.type == "GAUSSIAN_SPLAT" and obj.data.attributes["radiance:base"].data_type == "FLOAT4"
    splat_preview.set_input(obj, splat_preview.RENDERED_IN_VIEWPORT, True)
    assert 200 < shown_count() < 250, "hidden splats and density"
    obj.swag_display.crop.scale = (0.01, 0.01, 0.01)
    bpy.context.view_layer.update()
    assert shown_count() < 20, "the crop box"
    swag.water = 0.4
    bpy.context.view_layer.update()
    assert abs(splat_preview.read_inputs(obj)[splat_colors.WATER] - 0.4) < 1e-6
    assert np.allclose(splat_preview.read_inputs(obj)["Attenuation"], (0.2, 0.1, 0.05))


def undo_of_the_update(path):
    """The update of a file of an earlier version is said, and undo takes it back."""
    handlers = bpy.app.handlers.load_post
    handlers.remove(file_versions._after_load)
    try:
        bpy.ops.wm.open_mainfile(filepath=path)
    finally:
        handlers.append(file_versions._after_load)
    bpy.ops.ed.undo_push(message="opened")
    (sentence,) = file_versions.update_all()
    assert sentence.startswith("Blender now draws these splats itself: reef. Undo brings back"), sentence
    assert file_versions.update_all() == []
    bpy.ops.ed.undo_push(message="Update Splats")
    assert splat_preview.is_native(bpy.data.objects["reef"])
    bpy.ops.ed.undo()
    obj = bpy.data.objects["reef"]
    assert not splat_preview.is_native(obj) and obj.data.type == "POINTS"


def open_without_colors(path):
    """Blender 4.5 cannot read the colors of a file of 5.3, and says so."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        bpy.ops.wm.open_mainfile(filepath=path)
    assert not splats.is_splats(bpy.data.objects["reef"])
    return printed.getvalue()


def imported_by_blender(path):
    """What Blender's importer makes gets the panel, and its nodes with the first change."""
    bpy.ops.wm.ply_import(filepath=path)
    obj = bpy.context.object
    assert splats.is_splats(obj) and obj.data.type == "GAUSSIAN_SPLAT" and splat_preview.modifier_of(obj) is None
    assert display_panel.SWAG_PT_display.poll(bpy.context) and splat_preview.is_native(obj)
    count = splats.count(obj)
    labels.select(obj, np.arange(count) < 10)
    bpy.ops.swag.hide_splats()
    splat_preview.set_input(obj, splat_preview.RENDERED_IN_VIEWPORT, True)
    assert shown_count() == count - 10
    assert water.water_of(obj) is None
    obj.swag_display.exact = True
    assert not splat_preview.is_native(obj)
    return count


def draw_like_a_viewport(obj, width, height, floor):
    """Draw a splat object through the scene's camera, behind Blender's floor grid or without; linear RGB (H, W, 3)."""
    import gpu
    from bl_ext.user_default.swag_splatting.swag_blender.viewport.drawing import ViewportDrawing

    gpu.init()
    bpy.context.view_layer.update()
    scene, camera = bpy.context.scene, bpy.context.scene.camera
    projection = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=width, y=height)
    view = camera.matrix_world.inverted()
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    region = next(region for region in area.regions if region.type == "WINDOW")
    space = area.spaces.active
    space.shading.background_type, space.shading.background_color = "VIEWPORT", (0, 0, 0)
    space.overlay.show_extras = False  # the camera's own lines
    space.overlay.show_floor = space.overlay.show_axis_x = space.overlay.show_axis_y = floor

    class Context:
        """The context of a viewport of that size and view."""

        region = types.SimpleNamespace(width=width, height=height, as_pointer=lambda: 1)
        region_data = types.SimpleNamespace(
            window_matrix=projection, view_matrix=view, use_clip_planes=False, clip_planes=[]
        )
        space_data = space

        def __getattr__(self, name):
            return getattr(bpy.context, name)

    picture = gpu.types.GPUOffScreen(width, height, format="RGBA16F")
    bound: Any = picture.bind()
    with bpy.context.temp_override(window=window, area=area):
        if floor:
            picture.draw_view3d(
                scene, bpy.context.view_layer, space, region, view, projection, do_color_management=True
            )
        with bound:
            framebuffer = gpu.state.active_framebuffer_get()
            if not floor:
                framebuffer.clear(color=(0, 0, 0, 1), depth=1.0)
            ViewportDrawing().draw(Context(), [obj])
            drawn = framebuffer.read_color(0, 0, width, height, 4, 0, "FLOAT").to_list()
    return np.maximum(np.array(drawn)[::-1, :, :3], 0)


def empty_startup_file():
    bpy.ops.wm.read_homefile(use_empty=False)
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)


def own_drawing(folder, width, height, focal):
    """Draw heap.npz as a viewport does, into a picture of its own; writes display values as drawn.npy."""
    empty_startup_file()
    root = pinhole_camera(width, height, focal)
    obj = splats.new_splat_object("heap", load_splats(folder + "/heap.npz"), bpy.context.scene.collection, root)
    splat_preview.remember_training(obj, 1 / focal, [0, 0, 0])
    # Blender shows its overlays with this gamma.
    np.save(folder + "/drawn.npy", draw_like_a_viewport(obj, width, height, False) ** (1 / 2.2))


def own_drawing_behind_the_floor(folder):
    """Draw an opaque splat that fills the view behind the floor's grid, and the same beside a mesh in the floor."""
    empty_startup_file()
    camera = new_camera()
    camera.location, camera.rotation_euler = (0, -6, 3), (1.1, 0, 0)
    obj = splats.new_splat_object("pane", pane(), bpy.context.scene.collection)

    def fill_the_view(distance):
        bpy.context.view_layer.update()
        far = Matrix.Translation((0, 0, -distance)) @ Matrix.Scale(distance / 5, 4)
        obj.matrix_world = camera.matrix_world @ far

    fill_the_view(100)
    found = {"alone": draw_like_a_viewport(obj, 160, 120, False), "grid": draw_like_a_viewport(obj, 160, 120, True)}
    mesh = bpy.data.meshes.new("floor")
    mesh.from_pydata([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [], [(0, 1, 2, 3)])
    linked("floor", mesh)
    found["mesh"] = draw_like_a_viewport(obj, 160, 120, True)
    bpy.data.meshes.remove(mesh)
    # Near the horizon, lines of the grid are next to each other.
    camera.location, camera.rotation_euler = (0, -6, 1.5), (1.53, 0, 0.2)
    camera.data.clip_start, camera.data.clip_end = 0.015, 1500
    fill_the_view(1400)
    found["horizon alone"] = draw_like_a_viewport(obj, 640, 360, False)
    found["horizon"] = draw_like_a_viewport(obj, 640, 360, True)
    np.savez(folder + "/floor.npz", **found)
