"""Splats whose points Blender's own operators and modifiers move."""

import time
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import labels, splat_export, splats
from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import concatenate
from bl_ext.user_default.swag_splatting.swag_engine.splats.transform import covariances, sh_basis, transformed
from mathutils import Euler, Matrix
from pictures import FIELDS, random_splats

bpy.context.preferences.edit.use_global_undo = True
scene = bpy.context.scene
DIRECTIONS = np.random.default_rng(5).normal(size=(7, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
SCALES = {"even": (2, 2, 2), "uneven": (1, 2, 0.5), "mirrored": (-1.5, 1.5, 1.5), "uneven mirror": (1, -3, 0.4)}


def new_object(made, scale=(1, 1, 1), turned=True):
    obj = splats.new_splat_object("reef", made, scene.collection)
    if turned:
        obj.location, obj.rotation_euler = (1, 2, 3), (0.3, 0.5, 0.7)
    obj.scale = scale
    splats.select_only(bpy.context, [obj])
    bpy.context.view_layer.update()
    return obj


def in_world(obj):
    return transformed(splats.read_splats(obj), np.array(obj.matrix_world))


def stored(obj):
    """The splats as Blender's own drawing and exporters see them."""
    return splats._splats_as_stored(splats.pointcloud_of(obj))


def assert_same(found, wanted):
    assert len(found) == len(wanted), (len(found), len(wanted))
    np.testing.assert_allclose(found.positions, wanted.positions, atol=2e-5)
    size = np.abs(covariances(wanted)).max(axis=(1, 2), keepdims=True)
    assert (np.abs(covariances(found) - covariances(wanted)) / size).max() < 1e-4
    colors = [np.einsum("mk,nkc->nmc", sh_basis(DIRECTIONS, part.degree), part.sh) for part in (found, wanted)]
    np.testing.assert_allclose(colors[0], colors[1], atol=2e-4)
    np.testing.assert_array_equal(found.opacities, wanted.opacities)


def assert_equal(found, wanted):
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)


def apply_transforms():
    """Apply of location, rotation and scale, of all of them or some."""
    everything = {"location", "rotation", "scale"}
    for scale, parts in (
        *((scale, everything) for scale in SCALES.values()),
        (SCALES["uneven"], {"scale"}),
        (SCALES["even"], {"rotation", "scale"}),
    ):
        obj = new_object(random_splats(300, 16), scale, turned=parts != {"scale"})
        wanted = in_world(obj)
        assert bpy.ops.object.transform_apply(**{name: name in parts for name in everything}) == {"FINISHED"}
        assert_same(transformed(stored(obj), np.array(obj.matrix_world)), wanted)
        np.testing.assert_allclose(obj.data.attributes["radius"].data[3].value, stored(obj).scales[3].mean())
    # A shift leaves every bit of sizes, rotations and colors.
    made = random_splats(300, 16)
    obj = new_object(made, turned=False)
    obj.location = (1, 2, 3)
    bpy.ops.object.transform_apply(location=True, rotation=False, scale=False)
    assert all(
        np.array_equal(getattr(stored(obj), name), getattr(made, name)) for name in FIELDS if name != "positions"
    )
    # Data of several users, and few splats.
    obj = new_object(random_splats(300, 4), SCALES["mirrored"])
    other = bpy.data.objects.new("other", obj.data)
    scene.collection.objects.link(other)
    wanted = in_world(obj)
    bpy.ops.object.transform_apply(isolate_users=True)
    assert obj.data != other.data
    assert_same(transformed(stored(obj), np.array(obj.matrix_world)), wanted)
    for count in (1, 2, 3, 4, 7):
        obj = new_object(random_splats(count, 4), SCALES["even"])
        wanted = in_world(obj)
        bpy.ops.object.transform_apply()
        found = transformed(stored(obj), np.array(obj.matrix_world))
        if count > 2:
            assert_same(found, wanted)
        else:
            np.testing.assert_allclose(found.positions, wanted.positions, atol=2e-5)


def undo_and_redo():
    """The step of an operator holds what it made before the splats follow: undo and redo pass through it."""
    obj = new_object(random_splats(300, 16), SCALES["uneven"])
    name, before = obj.name, stored(obj)
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.object.transform_apply("EXEC_DEFAULT", True) == {"FINISHED"}
    after = stored(bpy.data.objects[name])
    assert not np.array_equal(after.scales, before.scales)
    bpy.data.objects[name].location.x = 5
    bpy.ops.ed.undo_push(message="later")
    for _ in range(2):
        bpy.ops.ed.undo()
        assert_equal(stored(bpy.data.objects[name]), after)
        bpy.ops.ed.undo()
        assert_equal(stored(bpy.data.objects[name]), before)
        bpy.ops.ed.redo()
        assert_equal(stored(bpy.data.objects[name]), after)
        bpy.ops.ed.redo()
        assert_equal(stored(bpy.data.objects[name]), after)


def join():
    """Objects of other transforms and degrees; the smallest is the active one."""
    for degrees in ((16, 16, 16), (4, 16, 1), (16, 4, 4)):
        made = [
            new_object(random_splats(count, coefficients, seed=count), scale)
            for count, coefficients, scale in zip((300, 200, 3), degrees, SCALES.values(), strict=False)
        ]
        made[1].rotation_euler = (1, 0.2, -2)
        splats.select_only(bpy.context, made)
        bpy.context.view_layer.update()
        wanted = concatenate([in_world(made[2]), in_world(made[0]), in_world(made[1])])
        assert bpy.ops.object.join() == {"FINISHED"}
        found = transformed(stored(made[2]), np.array(made[2].matrix_world))
        # Blender's order of the objects is not stated.
        rows = [np.abs(wanted.positions - position).sum(axis=1).argmin() for position in found.positions]
        assert sorted(rows) == list(range(len(wanted)))
        assert_same(type(found)(*(getattr(found, name)[np.argsort(rows)] for name in FIELDS)), wanted)
        bpy.data.objects.remove(made[2])


def join_points_without_splats():
    """They become grey balls, not splats without size and rotation."""
    obj = new_object(random_splats(50, 4), SCALES["even"])
    wanted = in_world(obj)
    data = splats.new_pointcloud("plain", np.ones((20, 3), "f4"))
    radius = data.attributes.get("radius") or data.attributes.new("radius", "FLOAT", "POINT")
    radius.data.foreach_set("value", np.full(20, 0.1, "f4"))
    plain = bpy.data.objects.new("plain", data)
    scene.collection.objects.link(plain)
    splats.select_only(bpy.context, [plain, obj])
    assert bpy.ops.object.join() == {"FINISHED"}
    found = stored(obj)
    assert_same(transformed(found.subset(np.arange(70) < 50), np.array(obj.matrix_world)), wanted)
    np.testing.assert_array_equal(found.rotations[50:], np.tile([1, 0, 0, 0], (20, 1)))
    np.testing.assert_allclose(found.scales[50:], 0.1)
    assert (found.opacities[50:] == 1).all()


def scripts_that_move():
    """What edit mode does to points: a part of them is turned and scaled, or moved by no one map."""
    made = random_splats(300, 16)
    obj = new_object(made, turned=False)
    matrix = np.array(Matrix.LocRotScale((1, 0, 0), Euler((0.2, 1, 0)), (1, 2, -1)))
    chosen = np.random.default_rng(1).random(300) < 0.3
    moved = made.positions.copy()
    moved[chosen] = moved[chosen] @ matrix[:3, :3].T + matrix[:3, 3]
    obj.data.attributes["position"].data.foreach_set("vector", moved.ravel())
    obj.data.update_tag()
    bpy.context.view_layer.update()
    assert_same(stored(obj).subset(chosen), transformed(made.subset(chosen), matrix))
    assert_equal(stored(obj).subset(~chosen), made.subset(~chosen))
    before = stored(obj)
    bent = before.positions + np.sin(3 * before.positions[:, ::-1])
    obj.data.attributes["position"].data.foreach_set("vector", bent.ravel())
    obj.data.update_tag()
    bpy.context.view_layer.update()
    for name in ("rotations", "scales", "sh"):
        np.testing.assert_array_equal(getattr(stored(obj), name), getattr(before, name))


def edit_mode():
    """Operators on all or some of the points; proportional editing is no affine map of them."""
    made = random_splats(300, 16)
    obj = new_object(made, turned=False)
    chosen = np.arange(300) % 3 == 0
    bpy.ops.object.mode_set(mode="EDIT")
    for turn in (
        lambda: bpy.ops.transform.rotate(value=0.7, orient_axis="X"),
        lambda: bpy.ops.transform.resize(value=(1, 3, 0.5)),
        lambda: bpy.ops.transform.mirror(constraint_axis=(True, False, False)),
        lambda: bpy.ops.transform.translate(value=(1, 2, 3)),
    ):
        before = stored(obj)
        select_points(obj, chosen)
        assert turn() == {"FINISHED"}
        after = stored(obj)
        assert (after.positions[chosen] != before.positions[chosen]).any()
        matrix = affine(before.positions[chosen], after.positions[chosen])
        assert_same(after.subset(chosen), transformed(before.subset(chosen), matrix))
        assert_equal(after.subset(~chosen), before.subset(~chosen))
    before = stored(obj)
    bpy.ops.pointcloud.duplicate()
    bpy.ops.transform.resize(value=(2, 2, 2))
    assert len(stored(obj)) == 400
    bpy.ops.pointcloud.delete()
    assert_equal(stored(obj), before)
    select_points(obj, chosen)
    bpy.ops.pointcloud.separate()
    bpy.ops.object.mode_set(mode="OBJECT")
    part = next(o for o in bpy.context.selected_objects if o != obj)
    assert_equal(stored(part), before.subset(chosen))
    assert_equal(stored(obj), before.subset(~chosen))
    bpy.ops.object.mode_set(mode="EDIT")
    before = stored(obj)
    select_points(obj, np.arange(len(before)) < 20)
    options = {"use_proportional_edit": True, "proportional_size": 1.5, "proportional_edit_falloff": "SMOOTH"}
    bpy.ops.transform.resize(value=(3, 3, 3), **options)
    assert (stored(obj).positions[20:] != before.positions[20:]).any()
    bpy.ops.object.mode_set(mode="OBJECT")


def select_points(obj, chosen):
    attributes = obj.data.attributes
    selection = attributes.get(".selection") or attributes.new(".selection", "BOOLEAN", "POINT")
    selection.data.foreach_set("value", chosen)
    obj.data.update_tag()


def affine(before, after):
    found = np.linalg.lstsq(np.c_[before, np.ones(len(before))].astype("f8"), after.astype("f8"), rcond=None)[0]
    return np.vstack([found.T, [0, 0, 0, 1]])


def modifiers():
    """Transform Geometry turns splats for exports and viewports; Set Position with noise only shifts them."""
    made = random_splats(300, 16)
    obj = new_object(made, turned=False)
    group = bpy.data.node_groups.new("turn", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    start, end = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    turn = group.nodes.new("GeometryNodeTransform")
    turn.inputs["Rotation"].default_value = (0.3, 0.5, 0.7)
    turn.inputs["Scale"].default_value = (1, -2, 0.5)
    turn.inputs["Translation"].default_value = (1, 2, 3)
    group.links.new(start.outputs[0], turn.inputs["Geometry"])
    group.links.new(turn.outputs[0], end.inputs[0])
    modifier = obj.modifiers.new("turn", "NODES")
    modifier.node_group = group
    obj.modifiers.move(len(obj.modifiers) - 1, 0)
    bpy.context.view_layer.update()
    matrix = np.array(Matrix.LocRotScale((1, 2, 3), Euler((0.3, 0.5, 0.7)), (1, -2, 0.5)))
    assert_same(splats.read_modified_splats(obj)[0], transformed(made, matrix))
    assert_equal(stored(obj), made)
    assert splats.count_only_shifted(obj) == 0
    place, noise = group.nodes.new("GeometryNodeSetPosition"), group.nodes.new("ShaderNodeTexNoise")
    group.links.new(turn.outputs[0], place.inputs["Geometry"])
    group.links.new(noise.outputs["Color"], place.inputs["Offset"])
    group.links.new(place.outputs[0], end.inputs[0])
    assert splats.count_only_shifted(obj) == 300
    splats.select_only(bpy.context, [obj])
    path = Path(bpy.app.tempdir) / "shifted.ply"
    _, notes = splat_export.save_splats(bpy.context, path, splat_export.ExportSettings())
    assert notes == [f"Modifiers move 300 splats of {obj.name} so that their sizes and rotations cannot follow."]


def changes_of_the_extension():
    """They keep what follows the points in step."""
    obj = new_object(random_splats(300, 16), SCALES["even"])
    wanted = in_world(obj)
    mask = np.arange(300) < 100
    splats.keep_splats(obj, mask)
    splats.exchange_splats(obj, np.arange(100) >= 0, random_splats(50, 16, seed=3))
    assert len(stored(obj)) == 150
    other = new_object(random_splats(80, 16, seed=4), SCALES["uneven"])
    labels.merge(obj, [other])
    splats.select_only(bpy.context, [obj])
    changes = splats.changes_of(splats.pointcloud_of(obj))
    bpy.context.view_layer.update()
    assert splats.changes_of(splats.pointcloud_of(obj)) == changes
    before = in_world(obj)
    bpy.ops.object.transform_apply()
    found = transformed(stored(obj), np.array(obj.matrix_world))
    assert_same(found, before)
    assert_same(found.subset(np.arange(230) < 100), wanted.subset(mask))


def seconds_of_an_update(count=200_000):
    """Of an update of a splat object whose points did not move, and of one that was turned."""
    obj = new_object(random_splats(count, 16))
    data = splats.pointcloud_of(obj)
    begin = time.perf_counter()
    splats.follow_points_of(data)
    still = time.perf_counter() - begin
    positions = splats.positions(obj)
    obj.data.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(positions[:, ::-1]).ravel())
    begin = time.perf_counter()
    splats.follow_points_of(data)
    return still, time.perf_counter() - begin
