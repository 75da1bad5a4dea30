"""Editing splats: selecting in views and by properties, hiding, deleting, undo, the crop box, floaters, reading."""

from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import clean_up as clean_up_module
from bl_ext.user_default.swag_splatting.swag_blender import (
    floaters,
    labels,
    lengths,
    picking,
    similar_splats,
    splat_selection,
    splats,
    visibility,
)
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview
from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply
from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats
from labels import assert_refused, labelled_object, show_as
from pictures import linked, new_camera, render_pixel_centres, shown_count

bpy.context.preferences.edit.use_global_undo = True
scene = bpy.context.scene
SIZE = (200, 100)


def splats_at(positions, sigma=0.05, opacity=0.9, label=1):
    positions = np.array(positions, "f4")
    count = len(positions)
    return Splats(
        positions,
        np.tile(np.array([1, 0, 0, 0], "f4"), (count, 1)),
        np.full((count, 3), sigma, "f4"),
        np.broadcast_to(np.array(opacity, "f4"), count).copy(),
        np.zeros((count, 1, 3), "f4"),
        {"label": np.broadcast_to(np.array(label, "i4"), count).copy()},
    )


def new_object(made, name="reef", location=(0, 0, 0)):
    """An object of splats, active and selected alone."""
    obj = splats.new_splat_object(name, made, scene.collection)
    obj.location = location
    splats.select_only(bpy.context, [obj])
    bpy.context.view_layer.update()
    return obj


def orthographic():
    """Matrix of a view from above: x and y from -2 to 2 and -1 to 1, z from -10 to 10; 50 pixels a unit."""
    return np.diag([0.5, 1.0, -0.1, 1.0]).ravel().tolist()


def perspective(lens=35.0, shift_x=0.0, location=(0, 0, 0), size=SIZE):
    """Matrix of a camera that looks down."""
    camera = new_camera()
    camera.location = location
    camera.data.lens, camera.data.shift_x = lens, shift_x
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    projection = camera.calc_matrix_camera(graph, x=size[0], y=size[1])
    return np.array(projection @ camera.matrix_world.inverted()).ravel().tolist()


def path(*points):
    return [{"name": "", "loc": point, "time": 0} for point in points]


def selected(obj):
    return np.flatnonzero(labels.mask_of(obj, "swag:selected")).tolist()


def select_in_views():
    # At pixels (100, 50), (150, 50), (100, 75), (50, 25) of the view from above.
    obj = new_object(splats_at([(-1, -1, 0), (0, -1, 0), (-1, -0.5, 0), (-2, -1.5, 0)]), location=(1, 1, 0))
    view = {"matrix": orthographic(), "size": SIZE}
    box, brush, lasso = bpy.ops.swag.select_box, bpy.ops.swag.select_brush, bpy.ops.swag.select_lasso
    assert box(path=path((160, 40), (90, 60)), **view) == {"FINISHED"} and selected(obj) == [0, 1]
    box(path=path((90, 70), (110, 80)), mode="EXTEND", **view)
    assert selected(obj) == [0, 1, 2]
    box(path=path((90, 40), (110, 60)), mode="SUBTRACT", **view)
    assert selected(obj) == [1, 2]
    box(path=path((0, 0), (1, 1)), **view)
    assert selected(obj) == []
    # Around the first and third, but not the second, though it is in the lasso's bounding box.
    lasso(path=path((90, 40), (160, 40), (110, 55), (110, 90), (90, 90)), **view)
    assert selected(obj) == [0, 2]
    brush(path=path((50, 30), (60, 25)), radius=6, **view)
    assert selected(obj) == [3]
    # The middle of a stroke counts, not only its ends.
    brush(path=path((90, 51), (200, 51)), radius=3, **view)
    assert selected(obj) == [0, 1]
    # A circle has its middle where the path starts, and its edge where it ends.
    bpy.ops.swag.select_circle(path=path((98, 48), (300, 300), (98, 78)), **view)
    assert selected(obj) == [0, 2]
    assert_refused(box, "Give path, matrix and size", path=path((1, 1)))

    # All selected objects, and no others.
    other = new_object(splats_at([(0.2, 0, 0)]), "other")
    third = new_object(splats_at([(0.3, 0, 0)]), "third")
    splats.select_only(bpy.context, [obj, other])
    box(path=path((0, 0), SIZE), **view)
    assert (len(selected(obj)), selected(other), selected(third)) == (4, [0], [])
    other.hide_set(True)
    bpy.ops.swag.select_all_splats(action="DESELECT")
    assert selected(obj) == [] and selected(other) == [0]


def select_around_points():
    """A sphere takes what is near a point in space, a flood what a chain of similar splats connects."""
    line = [(0.1 * i, 0, 0) for i in range(40)]  # 0 to 3.9
    made = splats_at([*line, *[(0.1 * i, 2, 0) for i in range(10)]], label=[1] * 35 + [2] * 15)
    made.sh[:, 0] = (1.5, -1.5, -1.5)
    made.sh[20:, 0] = (1.2, -1.2, -1.2)
    made.sh[25:28, 0] = (-1.5, 1.5, -1.5)  # green
    obj = new_object(made, location=(5, 0, 0))
    obj.scale = (2, 2, 2)
    bpy.context.view_layer.update()
    sphere, flood = bpy.ops.swag.select_sphere, bpy.ops.swag.select_flood
    sphere(point=(5, 0, 0), radius=1.05)
    assert selected(obj) == [0, 1, 2, 3, 4, 5]
    sphere(point=(5, 0, 0), radius=0.45, mode="SUBTRACT")
    assert selected(obj) == [3, 4, 5]
    sphere(point=(5, 4, 0), radius=0.1, mode="EXTEND")
    assert selected(obj) == [3, 4, 5, 40]
    flood(point=(5, 0, 0.1), distance=0.3, tolerance=0.2)
    assert selected(obj) == list(range(25))  # green ends it
    flood(point=(5, 0, 0.1), distance=0.3, tolerance=0.02)
    assert selected(obj) == list(range(20))
    flood(point=(5, 0, 0.1), distance=0.3, tolerance=1)
    assert selected(obj) == list(range(35))  # another label ends it
    flood(point=(5, 0, 0.1), distance=0.3, tolerance=1, same_label=False)
    assert selected(obj) == list(range(40))  # a gap ends it
    # Without a distance the sizes of the splats give it: 4 times 0.05, in an object that is scaled by 2.
    flood(point=(5, 4, 0), tolerance=1)
    assert selected(obj) == list(range(40, 50))
    assert np.isclose(similar_splats.flood(obj, 40, 1.0, 0.0, True)[1], 0.4)
    # What is hidden neither starts nor continues it.
    labels.select(obj, np.arange(50) == 10)
    bpy.ops.swag.hide_splats()
    flood(point=(5, 0, 0), distance=0.3, tolerance=0.2)
    assert selected(obj) == list(range(10))
    bpy.ops.swag.select_all_splats(action="SELECT")
    bpy.ops.swag.hide_splats()
    assert_refused(flood, "All splats are hidden", point=(5, 0, 0))


def toolbar():
    """Names of the tools of the toolbar in object mode that are ours, by groups; icons that Blender does not have."""
    from bl_ui import space_toolsystem_common

    helper: Any = space_toolsystem_common.ToolSelectPanelHelper
    panel = helper._tool_class_from_space_type("VIEW_3D")
    groups = [group for group in panel._tools["OBJECT"] if isinstance(group, tuple) and not hasattr(group, "idname")]
    tools = [[tool for tool in group if tool and tool.idname.startswith("swag.")] for group in groups]
    folder = Path(bpy.utils.system_resource("DATAFILES"), "icons")
    return {
        "groups": [[tool.idname for tool in group] for group in tools if group],
        "without icon": [tool.icon for group in tools for tool in group if not (folder / f"{tool.icon}.dat").exists()],
    }


def select_in_perspective():
    """What a camera with lens shift sees is selected; what is behind it or beyond its clipping distances is not."""
    points = np.random.default_rng(1).uniform((-3, -2, -9), (3, 2, 9), (400, 3))
    obj = new_object(splats_at(points))
    for lens, shift in ((35.0, 0.0), (50.0, 0.3)):
        matrix = perspective(lens, shift)
        camera = scene.camera
        camera.data.clip_end = 6.0
        matrix = perspective(lens, shift)
        scene.camera.data.clip_end = 6.0
        graph = bpy.context.evaluated_depsgraph_get()
        graph.update()
        matrix = np.array(scene.camera.calc_matrix_camera(graph, x=200, y=100)).ravel().tolist()
        bpy.ops.swag.select_box(path=path((0, 0), SIZE), matrix=matrix, size=SIZE)
        z = -points[:, 2]
        half = 18.0 / lens
        with np.errstate(divide="ignore"):
            x, y = points[:, 0] / z / half - 2 * shift, points[:, 1] / z / half
        expected = (z > 0.1) & (z < 6) & (np.abs(x) <= 1) & (np.abs(y) <= 0.5)
        assert 5 < expected.sum() < 200 and selected(obj) == np.flatnonzero(expected).tolist()


def select_what_is_in_front():
    """A wall hides what is behind it where Select Through is off; a faint haze does not."""
    grid = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 61), np.linspace(-0.9, 0.9, 37)), -1).reshape(-1, 2)
    wall = np.column_stack([grid, np.zeros(len(grid))])
    haze, hidden = wall + (0, 0, 1), wall + (0, 0, -1)
    opacity = np.repeat([0.95, 0.02, 0.95], len(wall))
    obj = new_object(splats_at(np.concatenate([wall, haze, hidden]), 0.04, opacity))
    for matrix in (orthographic(), perspective(50, location=(0, 0, 5))):
        view = {"matrix": matrix, "size": SIZE, "path": path((0, 0), SIZE)}
        bpy.ops.swag.select_box(**view)
        all_there = np.bincount(np.array(selected(obj)) // len(wall), minlength=3)
        assert (all_there > 0.7 * len(wall)).all()
        bpy.ops.swag.select_box(through=False, **view)
        chosen = np.bincount(np.array(selected(obj)) // len(wall), minlength=3)
        assert chosen[0] > 0.95 * all_there[0] and chosen[1] == all_there[1] and chosen[2] < 0.02 * all_there[2], chosen


def select_by_properties():
    positions = np.concatenate([np.random.default_rng(0).uniform(-1, 1, (300, 3)), [(30, 0, 0), (0, 0, -40)]])
    made = splats_at(positions, label=[1] * 100 + [2] * 202)
    made.scales[:5] = np.linspace(0.5, 0.54, 5)[:, None]
    made.opacities[10:15] = 0.01
    made.sh[20:25, 0] = (1.5, -1.5, -1.5)  # red
    obj = new_object(made)
    obj.scale = (2, 2, 2)
    bpy.context.view_layer.update()
    by = bpy.ops.swag.select_by
    by(kind="SIZE", length=0.9)
    assert selected(obj) == [0, 1, 2, 3, 4]
    by(kind="SIZE", length=1.1)
    assert selected(obj) == []
    by(kind="OPACITY", side="BELOW", fraction=0.05)
    assert selected(obj) == [10, 11, 12, 13, 14]
    by(kind="COLOR", color=(0.92, 0.08, 0.08), fraction=0.05, mode="EXTEND")
    assert selected(obj) == [10, 11, 12, 13, 14, 20, 21, 22, 23, 24]
    assert_refused(by, "No label of reef is called wreck: no labels are read yet", kind="LABEL", label="wreck")
    bpy.ops.swag.read_labels()
    obj.swag_labels.entries[1].name = "Old Wreck"
    by(kind="LABEL", label="wreck")
    assert selected(obj) == list(range(100))
    by(kind="OTHERS", length=similar_splats.usual_length(bpy.context, obj, "OTHERS"))
    assert {300, 301} <= set(selected(obj)) and len(selected(obj)) < 20
    assert_refused(by, "The scene has no cameras", kind="CAMERA", length=1)
    new_camera().location = (60, 0, 0)
    bpy.context.view_layer.update()
    by(kind="CAMERA", side="BELOW", length=5)
    assert selected(obj) == [300]
    by(kind="CAMERA", side="ABOVE", length=90)
    assert selected(obj) == [301]
    # Every kind starts with a threshold that few splats are above.
    for kind in similar_splats.LENGTHS:
        length = similar_splats.usual_length(bpy.context, obj, kind)
        bpy.ops.swag.select_by(kind=kind, length=length)
        assert 0 < len(selected(obj)) < 30, kind


def hide_delete_and_undo():
    obj, made = labelled_object([1] * 50 + [2] * 30 + [0] * 20)
    show_as(obj, splat_preview.RENDERED_IN_VIEWPORT)
    bpy.ops.swag.read_labels()
    for operator in (bpy.ops.swag.delete_splats, bpy.ops.swag.hide_splats):
        assert_refused(operator, "No splats are selected")
    labels.select(obj, np.arange(100) < 60)
    bpy.ops.swag.select_all_splats(action="INVERT")
    assert selected(obj) == list(range(60, 100))
    bpy.ops.swag.hide_splats()
    assert shown_count() == 60 and selected(obj) == []
    # Neither labels nor other selections show or select what is hidden.
    bpy.ops.swag.show_labels()
    bpy.ops.swag.isolate_label(number=2)
    assert shown_count() == 10
    bpy.ops.swag.select_all_splats(action="SELECT")
    assert selected(obj) == list(range(50, 60))
    bpy.ops.swag.isolate_label(number=2)
    assert shown_count() == 60
    bpy.ops.swag.hide_splats(unselected=True)
    assert shown_count() == 10 and selected(obj) == list(range(50, 60))
    bpy.ops.swag.reveal_splats()
    assert shown_count() == 100

    labels.select(obj, np.arange(100) % 10 == 0)
    bpy.ops.swag.keep_mask(name="tenth")
    labels.select(obj, np.arange(100) == 5)
    bpy.ops.swag.hide_splats()
    obj.data.materials.append(bpy.data.materials.new("own"))
    labels.select(obj, np.arange(100) < 30)
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.swag.delete_splats() == {"FINISHED"}
    bpy.ops.ed.undo_push(message="after")
    kept = np.r_[5, 30:100]  # the hidden one was not selected
    back = splats.read_splats(obj)
    for field in ("positions", "rotations", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(back, field), getattr(made, field)[kept]), field
    assert np.array_equal(labels.attribute(obj, "mask:tenth"), kept % 10 == 0)
    assert np.flatnonzero(labels.attribute(obj, "swag:masked")).tolist() == [0] and shown_count() == 70
    assert [(e.number, e.count) for e in obj.swag_labels.entries] == [(2, 30), (1, 21), (0, 20)]
    assert obj.data.name == "reef" and len(bpy.data.pointclouds) == 1 and obj.data.materials[0].name == "own"
    bpy.ops.swag.select_all_splats(action="SELECT")
    bpy.ops.swag.reveal_splats()
    bpy.ops.swag.select_all_splats(action="SELECT")
    assert_refused(bpy.ops.swag.delete_splats, "All splats of reef are selected: delete the object instead")
    bpy.ops.ed.undo()
    again = bpy.data.objects["reef"]
    assert splats.count(again) == 100 and selected(again) == [i for i in range(30) if i != 5]


def crop(folder):
    """The box limits what is selected, drawn and rendered, and follows its object."""
    obj = new_object(splats_at(np.random.default_rng(2).uniform(-1, 1, (1000, 3)), 0.02), location=(5, 0, 0))
    show_as(obj, splat_preview.RENDERED_IN_VIEWPORT)
    assert bpy.ops.swag.add_crop_box() == {"FINISHED"}
    box = obj.swag_display.crop
    assert bpy.context.active_object == box and box.type == "EMPTY" and box.empty_display_type == "CUBE"
    inside = splat_selection.inside_crop(obj)
    assert 900 < inside.sum() < 1001 and np.allclose(box.location, (5, 0, 0), atol=0.1)
    assert np.allclose(box.scale, 1, atol=0.1) and shown_count() == inside.sum()

    def expected():
        to_box = np.array(box.matrix_world.inverted() @ obj.matrix_world)
        local = splats.positions(obj) @ to_box[:3, :3].T + to_box[:3, 3]
        return (np.abs(local) <= (box.empty_display_size if box.type == "EMPTY" else 1)).all(axis=1)

    box.scale, box.rotation_euler, box.location = (0.5, 0.8, 0.3), (0.3, 0.2, 0.1), (5.1, 0.2, 0)
    bpy.context.view_layer.update()
    assert 50 < expected().sum() < 300
    assert np.array_equal(splat_selection.inside_crop(obj), expected()) and shown_count() == expected().sum()
    box.empty_display_size = 0.7
    bpy.context.view_layer.update()
    assert np.array_equal(splat_selection.inside_crop(obj), expected()) and shown_count() == expected().sum()

    # The tools work on the splats that the selected box crops.
    bpy.ops.swag.select_all_splats(action="SELECT")
    assert np.array_equal(labels.attribute(obj, "swag:selected"), expected())
    count = int(expected().sum())
    mesh = bpy.data.meshes.new("cube")
    cube = linked("cube", mesh)
    cube.matrix_world = box.matrix_world
    obj.swag_display.crop = cube
    bpy.context.view_layer.update()
    assert shown_count() == expected_of(cube, obj) > count

    # Saved with the file.
    bpy.ops.wm.save_as_mainfile(filepath=folder + "/crop.blend")
    bpy.ops.wm.open_mainfile(filepath=folder + "/crop.blend")
    obj, cube = bpy.data.objects["reef"], bpy.data.objects["cube"]
    assert obj.swag_display.crop == cube and shown_count() == expected_of(cube, obj)
    bpy.data.objects.remove(cube)
    assert obj.swag_display.crop is None and shown_count() == 1000 and splat_selection.inside_crop(obj).all()

    box = bpy.data.objects["reef Crop Box"]
    obj.swag_display.crop = box
    bpy.context.view_layer.update()
    splats.select_only(bpy.context, [obj])
    assert bpy.ops.swag.delete_outside_crop() == {"FINISHED"}
    assert splats.count(obj) == count and splat_selection.inside_crop(obj).all()
    assert_refused(bpy.ops.swag.delete_outside_crop, "No splats are outside the crop box")


def expected_of(cube, obj):
    to_box = np.array(cube.matrix_world.inverted() @ obj.matrix_world)
    local = splats.positions(obj) @ to_box[:3, :3].T + to_box[:3, 3]
    return int((np.abs(local) <= 1).all(axis=1).sum())


def render_crop_and_hidden():
    """Alpha at the pixels of three splats: as they are, with the middle one hidden, with the right one cropped."""
    camera = new_camera()
    camera.location = (0, 0, 5)
    scene.render.resolution_x, scene.render.resolution_y = 60, 20
    obj = new_object(splats_at([(-1, 0, 0), (0, 0, 0), (1, 0, 0)], 0.2))
    splat_preview.prepare_render(scene, display_values=False)
    found = []

    def look():
        alpha = render_pixel_centres()[10, :, 3]
        found.append((alpha[[13, 30, 47]] > 0.5).tolist())

    look()
    labels.select(obj, np.array([False, True, False]))
    bpy.ops.swag.hide_splats()
    look()
    splats.select_only(bpy.context, [obj])
    bpy.ops.swag.add_crop_box()
    obj.swag_display.crop.location.x = -1.5
    look()
    return found


def find_floaters():
    """A cloud of splats between cameras and a wall is found, and what no camera sees; the wall is not."""
    random = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.linspace(-3.5, 3.5, 100), np.linspace(-2, 2, 40)), -1).reshape(-1, 2)
    wall = np.column_stack([grid, np.zeros(4000)])
    floating = random.normal((0, 0, 2.5), 0.4, (40, 3))
    unseen = random.uniform((-2, -1.5, -3), (2, 1.5, -2), (100, 3))
    opacity = np.repeat([0.9, 0.3, 0.9], (4000, 40, 100))
    obj = new_object(splats_at(np.concatenate([wall, floating, unseen]), 0.08, opacity), location=(1, 0, 0))
    assert_refused(bpy.ops.swag.find_floaters, "The scene has no cameras: import the photos")
    scene.render.resolution_x, scene.render.resolution_y = 320, 240
    for x in (-1, 0, 1, 2, 3):
        new_camera().location = (x, 0, 5)
    bpy.context.view_layer.update()
    taken = list(floaters.observing(bpy.context, obj))
    assert taken == sorted(taken) and len(taken) >= 5 and taken[0] >= 0 and taken[-1] < 1, "a step a camera"
    assert not list(floaters.observing(bpy.context, obj)), "what is known takes no step"
    seen = floaters.observe(bpy.context, obj)
    assert seen is floaters.observe(bpy.context, obj)
    assert seen.cameras == seen.all_cameras == 5 and seen.photos[4000:4040].mean() > 1 and not seen.photos[4040:].any()

    in_frame = np.abs(wall[:, 1]) < 1.2

    def found():
        chosen = np.array(selected(obj), int)
        return [
            in_frame[chosen[chosen < 4000]].sum() / in_frame.sum(),
            ((chosen >= 4000) & (chosen < 4040)).sum() / 40,
            (chosen >= 4040).sum() / 100,
        ]

    bpy.ops.swag.find_floaters(in_front=0.5, photos=0)
    on_wall, floats, behind = found()
    assert on_wall < 0.01 and floats > 0.8 and behind == 0, (on_wall, floats, behind)
    bpy.ops.swag.find_floaters(in_front=0.5, photos=1)
    on_wall, floats, behind = found()
    assert on_wall < 0.01 and floats > 0.8 and behind == 1, (on_wall, floats, behind)
    tint = np.empty(4 * 4140, "f4")
    obj.data.attributes["swag:tint"].data.foreach_get("color", tint)
    assert np.array_equal(tint.reshape(-1, 4)[:, 3] > 0, labels.mask_of(obj, "swag:selected"))
    # Hidden floaters are none, and do not hide the wall.
    labels.select(obj, np.arange(4140) >= 4000)
    bpy.ops.swag.hide_splats()
    bpy.ops.swag.find_floaters(in_front=0.5, photos=0)
    assert found()[1:] == [0, 0]


def clean_up_by_kinds():
    """Kinds are found, switched, and removed in one step of undo; Cancel keeps all."""
    random = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.linspace(-3.5, 3.5, 100), np.linspace(-2, 2, 40)), -1).reshape(-1, 2)
    wall = np.column_stack([grid, np.zeros(4000)])
    floating, water = random.normal((0, 0, 2.5), 0.4, (40, 3)), random.uniform((-3, -1, -0.5), (3, 1, -0.4), (30, 3))
    border = random.uniform((-6, 3, -1), (6, 5, 0), (50, 3))
    made = splats_at(
        np.concatenate([wall, floating, water, border]), 0.08, np.repeat([0.9, 0.3, 0.9, 0.2], (4000, 40, 30, 50))
    )
    made.scales[4070:] = 0.5
    obj = new_object(made)
    clean_up, finish = bpy.ops.swag.clean_up, bpy.ops.swag.finish_clean_up
    assert_refused(clean_up, "The scene has no cameras")
    assert not finish.poll()
    scene.render.resolution_x, scene.render.resolution_y = 320, 240
    for x in (-1, 0, 1, 2, 3):
        new_camera().location = (x, 0, 5)
    bpy.context.view_layer.update()
    labels.set_attribute(obj, "swag:haze", "FLOAT", np.repeat([0.0, 0.1, 0.9, 0.0], (4000, 40, 30, 50)))
    settings = scene.swag_clean_up

    def parts():
        chosen = np.array(selected(obj), int)
        return np.histogram(chosen, [0, 4000, 4040, 4070, 4120])[0].tolist()

    assert clean_up() == {"FINISHED"}
    on_wall, floats, hazy, fuzzy = parts()
    assert on_wall < 40 and floats > 30 and hazy == 30 and fuzzy == 50, parts()
    found = clean_up_module.counts([obj])
    assert found["floaters"] >= floats and found["open_water"] == 30 and found["border"] == 50
    settings.border = False
    assert parts()[2:] == [30, 0]
    settings.open_water = False
    assert parts()[1:] == [floats, 0, 0]
    # Open water is known by its label, too.
    settings.open_water = settings.border = True
    obj.data.attributes.remove(obj.data.attributes["swag:haze"])
    labels.set_attribute(obj, "swag:label", "INT", np.repeat([1, 1, 2, 1], (4000, 40, 30, 50)))
    bpy.ops.swag.read_labels()
    assert clean_up() == {"FINISHED"} and parts()[2] == 0
    next(e for e in obj.swag_labels.entries if e.number == 2).name = "Open Water"
    assert clean_up() == {"FINISHED"} and parts()[1:] == [floats, 30, 50]

    assert finish(remove=False) == {"FINISHED"}
    assert splats.count(obj) == 4120 and selected(obj) == [] and "swag:clean_up" not in obj.data.attributes
    clean_up()
    # What the user deselects stays.
    bpy.ops.swag.select_sphere(point=tuple(border[0]), radius=0.01, mode="SUBTRACT")
    left = 4120 - len(selected(obj))
    bpy.ops.ed.undo_push(message="before")
    assert finish(remove=True) == {"FINISHED"}
    bpy.ops.ed.undo_push(message="after")
    assert splats.count(obj) == left and "swag:clean_up" not in obj.data.attributes and not finish.poll()
    bpy.ops.ed.undo()
    again = bpy.data.objects["reef"]
    assert splats.count(again) == 4120 and len(selected(again)) == 4120 - left
    bpy.ops.swag.select_all_splats(action="DESELECT")
    assert_refused(finish, "No splats are selected", remove=True)
    assert finish(remove=False) == {"FINISHED"}


def read_points():
    obj = new_object(splats_at([(0, 0, 0), (0, 0, -2), (0.5, 0, 0)], opacity=[0.9, 0.8, 0.1], label=[1, 2, 0]))
    bpy.ops.swag.read_labels()
    next(e for e in obj.swag_labels.entries if e.number == 1).name = "coral"
    view = visibility.View(np.array(perspective(50, location=(0, 0, 4))).reshape(4, 4), *SIZE, np.zeros((0, 4)))
    assert np.allclose(view.eye, (0, 0, 4), atol=1e-5)
    objects = picking.splat_objects(bpy.context)
    at = picking.Picker(objects, view).at
    reading = at((103, 50))
    assert (reading.label, round(reading.distance, 4), round(reading.opacity, 3)) == ("coral", 4, 0.9)
    assert at((103, 90)) is None and at((135, 50)) is None  # nothing; a splat that is too faint
    scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 0.01
    assert "Range: 4 cm" in reading.describe(scene) and "Label: coral" in reading.describe(scene)
    assert lengths.length_text(scene, 250) == "2.5 m"
    scene.unit_settings.system = "IMPERIAL"
    assert lengths.length_text(scene, 30.48) == "1 ft" or lengths.length_text(scene, 30.48) == "1'"
    scene.unit_settings.system = "NONE"
    assert lengths.length_text(scene, 2.5) == "2.5"
    # What is hidden is not read.
    labels.select(obj, np.array([True, False, False]))
    bpy.ops.swag.hide_splats()
    assert round(picking.Picker(objects, view).at((100, 50)).distance, 4) == 6
    above = visibility.View(np.array(orthographic()).reshape(4, 4), *SIZE, np.zeros((0, 4)))
    assert above.eye is None and picking.Picker(objects, above).at((100, 50)).distance is None


def score_selection(run, other):
    """PSNR of a run without selected splats, after some of its splats were deleted and separated."""
    result = read_ply(Path(run) / "result.ply")
    obj = new_object(result)
    score, status = bpy.ops.swag.score_selection, bpy.context.window_manager.swag
    assert_refused(score, "The splats of reef are from no run")
    obj["swag_run"] = run
    assert_refused(score, "No splats are selected")
    labels.select(obj, np.arange(len(result)) % 2 == 0)
    bpy.ops.swag.separate_splats()
    part = bpy.context.active_object
    labels.select(part, np.arange(splats.count(part)) < 5)
    bpy.ops.swag.delete_splats()
    labels.select(part, np.arange(splats.count(part)) < splats.count(part) - 1)
    assert score() == {"FINISHED"}
    found = status.message
    part.data.attributes["position"].data[0].vector = (9, 9, 9)
    assert_refused(score, "are not those of the result in")
    obj["swag_run"] = other
    splats.select_only(bpy.context, [obj])
    assert_refused(score, "result.ply")
    return found
