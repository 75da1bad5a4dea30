"""Development of the colors of splats: sliders, renders, films and exported files."""

import json
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import (
    colors,
    film,
    open_run,
    restored_photos,
    splat_export,
    splats,
    water,
)
from bl_ext.user_default.swag_splatting.swag_blender.nodes import development_nodes, splat_preview
from bl_ext.user_default.swag_splatting.swag_blender.render_setup import prepare_render
from bl_ext.user_default.swag_splatting.swag_engine.base.transfer import linear_to_srgb
from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply
from bl_ext.user_default.swag_splatting.swag_engine.formats.run_folder import RunFolder
from bl_ext.user_default.swag_splatting.swag_engine.splats.develop_splats import bake_development
from bl_ext.user_default.swag_splatting.swag_engine.splats.development import Development
from files import refusal
from panels import RecordingPanel, context_of_a_sidebar
from pictures import load_splats, new_camera, pinhole_camera, psnr, random_splats, render_pixel_centres

scene = bpy.context.scene
AUTO = Development(0.7, (1.1, 1.0, 0.8), knee=0.8)


def new_splats(made, root=None):
    """A splat object whose run has the development AUTO."""
    obj = splats.new_splat_object("reef", made, scene.collection, root)
    obj[colors.KEY] = json.dumps({"auto": AUTO.to_json()})
    return obj


def heap(folder):
    root = pinhole_camera(160, 100, 150.0)
    return new_splats(load_splats(folder + "/heap.npz"), root)


def sliders():
    """What the sliders do with and without a run, how it fades with the water, and the reset."""
    own = scene.swag_colors
    assert own.develop == "auto" and colors.picture_development(scene, None) == Development()
    obj = new_splats(random_splats(10, 1))
    assert colors.picture_development(scene, None) == colors.picture_development(scene, obj) == AUTO
    scene.swag.water = 1.0
    assert colors.picture_development(scene, obj) == AUTO, "these splats have no water"
    obj[water.KEY] = "{}"
    assert colors.picture_development(scene, obj) == Development()
    own.exposure, own.temperature, own.contrast = 1.0, 0.25, 1.25
    at_sea = colors.picture_development(scene, obj)
    assert at_sea.exposure == 1 and abs(at_sea.contrast - 1.25) < 1e-6 and at_sea.white[0] > 1 > at_sea.white[2]
    scene.swag.water = 0.0
    both = colors.picture_development(scene, obj)
    assert np.allclose(both.gains, at_sea.gains @ AUTO.gains) and both.knee == AUTO.knee
    own.develop = "none"
    assert colors.picture_development(scene, obj) == at_sea
    assert bpy.ops.swag.reset_colors() == {"FINISHED"}
    assert (own.develop, own.exposure, own.temperature, own.tint, own.contrast) == ("auto", 0, 0, 0, 1)


def render_developed(folder):
    """Render heap.npz of the folder, developed, in display values."""
    obj = heap(folder)
    scene.swag_colors.contrast = 1.2
    prepare_render(scene, display_values=True, engine="CYCLES")
    splat_preview.set_input(obj, splat_preview.PIXEL_SIZE, 1 / 150)
    np.save(folder + "/render.npy", render_pixel_centres())
    return colors.picture_development(scene, obj).to_json()


def render_follows_sliders_and_water():
    """Renders in linear light, against the formula on a render without development."""
    new_camera().location = (0, 0, 6)
    scene.render.resolution_x = scene.render.resolution_y = 24
    obj = new_splats(random_splats(20, 1))
    values = {"beta_D": [0.1, 0.05, 0.03], "beta_B": [0.1] * 3, "background_sh": [[0.3] * 3] * 9, "light": "linear"}
    water.remember_water(obj, values | {"per": "unit"}, 0.0)
    own = scene.swag_colors
    plain = {}
    scene.world = bpy.data.worlds.new("World")
    scene.world.cycles.sampling_method = "NONE"  # its map of the open water takes seconds
    own.develop = "none"
    prepare_render(scene, display_values=False, engine="CYCLES")
    assert scene.get(development_nodes.GROUP_KEY) is None, "nothing to develop, no nodes"
    for amount in (0.0, 0.5, 1.0):
        scene.swag.water = amount
        plain[amount] = render_pixel_centres(transparent=False)[..., :3]
    own.develop = "auto"
    prepare_render(scene, display_values=False, engine="CYCLES")
    prepare_render(scene, display_values=False, engine="CYCLES")  # once more: the nodes are not doubled
    for amount, exposure, least in ((0.0, 0.0, 60), (0.5, 0.0, 60), (1.0, 0.0, 60), (1.0, -1.0, 60)):
        scene.swag.water, own.exposure = amount, exposure
        found = render_pixel_centres(transparent=False)[..., :3]
        wanted = colors.picture_development(scene, obj).apply(linear_to_srgb(plain[amount].astype("f8")))
        same = psnr(linear_to_srgb(found), wanted)
        assert same > least, (amount, exposure, same)
        if (amount, exposure) != (1.0, 0.0):
            assert psnr(found, plain[amount]) < same - 20
    own.develop, own.exposure = "none", 0.0
    prepare_render(scene, display_values=False, engine="CYCLES")
    assert scene.get(development_nodes.GROUP_KEY) is None and not [
        tree for tree in bpy.data.node_groups if tree.name.startswith(development_nodes.NAME)
    ]
    assert psnr(render_pixel_centres(transparent=False)[..., :3], plain[1.0]) > 60


def film_and_files(folder):
    """What a film is asked for, and exported splats with and without development."""
    made = random_splats(50, 4)
    obj = new_splats(made)
    new_camera()
    bpy.ops.object.select_all(action="DESELECT")
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj
    scene.swag_film.output = folder
    scene.swag_colors.exposure = 0.5
    request = film.film_request(bpy.context, Path(folder))
    view = colors.color_view(scene, obj)
    assert request["colors"] == view.to_json()
    for develop in (True, False):
        path = f"{folder}/{develop}.ply"
        assert bpy.ops.swag.export_splats(filepath=path, frame="Z_UP", develop=develop) == {"FINISHED"}
        wanted = bake_development(made, view.at(0.0)) if develop else made
        assert np.allclose(read_ply(Path(path)).sh[:, 0], wanted.sh[:, 0], atol=1e-5), develop
    for develop in (True, False):
        assert bpy.ops.swag.import_splats(filepath=f"{folder}/{develop}.ply") == {"FINISHED"}
        opened = bpy.context.active_object
        assert np.allclose(splats.splats_of(opened.data).sh[:, 0], made.sh[:, 0], atol=1e-4), develop
        assert colors.color_view(scene, opened).restored == view.at(0.0), develop
    other = splats.new_splat_object("other", made, scene.collection, None)
    other.select_set(True)
    obj.select_set(True)
    _, notes = splat_export.save_splats(bpy.context, Path(folder, "both.ply"), splat_export.ExportSettings())
    assert "different developments" in notes[0] and read_ply(Path(folder, "both.ply")).development is None
    return request["colors"]


def open_run_with_development(run):
    """The development of a run that is opened, and what a damaged one says."""
    folder = RunFolder(Path(run))
    folder.write_development(AUTO.to_json() | {"note": ""})
    open_run.open_run(bpy.context, folder.path)
    found = colors.picture_development(scene, bpy.context.active_object)
    assert found == AUTO and colors.has_development(bpy.context.active_object, "auto")
    folder.write_development({"exposure": 0})
    return refusal(bpy.ops.swag.open_run, directory=run)


def restore_photos(run):
    """Messages and the panel before and after photos are restored."""
    obj = new_splats(random_splats(5, 1))
    splats.select_only(bpy.context, [obj])
    scene.swag_colors.exposure = 1.0
    panel = restored_photos.SWAG_PT_restored_photos
    found = {"no run": refusal(bpy.ops.swag.restore_photos), "shown": panel.poll(context_of_a_sidebar())}
    obj["swag_run"] = run
    assert panel.poll(context_of_a_sidebar())
    assert bpy.ops.swag.restore_photos() == {"FINISHED"}
    texts: list[str] = []
    panel.draw(type("Panel", (), {"layout": RecordingPanel(texts)})(), context_of_a_sidebar())
    return found | {"message": bpy.context.window_manager.swag.message, "panel": texts}
