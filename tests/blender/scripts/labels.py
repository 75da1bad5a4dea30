"""Labels of splats: list, show, select, search, masks, separate, merge."""

from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import labels, splats
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview
from bl_ext.user_default.swag_splatting.swag_engine.base.transfer import linear_to_srgb
from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply
from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats
from pictures import shown_count

bpy.context.preferences.edit.use_global_undo = True
scene = bpy.context.scene


def labelled_object(numbers, name="reef", location=(0, 0, 0)):
    """An object of random splats with these label numbers, active and selected alone; and the splats."""
    count = len(numbers)
    random = np.random.default_rng(0)
    made = Splats(
        random.normal(size=(count, 3)).astype("f4"),
        np.tile(np.array([1, 0, 0, 0], "f4"), (count, 1)),
        random.uniform(0.01, 0.1, (count, 3)).astype("f4"),
        random.uniform(0.2, 1, count).astype("f4"),
        random.normal(size=(count, 4, 3)).astype("f4"),
        {"label": np.array(numbers, "i4")},
    )
    obj = splats.new_splat_object(name, made, scene.collection)
    obj.location = location
    for other in scene.objects:
        other.select_set(other == obj)
    bpy.context.view_layer.objects.active = obj
    bpy.context.view_layer.update()
    return obj, made


def evaluated(obj):
    graph = bpy.context.evaluated_depsgraph_get()
    graph.update()
    return obj.evaluated_get(graph)


def show_as(obj, name):
    """Have the viewport's nodes give points or shapes, which can be counted without a window."""
    for wanted in (splat_preview.POINTS_IN_VIEWPORT, splat_preview.RENDERED_IN_VIEWPORT):
        splat_preview.set_input(obj, wanted, wanted == name)


def assert_refused(operator, message, **arguments):
    try:
        operator(**arguments)
    except RuntimeError as error:
        assert message in str(error), error
    else:
        raise AssertionError(f"{operator} raised no error")


def list_and_hide(folder):
    obj, made = labelled_object([1] * 50 + [2] * 30 + [0] * 20 + [7] * 5)
    show_as(obj, splat_preview.RENDERED_IN_VIEWPORT)
    assert shown_count() == 105
    assert bpy.ops.swag.read_labels(directory=folder) == {"FINISHED"}
    entries = obj.swag_labels.entries
    listed = [(e.number, e.name, e.count, e.visible) for e in entries]
    assert listed == [
        (1, "coral", 50, True), (2, "wreck", 30, True), (0, "No label", 20, True), (7, "Label 7", 5, True)
    ]  # fmt: skip
    assert len({tuple(e.color) for e in entries}) == 4 and shown_count() == 105
    entries[0].visible = False
    assert shown_count() == 55
    assert bpy.ops.swag.isolate_label(number=2) == {"FINISHED"} and shown_count() == 30
    bpy.ops.swag.isolate_label(number=2)
    assert shown_count() == 105 and all(e.visible for e in entries)
    entries[1].visible = False
    bpy.ops.swag.read_labels(directory=folder)
    assert shown_count() == 75 and not entries[1].visible
    bpy.ops.swag.show_labels()
    assert shown_count() == 105


def tint(folder):
    obj, made = labelled_object([1] * 50 + [2] * 30 + [0] * 20 + [7] * 5)
    bpy.ops.swag.read_labels(directory=folder)
    entries = obj.swag_labels.entries

    def tints():
        values = np.empty(105 * 4, "f4")
        obj.data.attributes["swag:tint"].data.foreach_get("color", values)
        return values.reshape(-1, 4)

    def shown_colors():
        found = evaluated(obj).data.attributes["swag:color"]
        values = np.empty(len(found.data) * 3, "f4")
        found.data.foreach_get("vector", values)
        return values.reshape(-1, 3)

    assert not tints().any()
    obj.swag_labels.tinted = True
    entries[0].color = (0, 1, 0)
    tint = tints()
    assert np.allclose(tint[0, :3], (0, 1, 0)) and 0 < tint[0, 3] < 1 and not tint[85].any() and tint[60, 3] > 0
    show_as(obj, splat_preview.POINTS_IN_VIEWPORT)
    tinted = shown_colors()
    obj.swag_labels.tinted = False
    plain = shown_colors()
    # Mixed as display values, as the viewport's own drawing does.
    plain, color, tinted = map(linear_to_srgb, (plain, tint[:, :3], tinted))
    assert np.allclose(tinted, plain + (color - plain) * tint[:, 3:], atol=1e-5)
    # The splats themselves are unchanged.
    back = splats.read_splats(obj)
    assert np.array_equal(back.positions, made.positions) and list(back.extras) == ["label"]


def mark_uncertain(folder):
    _, made = labelled_object([1] * 4, "plain")
    confidence = np.array([1, 0.75, 0.2, 0], "f4")
    made.extras["confidence"] = confidence
    obj = splats.new_splat_object("restored", made, scene.collection)

    def tints():
        values = np.empty(16, "f4")
        obj.data.attributes["swag:tint"].data.foreach_get("color", values)
        return values.reshape(-1, 4)

    obj.swag_labels.uncertain = True
    assert np.allclose(tints()[:, 3], 1 - confidence) and np.allclose(tints()[:, :3], (1, 0, 0.3))
    labels.select(obj, np.array([False, False, False, True]))
    assert np.allclose(tints()[3], labels.SELECTED_COLOR)
    obj.swag_labels.uncertain = False
    assert not tints()[:3].any()
    assert np.array_equal(splats.read_splats(obj).extras["confidence"], confidence)


def save_and_open(folder):
    obj, _ = labelled_object([1] * 50 + [2] * 30 + [0] * 20 + [7] * 5)
    show_as(obj, splat_preview.RENDERED_IN_VIEWPORT)
    bpy.ops.swag.read_labels(directory=folder)
    obj.swag_labels.entries[0].visible = False
    name = obj.name
    bpy.ops.wm.save_as_mainfile(filepath=folder + "/labels.blend")
    bpy.ops.wm.open_mainfile(filepath=folder + "/labels.blend")
    opened = bpy.data.objects[name]
    assert [e.name for e in opened.swag_labels.entries][:2] == ["coral", "wreck"] and shown_count() == 55


def select_and_keep_mask(folder):
    obj, made = labelled_object([1] * 50 + [2] * 30 + [0] * 20)
    assert_refused(bpy.ops.swag.keep_mask, "No splats of reef are selected")
    bpy.ops.swag.read_labels(directory=folder)
    bpy.ops.swag.select_label(number=2)
    assert np.array_equal(labels.attribute(obj, "swag:selected"), made.extras["label"] == 2)
    bpy.ops.swag.select_label(number=0, extend=True)
    assert labels.attribute(obj, "swag:selected").sum() == 50
    bpy.ops.swag.keep_mask(name="old iron")
    assert np.array_equal(labels.attribute(obj, "mask:old iron"), made.extras["label"] != 1)
    assert obj.data.attributes["mask:old iron"].data_type == "BOOLEAN"

    # Geometry nodes read the mask.
    tree = bpy.data.node_groups.new("mask", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    read, drop = tree.nodes.new("GeometryNodeInputNamedAttribute"), tree.nodes.new("GeometryNodeDeleteGeometry")
    read.data_type = "BOOLEAN"
    read.inputs["Name"].default_value = "mask:old iron"
    tree.links.new(start.outputs[0], drop.inputs["Geometry"])
    attribute = next(socket for socket in read.outputs if socket.enabled and socket.name == "Attribute")
    tree.links.new(attribute, drop.inputs["Selection"])
    tree.links.new(drop.outputs[0], end.inputs[0])
    modifier = obj.modifiers.new("mask", "NODES")
    modifier.node_group = tree
    obj.modifiers.move(1, 0)
    show_as(obj, splat_preview.RENDERED_IN_VIEWPORT)
    assert shown_count() == 50


def search(folder):
    obj, _ = labelled_object([1] * 60 + [2] * 40)
    assert_refused(bpy.ops.swag.search_labels, "No label is called coral: the labels are not read yet", words="coral")
    bpy.ops.swag.read_labels(directory=folder)
    obj.swag_labels.words = ""
    assert_refused(bpy.ops.swag.search_labels, "There is nothing to search for")
    bpy.ops.swag.search_labels(words="Coral")
    expected = np.load(folder + "/expected.npy")
    assert np.allclose(labels.attribute(obj, "swag:similarity"), expected, atol=1e-6)
    assert np.array_equal(labels.attribute(obj, "swag:selected"), expected > 0.5)
    for threshold in (-1, 0.1, 0.8, 1):
        obj.swag_labels.threshold = threshold
        assert np.array_equal(labels.attribute(obj, "swag:selected"), expected > np.float32(threshold)), threshold
    # The run's features are of another number of splats: the label alone decides.
    few, _ = labelled_object([1, 2, 1], "few")
    bpy.ops.swag.read_labels(directory=folder)
    bpy.ops.swag.search_labels(words="coral")
    assert labels.attribute(few, "swag:similarity").tolist() == [1, 0, 1]
    # Words that are no label's name need the engine, which is missing here.
    bpy.context.scene.swag.scene_folder = ""
    assert_refused(bpy.ops.swag.search_labels, "/nowhere cannot be run", words="eel")


def separate_and_merge(folder):
    obj, made = labelled_object([1, 2] * 50 + [0] * 10, location=(1, 2, 3))
    obj.rotation_euler = (0.3, 0, 0.5)
    obj["swag_background"] = [0.1, 0.2, 0.3]
    bpy.ops.swag.read_labels(directory=folder)
    assert_refused(bpy.ops.swag.separate_splats, "No splats of reef are selected")
    bpy.ops.swag.select_label(number=2)
    bpy.context.view_layer.update()
    matrix = obj.matrix_world.copy()
    assert bpy.ops.swag.separate_splats() == {"FINISHED"}
    part = bpy.context.active_object
    bpy.context.view_layer.update()
    assert part.name == "reef wreck" and len(part.data.points) == 50 and len(obj.data.points) == 60
    assert np.allclose(part.matrix_world, matrix, atol=1e-6)
    assert list(part["swag_background"]) == list(obj["swag_background"])
    assert [(e.name, e.count) for e in part.swag_labels.entries] == [("wreck", 50)]
    assert [(e.name, e.count) for e in obj.swag_labels.entries] == [("coral", 50), ("No label", 10)]
    assert np.array_equal(splats.read_splats(part).positions, made.positions[made.extras["label"] == 2])
    assert_refused(bpy.ops.swag.merge_splats, "Only one object with splats is selected")
    bpy.ops.swag.select_label(number=2)
    assert_refused(bpy.ops.swag.separate_splats, "All splats of reef wreck are selected")
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj
    assert bpy.ops.swag.merge_splats() == {"FINISHED"}
    assert len(bpy.data.pointclouds) == 1 and [o.name for o in scene.objects] == ["reef"]
    assert [(e.name, e.count) for e in obj.swag_labels.entries] == [("coral", 50), ("wreck", 50), ("No label", 10)]
    back = splats.read_splats(obj)
    order = np.lexsort(back.positions.T), np.lexsort(made.positions.T)
    for field in ("positions", "rotations", "scales", "opacities", "sh"):
        assert np.allclose(getattr(back, field)[order[0]], getattr(made, field)[order[1]], atol=1e-5), field
    assert np.array_equal(back.extras["label"][order[0]], made.extras["label"][order[1]])


def undo_separation(folder):
    labelled_object([1, 2] * 50)
    bpy.ops.swag.read_labels(directory=folder)
    bpy.ops.swag.select_label(number=2)
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.swag.separate_splats()
    assert len(bpy.data.objects["reef"].data.points) == 50 and len(scene.objects) == 2
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    assert len(bpy.data.objects["reef"].data.points) == 100 and len(bpy.data.objects) == 1
    assert [e.name for e in bpy.data.objects["reef"].swag_labels.entries] == ["coral", "wreck"]


def refuse_without_labels(folder):
    assert not bpy.ops.swag.read_labels.poll()
    obj, made = labelled_object([1, 2, 3])
    unlabelled = Splats(made.positions, made.rotations, made.scales, made.opacities, made.sh)
    plain = splats.new_splat_object("plain", unlabelled, scene.collection)
    bpy.context.view_layer.objects.active = plain
    assert_refused(bpy.ops.swag.read_labels, "The splats of plain have no labels: label the run")
    bpy.context.view_layer.objects.active = obj
    Path(folder, "labels.json").write_text('{"labels": [{"name": 3}]}')
    assert_refused(bpy.ops.swag.read_labels, "labels.json does not list labels", directory=folder)
    assert bpy.ops.swag.read_labels() == {"FINISHED"} and len(obj.swag_labels.entries) == 3


def label_a_run(folder):
    run, masks = Path(folder, "run"), folder + "/masks"
    obj = splats.new_splat_object("reef", read_ply(run / "result.ply"), scene.collection)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    label_run = bpy.ops.swag.label_run
    assert_refused(label_run, "are from no run")
    obj["swag_run"] = str(run)
    assert_refused(label_run, "There is no folder of masks: choose it", source="MASKS")
    assert_refused(label_run, "There is nothing to look for: write words", source="WORDS", words=" ")
    assert_refused(label_run, "One of the words to look for is empty", source="WORDS", words="coral,,")
    assert_refused(label_run, "allow online access", source="WORDS", words="coral", download=True)
    assert_refused(label_run, "There is no folder", source="MASKS", masks=masks + "/none")
    assert "swag:label" not in obj.data.attributes and not (run / "labels.json").exists()

    assert label_run(source="MASKS", masks=masks) == {"FINISHED"}
    assert {e.name for e in obj.swag_labels.entries if e.number} == {"left", "right"}
    assert np.array_equal(labels.attribute(obj, "swag:label"), read_ply(run / "result.ply").extras["label"])
    status = bpy.context.window_manager.swag
    assert status.message.startswith("2 labels: ") and not status.failed and not status.job
    x = splats.read_splats(obj).positions[:, 0]
    bpy.ops.swag.select_label(number=next(e.number for e in obj.swag_labels.entries if e.name == "left"))
    mask = labels.attribute(obj, "swag:selected")
    assert x[mask].mean() < x[~mask].mean() - 1
    bpy.ops.swag.keep_mask(name="kept")
    bpy.ops.swag.search_labels(words="left")
    similarity = labels.attribute(obj, "swag:similarity")
    assert similarity[mask].mean() > similarity[~mask].mean()

    # A second labelling replaces the labels and keeps the masks; separated parts are labelled too.
    assert label_run(source="SALIENCY") == {"FINISHED"}
    assert np.array_equal(labels.attribute(obj, "mask:kept"), mask)
    assert not {"left", "right"} & {e.name for e in obj.swag_labels.entries}
    bpy.ops.swag.select_label(number=obj.swag_labels.entries[0].number)
    bpy.ops.swag.separate_splats()
    part = bpy.context.active_object
    bpy.context.view_layer.objects.active = obj
    assert label_run(source="MASKS", masks=masks) == {"FINISHED"}
    result = read_ply(run / "result.ply")
    assert 0 < splats.count(obj) < len(result)
    assert_labels_of_run(obj, result)
    first = part.data.attributes["position"].data[0].vector.copy()
    part.data.attributes["position"].data[0].vector = (9, 9, 9)
    bpy.context.view_layer.objects.active = part
    assert_refused(label_run, "others: open the run's result.ply again", source="SALIENCY")
    part.data.attributes["position"].data[0].vector = first
    bpy.context.view_layer.objects.active = obj
    part.select_set(True)
    obj.select_set(True)
    bpy.ops.swag.merge_splats()
    assert label_run(source="MASKS", masks=masks) == {"FINISHED"}
    assert splats.count(obj) == len(result)
    assert_labels_of_run(obj, read_ply(run / "result.ply"))


def assert_labels_of_run(obj, result):
    """Assert that each splat has the label of the run's splat at its place."""
    rows = splats.find_rows(splats.positions(obj), result.positions)
    assert np.array_equal(labels.attribute(obj, "swag:label"), result.extras["label"][rows])
