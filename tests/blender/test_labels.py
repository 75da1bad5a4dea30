"""Labels of splats in Blender: list, show, select, search, masks, separate, merge."""

import json
import sys

import cv2
import numpy as np

SETUP = """
import json, sys
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import labels, splats
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview
from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats

bpy.ops.wm.read_homefile(use_empty=True)
bpy.context.preferences.edit.use_global_undo = True
scene = bpy.context.scene

def labelled(numbers, name="reef", location=(0, 0, 0)):
    count = len(numbers)
    random = np.random.default_rng(0)
    made = Splats(
        random.normal(size=(count, 3)).astype("f4"), np.tile(np.array([1, 0, 0, 0], "f4"), (count, 1)),
        random.uniform(0.01, 0.1, (count, 3)).astype("f4"), random.uniform(0.2, 1, count).astype("f4"),
        random.normal(size=(count, 4, 3)).astype("f4"), {"label": np.array(numbers, "i4")},
    )
    obj = splats.new_splat_object(name, made, scene.collection)
    obj.location = location
    for other in scene.objects:
        other.select_set(other == obj)
    bpy.context.view_layer.objects.active = obj
    bpy.context.view_layer.update()
    return obj, made

def shown(obj):
    graph = bpy.context.evaluated_depsgraph_get()
    graph.update()
    return sum(i.is_instance for i in graph.object_instances)

def points(obj, shown):
    splat_preview.set_input(obj, splat_preview.POINTS_IN_VIEWPORT, shown)

def refused(operator, message, **arguments):
    try:
        operator(**arguments)
    except RuntimeError as error:
        assert message in str(error), error
    else:
        raise AssertionError("not refused")
"""


def write_run(folder, names):
    entries = [{"id": i, "name": name, "count": 1, "share": 0.1} for i, name in enumerate(names, 1)]
    (folder / "labels.json").write_text(json.dumps({"labels": entries}))
    return folder


def test_labels_are_listed_with_their_names_and_hidden_shown_isolated(blender, tmp_path):
    write_run(tmp_path, ["coral", "wreck"])
    blender.run(
        SETUP
        + """
obj, made = labelled([1] * 50 + [2] * 30 + [0] * 20 + [7] * 5)
points(obj, False)
assert shown(obj) == 105
assert bpy.ops.swag.read_labels(directory=sys.argv[1]) == {"FINISHED"}
entries = obj.swag_labels.entries
listed = [(e.number, e.name, e.count, e.visible) for e in entries]
assert listed == [(1, "coral", 50, True), (2, "wreck", 30, True), (0, "No label", 20, True), (7, "Label 7", 5, True)]
assert len({tuple(e.color) for e in entries}) == 4 and shown(obj) == 105
entries[0].visible = False
assert shown(obj) == 55
assert bpy.ops.swag.isolate_label(number=2) == {"FINISHED"} and shown(obj) == 30
bpy.ops.swag.isolate_label(number=2)
assert shown(obj) == 105 and all(e.visible for e in entries)
entries[1].visible = False
bpy.ops.swag.read_labels(directory=sys.argv[1])
assert shown(obj) == 75 and not entries[1].visible
bpy.ops.swag.show_labels()
assert shown(obj) == 105
# Colours are mixed in where they are asked for.
def tints():
    values = np.empty(105 * 4, "f4")
    obj.data.attributes["swag:tint"].data.foreach_get("color", values)
    return values.reshape(-1, 4)
assert not tints().any()
obj.swag_labels.tinted = True
entries[0].color = (0, 1, 0)
tint = tints()
def drawn():
    graph = bpy.context.evaluated_depsgraph_get()
    graph.update()
    found = obj.evaluated_get(graph).data.attributes["swag:color"]
    values = np.empty(len(found.data) * 3, "f4")
    found.data.foreach_get("vector", values)
    return values.reshape(-1, 3)
points(obj, True)
tinted = drawn()
obj.swag_labels.tinted = False
plain = drawn()
obj.swag_labels.tinted = True
assert np.allclose(tinted, plain + (tint[:, :3] - plain) * tint[:, 3:], atol=1e-5)
points(obj, False)
assert np.allclose(tint[0, :3], (0, 1, 0)) and 0 < tint[0, 3] < 1 and not tint[85].any() and tint[60, 3] > 0
# What the splats are is not touched by any of it, and all of it is in the file.
back = splats.read_splats(obj)
assert np.array_equal(back.positions, made.positions) and list(back.extras) == ["label"]
entries[0].visible = False
name = obj.name
bpy.ops.wm.save_as_mainfile(filepath=bpy.app.tempdir + "labels.blend")
bpy.ops.wm.open_mainfile(filepath=bpy.app.tempdir + "labels.blend")
obj = bpy.data.objects[name]
assert [e.name for e in obj.swag_labels.entries][:2] == ["coral", "wreck"] and shown(obj) == 55
        """,
        tmp_path,
    )


def test_labels_are_selected_and_kept_as_masks(blender, tmp_path):
    write_run(tmp_path, ["coral", "wreck"])
    blender.run(
        SETUP
        + """
obj, made = labelled([1] * 50 + [2] * 30 + [0] * 20)
refused(bpy.ops.swag.keep_mask, "No splats of reef are selected")
bpy.ops.swag.read_labels(directory=sys.argv[1])
bpy.ops.swag.select_label(number=2)
assert np.array_equal(labels.attribute(obj, "swag:selected"), made.extras["label"] == 2)
bpy.ops.swag.select_label(number=0, extend=True)
assert labels.attribute(obj, "swag:selected").sum() == 50
bpy.ops.swag.keep_mask(name="old iron")
assert np.array_equal(labels.attribute(obj, "mask:old iron"), made.extras["label"] != 1)
assert obj.data.attributes["mask:old iron"].data_type == "BOOLEAN"
# The mask reaches geometry nodes.
tree = bpy.data.node_groups.new("mask", "GeometryNodeTree")
tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
read, drop = tree.nodes.new("GeometryNodeInputNamedAttribute"), tree.nodes.new("GeometryNodeDeleteGeometry")
read.data_type = "BOOLEAN"
read.inputs["Name"].default_value = "mask:old iron"
tree.links.new(start.outputs[0], drop.inputs["Geometry"])
tree.links.new(next(s for s in read.outputs if s.enabled and s.name == "Attribute"), drop.inputs["Selection"])
tree.links.new(drop.outputs[0], end.inputs[0])
modifier = obj.modifiers.new("mask", "NODES")
modifier.node_group = tree
obj.modifiers.move(1, 0)
points(obj, False)
assert shown(obj) == 50
        """,
        tmp_path,
    )


def test_search_writes_similarity_and_the_threshold_selects_live(blender, tmp_path):
    from safetensors.numpy import save_file

    random = np.random.default_rng(0)
    prototypes = np.eye(32, dtype=np.float32)[:2]
    features = prototypes[np.repeat([0, 1], [60, 40])] + 0.1 * random.normal(size=(100, 32)).astype(np.float32)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    write_run(tmp_path, ["brain coral", "wreck"])
    save_file({"features": features.astype(np.float32), "prototypes": prototypes}, tmp_path / "semantics.safetensors")
    np.save(tmp_path / "expected.npy", features @ prototypes[0])
    blender.run(
        SETUP
        + """
obj, made = labelled([1] * 60 + [2] * 40)
refused(bpy.ops.swag.search_labels, "No label is called coral: the labels are not read yet", words="coral")
bpy.ops.swag.read_labels(directory=sys.argv[1])
obj.swag_labels.words = ""
refused(bpy.ops.swag.search_labels, "There is nothing to search for")
bpy.ops.swag.search_labels(words="Coral")
expected = np.load(sys.argv[1] + "/expected.npy")
assert np.allclose(labels.attribute(obj, "swag:similarity"), expected, atol=1e-6)
assert np.array_equal(labels.attribute(obj, "swag:selected"), expected > 0.5)
for threshold in (-1, 0.1, 0.8, 1):
    obj.swag_labels.threshold = threshold
    assert np.array_equal(labels.attribute(obj, "swag:selected"), expected > np.float32(threshold)), threshold
# Splats that the run's features are not of are found by their label alone.
few, _ = labelled([1, 2, 1], "few")
bpy.ops.swag.read_labels(directory=sys.argv[1])
bpy.ops.swag.search_labels(words="coral")
assert labels.attribute(few, "swag:similarity").tolist() == [1, 0, 1]
# What no label is called needs the engine, which says so where it cannot.
bpy.context.scene.swag.scene_folder = ""
import os
os.environ["SWAG_ENGINE_PYTHON"] = "/nowhere"
refused(bpy.ops.swag.search_labels, "/nowhere cannot be run", words="eel")
        """,
        tmp_path,
    )


def test_separate_and_merge_bring_all_splats_back_where_they_were(blender, tmp_path):
    write_run(tmp_path, ["coral", "wreck"])
    blender.run(
        SETUP
        + """
obj, made = labelled([1, 2] * 50 + [0] * 10, location=(1, 2, 3))
obj.rotation_euler = (0.3, 0, 0.5)
obj["swag_background"] = [0.1, 0.2, 0.3]
bpy.ops.swag.read_labels(directory=sys.argv[1])
refused(bpy.ops.swag.separate_splats, "No splats of reef are selected")
bpy.ops.swag.select_label(number=2)
bpy.context.view_layer.update()
where = obj.matrix_world.copy()
assert bpy.ops.swag.separate_splats() == {"FINISHED"}
part = bpy.context.active_object
bpy.context.view_layer.update()
assert part.name == "reef wreck" and len(part.data.points) == 50 and len(obj.data.points) == 60
assert np.allclose(part.matrix_world, where, atol=1e-6)
assert list(part["swag_background"]) == list(obj["swag_background"])
assert [(e.name, e.count) for e in part.swag_labels.entries] == [("wreck", 50)]
assert [(e.name, e.count) for e in obj.swag_labels.entries] == [("coral", 50), ("No label", 10)]
assert np.array_equal(splats.read_splats(part).positions, made.positions[made.extras["label"] == 2])
refused(bpy.ops.swag.merge_splats, "Only one object with splats is selected")
bpy.ops.swag.select_label(number=2)
refused(bpy.ops.swag.separate_splats, "All splats of reef wreck are selected")
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
        """,
        tmp_path,
    )


def test_undo_takes_a_separation_back(blender, tmp_path):
    write_run(tmp_path, ["coral", "wreck"])
    blender.run(
        SETUP
        + """
obj, made = labelled([1, 2] * 50)
bpy.ops.swag.read_labels(directory=sys.argv[1])
bpy.ops.swag.select_label(number=2)
bpy.ops.ed.undo_push(message="before")
bpy.ops.swag.separate_splats()
assert len(bpy.data.objects["reef"].data.points) == 50 and len(scene.objects) == 2
bpy.ops.ed.undo_push(message="after")
bpy.ops.ed.undo()
assert len(bpy.data.objects["reef"].data.points) == 100 and len(bpy.data.objects) == 1
assert [e.name for e in bpy.data.objects["reef"].swag_labels.entries] == ["coral", "wreck"]
        """,
        tmp_path,
    )


def test_splats_without_labels_say_what_to_do(blender, tmp_path):
    blender.run(
        SETUP
        + """
assert not bpy.ops.swag.read_labels.poll()
obj, made = labelled([1, 2, 3])
plain = splats.new_splat_object("plain", Splats(made.positions, made.rotations, made.scales, made.opacities, made.sh),
                                scene.collection)
bpy.context.view_layer.objects.active = plain
refused(bpy.ops.swag.read_labels, "The splats of plain have no labels: label the run")
from pathlib import Path
bpy.context.view_layer.objects.active = obj
Path(sys.argv[1], "labels.json").write_text('{"labels": [{"name": 3}]}')
refused(bpy.ops.swag.read_labels, "labels.json does not list labels", directory=sys.argv[1])
assert bpy.ops.swag.read_labels() == {"FINISHED"} and len(obj.swag_labels.entries) == 3
        """,
        tmp_path,
    )


def test_a_run_is_labelled_through_the_engine(blender, tiny_scene, tmp_path):
    from swag_engine.settings.settings import TrainSettings
    from swag_engine.training.trainer import train

    train(tiny_scene, tmp_path / "run", TrainSettings(iterations=20, width=64, max_gaussians=320, sh_degree=0))
    for name, columns in (("left", slice(0, 30)), ("right", slice(30, 64))):
        (tmp_path / "masks" / name).mkdir(parents=True)
        mask = np.zeros((48, 64), np.uint8)
        mask[:, columns] = 255
        for photograph in (tiny_scene / "images").iterdir():
            cv2.imwrite(str(tmp_path / "masks" / name / photograph.name), mask)
    printed = blender.run(
        SETUP
        + """
from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import read_ply
from pathlib import Path
run, masks = Path(sys.argv[1], "run"), sys.argv[1] + "/masks"
obj = splats.new_splat_object("reef", read_ply(run / "result.ply"), scene.collection)
bpy.context.view_layer.objects.active = obj
obj.select_set(True)
refused(bpy.ops.swag.label_run, "are from no run")
obj["swag_run"] = str(run)
refused(bpy.ops.swag.label_run, "There is no folder of masks: choose it", source="MASKS")
refused(bpy.ops.swag.label_run, "There is nothing to look for: write words", source="WORDS", words=" ")
refused(bpy.ops.swag.label_run, "One of the words to look for is empty", source="WORDS", words="coral,,")
refused(bpy.ops.swag.label_run, "allow online access", source="WORDS", words="coral", download=True)
refused(bpy.ops.swag.label_run, "There is no folder", source="MASKS", masks=masks + "/none")
assert "swag:label" not in obj.data.attributes and not (run / "labels.json").exists()

assert bpy.ops.swag.label_run(source="MASKS", masks=masks) == {"FINISHED"}
assert {e.name for e in obj.swag_labels.entries if e.number} == {"left", "right"}
assert np.array_equal(labels.attribute(obj, "swag:label"), read_ply(run / "result.ply").extras["label"])
status = bpy.context.window_manager.swag
assert status.message.startswith("2 labels: ") and not status.failed and not status.job
x, left = splats.read_splats(obj).positions[:, 0], labels.attribute(obj, "swag:label")
bpy.ops.swag.select_label(number=next(e.number for e in obj.swag_labels.entries if e.name == "left"))
mask = labels.attribute(obj, "swag:selected")
assert x[mask].mean() < x[~mask].mean() - 1
bpy.ops.swag.keep_mask(name="kept")
bpy.ops.swag.search_labels(words="left")
assert labels.attribute(obj, "swag:similarity")[mask].mean() > labels.attribute(obj, "swag:similarity")[~mask].mean()

# Labelled again, the splats stay and so does what was kept of them; in parts, they are not of the run.
assert bpy.ops.swag.label_run(source="SALIENCY") == {"FINISHED"}
assert np.array_equal(labels.attribute(obj, "mask:kept"), mask) and not {"left", "right"} & set(
    e.name for e in obj.swag_labels.entries)
bpy.ops.swag.select_label(number=obj.swag_labels.entries[0].number)
bpy.ops.swag.separate_splats()
part = bpy.context.active_object
bpy.context.view_layer.objects.active = obj
refused(bpy.ops.swag.label_run, "merge its parts, or open result.ply again", source="SALIENCY")
part.select_set(True), obj.select_set(True)
bpy.ops.swag.merge_splats()
assert bpy.ops.swag.label_run(source="MASKS", masks=masks) == {"FINISHED"}
assert np.array_equal(labels.attribute(obj, "swag:label"), read_ply(run / "result.ply").extras["label"])
        """,
        tmp_path,
        SWAG_ENGINE_PYTHON=sys.executable,
    )
    assert "Labelling: Regions" in printed
