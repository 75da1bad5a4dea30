"""What leaves Blender: chosen, modified, moved, wet or dry, with its cameras; the picture of the engine judges."""

import json

import numpy as np
import pycolmap
import pytest
import torch

from swag_engine.formats import water
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.splats import Splats

SETUP = """
import json, sys
from pathlib import Path
import numpy as np
from mathutils import Matrix
from bl_ext.user_default.swag_splatting.swag_blender import scene_import, splats
from bl_ext.user_default.swag_splatting.swag_blender.splat_export import ExportSettings, expected_size

bpy.ops.wm.read_homefile(use_empty=True)
folder = Path(sys.argv[1])

def opened(name, **options):
    assert bpy.ops.swag.import_splats(filepath=str(folder / name), **options) == {"FINISHED"}
    return bpy.context.active_object

def saved(name, **options):
    assert bpy.ops.swag.export_splats(filepath=str(folder / name), **options) == {"FINISHED"}

def refused(**options):
    try:
        bpy.ops.swag.export_splats(filepath=str(folder / "refused.ply"), **options)
    except RuntimeError as error:
        assert "Traceback" not in str(error), error
        return str(error).removeprefix("Error: ").strip()
    raise AssertionError("nothing was said")

def nodes_modifier(obj, node, **inputs):
    # A modifier with one node between the geometry that comes in and what goes on.
    tree = bpy.data.node_groups.new(node, "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, middle, end = (tree.nodes.new(n) for n in ("NodeGroupInput", node, "NodeGroupOutput"))
    tree.links.new(start.outputs[0], middle.inputs[0])
    tree.links.new(middle.outputs[0], end.inputs[0])
    for name, value in inputs.items():
        middle.inputs[name].default_value = value
    modifier = obj.modifiers.new(node, "NODES")
    modifier.node_group = tree
    obj.modifiers.move(len(obj.modifiers) - 1, 0)
    return tree, middle

def imported_scene(cameras=()):
    root = bpy.data.objects.new("reef", None)
    root[scene_import.ROOT_KEY] = "/data/reef"
    root.matrix_world = scene_import.colmap_to_blender(np.array([0.48, -0.8, 0.36]), np.array([[1.0, 2.0, 3.0]]))
    bpy.context.scene.collection.objects.link(root)
    for camera in cameras:
        scene_import.camera_object(camera, root, bpy.context.scene.collection)
    bpy.context.view_layer.update()
    return root
"""


def heap(count=1500, degree=3):
    """Splats around the origin with colours that change much with the view."""
    random = np.random.default_rng(3)
    rotations = random.normal(size=(count, 4))
    sh = random.normal(size=(count, (degree + 1) ** 2, 3)) * 0.2
    sh[:, 0] = random.uniform(-1.2, 1.5, (count, 3))
    columns = (
        random.uniform(-1, 1, (count, 3)),
        rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        np.exp(random.uniform(np.log(0.01), np.log(0.15), (count, 3))),
        random.uniform(0.1, 1, count),
        sh,
    )
    label = {"label": random.integers(0, 4, count).astype(np.int32)}
    return Splats(*(column.astype(np.float32) for column in columns), label)


def camera_at(pose, name="view", cx=80.0, cy=60.0):
    return Camera(name, 160, 120, 150.0, 150.0, cx, cy, np.linalg.inv(pose))


def looking_from(x, y, z):
    """A pose that looks at the origin."""
    place = np.array([x, y, z], float)
    forward = -place / np.linalg.norm(place)
    right = np.cross([0, 1, 0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.c_[right, np.cross(forward, right), forward, place]
    return pose


def drawn(splats, camera):
    positions, rotations, scales, opacities, sh = (
        torch.from_numpy(array)
        for array in (splats.positions, splats.rotations, splats.scales, splats.opacities, splats.sh)
    )
    cloud = GaussianCloud(
        positions, rotations, scales.log(), torch.logit(opacities, 1e-6), sh[:, :1], sh[:, 1:], torch.full((3,), -30.0)
    )
    return render(cloud, camera).color.numpy()


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))


def worldwards(matrix, pose):
    """The pose in a world that the similarity has moved."""
    moved = matrix @ pose
    moved[:3, :3] /= np.cbrt(np.linalg.det(matrix[:3, :3]))
    return moved


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_round_trip_of_a_moved_turned_scaled_and_cut_heap(blender, tmp_path, suffix):
    """The engine's picture of what comes back equals that of the truth, seen by a camera that moved along."""
    made = heap()
    write_ply(tmp_path / "heap.ply", made)
    printed = blender.run(
        SETUP
        + """
obj = opened("heap.ply")
obj.location, obj.rotation_euler, obj.scale = (1, 2, 3), (0.3, 0.5, 0.7), (1.6, 1.6, 1.6)
# A part is deleted: what lies above x = 0.3.
tree, delete = nodes_modifier(obj, "GeometryNodeDeleteGeometry")
position, split, compare = (tree.nodes.new(n) for n in
                            ("GeometryNodeInputPosition", "ShaderNodeSeparateXYZ", "FunctionNodeCompare"))
compare.inputs["B"].default_value = 0.3
tree.links.new(position.outputs[0], split.inputs[0])
tree.links.new(split.outputs["X"], compare.inputs["A"])
tree.links.new(compare.outputs[0], delete.inputs["Selection"])
saved(sys.argv[2])
assert all(modifier.show_viewport for modifier in obj.modifiers)
print("MATRIX", json.dumps([list(row) for row in splats.FILE_FRAME.inverted() @ obj.matrix_world]))
        """,
        tmp_path,
        f"moved.{suffix}",
    )
    matrix = np.array(blender.json_after("MATRIX", printed))
    back = read_ply(tmp_path / "moved.ply") if suffix == "ply" else read_glb(tmp_path / "moved.glb")
    kept = made.subset(made.positions[:, 0] <= 0.3)
    assert len(back) == len(kept) < 1200
    for place in ((0, 0, -4), (3, 1, 2), (-1, -3, 2)):
        pose = looking_from(*place)
        truth = drawn(kept, camera_at(pose))
        same = psnr(drawn(back, camera_at(worldwards(matrix, pose))), truth)
        unturned = psnr(drawn(made, camera_at(pose)), truth)
        print(suffix, place, same, unturned)
        assert same > 60 and unturned < 25 and truth.mean() > 0.1


def test_points_that_a_modifier_moves(blender, tmp_path):
    made = heap()
    write_ply(tmp_path / "heap.ply", made)
    blender.run(
        SETUP
        + """
obj = opened("heap.ply")
nodes_modifier(obj, "GeometryNodeSetPosition", Offset=(1, 2, 3))
saved("moved.ply")
obj.modifiers[0].show_viewport = False
saved("off.ply")
        """,
        tmp_path,
    )
    np.testing.assert_allclose(read_ply(tmp_path / "moved.ply").positions, made.positions + (1, 2, 3), atol=1e-5)
    np.testing.assert_allclose(read_ply(tmp_path / "off.ply").positions, made.positions, atol=1e-6)
    assert read_ply(tmp_path / "moved.ply").degree == 3 and "label" in read_ply(tmp_path / "moved.ply").extras


def test_points_deleted_in_edit_mode(blender, tmp_path):
    made = heap(100, 1)
    write_ply(tmp_path / "heap.ply", made)
    blender.run(
        SETUP
        + """
obj = opened("heap.ply")
selected = obj.data.attributes.new(".selection", "BOOLEAN", "POINT")
selected.data.foreach_set("value", [i < 30 for i in range(100)])
bpy.ops.object.mode_set(mode="EDIT")
bpy.ops.pointcloud.delete()
saved("edited.ply")
bpy.ops.object.mode_set(mode="OBJECT")
saved("cut.ply")
        """,
        tmp_path,
    )
    for name in ("edited.ply", "cut.ply"):
        np.testing.assert_allclose(read_ply(tmp_path / name).positions, made.positions[30:], atol=1e-6)


def test_choices(blender, tmp_path):
    """Selected or visible, labels by name, a turned crop box, opacity, degree, extras, metres, axes."""
    made = heap()
    write_ply(tmp_path / "heap.ply", made)
    (tmp_path / "labels.json").write_text(json.dumps({"labels": [{"id": 2, "name": "coral"}]}))
    printed = blender.run(
        SETUP
        + """
first, second, third = (opened("heap.ply") for _ in range(3))
second.hide_set(True)
third.location.x = 100
bpy.ops.object.select_all(action="DESELECT")
first.select_set(True)
saved("selected.ply")
saved("visible.ply", use="VISIBLE")
first.data.attributes["swag:label"]
first["swag_run"] = str(folder)
saved("coral.ply", labels="Coral, 3")
box = bpy.data.objects.new("box", None)
box.empty_display_size = 0.5
box.rotation_euler, box.location = (0, 0, 0.5), (0.2, 0, 0)
bpy.context.scene.collection.objects.link(box)
bpy.context.view_layer.update()
saved("cropped.ply", crop_object="box")
saved("plain.ply", min_opacity=0.5, sh_degree=1, extras=False)
saved("metres.ply", metres_per_unit=3.0, frame="Z_UP")
saved("y_up.ply", frame="Y_UP")
print("BOX", json.dumps([list(row) for row in box.matrix_world.inverted() @ splats.FILE_FRAME]))

settings = ExportSettings("SELECTED", "UPRIGHT", 1.0, 0.0, "", "", 0.5, 1, False, False)
said = [expected_size(bpy.context, Path("plain.ply"), settings)]
said.append(expected_size(bpy.context, Path("plain.glb"), replace(settings, min_opacity=1.0)))
print("SAID", json.dumps([*said, refused(labels="kelp"), refused(crop_object="gone"),
                          refused(min_opacity=1.0), refused(water=0.5), refused(cameras=True)]))
first.select_set(False)
second.hide_set(False)
second.select_set(True)
second.hide_set(True)
print("HIDDEN", json.dumps(refused()))
        """,
        tmp_path,
    )
    read = {path.stem: read_ply(path) for path in tmp_path.glob("*.ply")}
    np.testing.assert_allclose(read["selected"].positions, made.positions, atol=1e-6)
    assert len(read["visible"]) == 2 * len(made) and read["visible"].positions[:, 0].max() > 98
    np.testing.assert_array_equal(read["coral"].extras["label"], made.extras["label"][made.extras["label"] >= 2])
    to_box = np.array(blender.json_after("BOX", printed))
    inside = (np.abs(made.positions @ to_box[:3, :3].T + to_box[:3, 3]) <= 0.5).all(axis=1)
    np.testing.assert_allclose(read["cropped"].positions, made.positions[inside], atol=1e-6)
    assert 50 < inside.sum() < 400
    assert read["plain"].degree == 1 and not read["plain"].extras
    assert len(read["plain"]) == (made.opacities >= 0.5).sum()
    x, y, z = made.positions.T
    np.testing.assert_allclose(read["metres"].positions.T, [3 * x, 3 * z, -3 * y], atol=1e-5)
    np.testing.assert_allclose(read["metres"].scales, 3 * made.scales, rtol=1e-4)
    np.testing.assert_allclose(read["y_up"].positions.T, [x, -y, -z], atol=1e-6)
    said = blender.json_after("SAID", printed)
    size = (tmp_path / "plain.ply").stat().st_size
    assert said[0] == f"{len(read['plain'])} splats, {size / 1e6:.1f} MB"
    words = ["No splat is left", "no label named kelp", "no object gone", "No splat is left", "no imported scene",
             "no cameras"]  # fmt: skip
    assert all(word in sentence and sentence.endswith(".") for word, sentence in zip(words, said[1:], strict=True)), (
        said
    )
    assert "select" in blender.json_after("HIDDEN", printed)
    assert not list(tmp_path.glob("refused*"))


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_water_and_cameras_of_an_imported_scene(blender, tmp_path, suffix):
    """The scene was moved and scaled in Blender: the cameras that go out see what those of the scene saw."""
    made = heap()
    write_ply(tmp_path / "heap.ply", made)
    sea = {"beta_D": [0.3, 0.1, 0.05], "beta_B": [0.1, 0.1, 0.1], "light": "linear", "per": "unit"}
    sea["veil_sh"] = np.random.default_rng(0).normal(size=(9, 3)).tolist()
    (tmp_path / "water.json").write_text(json.dumps(sea))
    RunFolder(tmp_path).write_config(tmp_path, TrainSettings(), [0, -1, 0])
    poses = [looking_from(0, 0.5, -4), looking_from(2, -1, -3)]
    cameras = [camera_at(pose, f"{i}.jpg", 83.0, 57.0) for i, pose in enumerate(poses)]
    given = [
        {"name": c.name, "width": 160, "height": 120, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}
        | {"world_to_camera": c.world_to_camera.tolist()}
        for c in cameras
    ]
    blender.run(
        SETUP
        + """
root = imported_scene(json.loads(sys.argv[3]))
root.location, root.scale = (5, -2, 1), (2, 2, 2)
obj = opened("heap.ply", frame="SCENE")
obj["swag_run"] = str(folder)
saved(sys.argv[2], water=0.7, cameras=True)
        """,
        tmp_path,
        f"out.{suffix}",
        json.dumps(given),
    )
    back = read_ply(tmp_path / "out.ply") if suffix == "ply" else read_glb(tmp_path / "out.glb", up=(0, 1, 0))
    truth = water.bake_water(made, sea, cameras, 0.7)
    model = pycolmap.Reconstruction(str(tmp_path / "out_cameras" / "sparse" / "0"))
    assert len(model.images) == 2
    for image, camera in zip(sorted(model.images.values(), key=lambda image: image.name), cameras, strict=True):
        lens = model.cameras[image.camera_id]
        np.testing.assert_allclose(lens.params, (camera.fx, camera.fy, camera.cx, camera.cy), atol=1e-3)
        pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        outside = Camera(image.name, lens.width, lens.height, *lens.params, pose)
        same = psnr(drawn(back, outside), drawn(truth, camera))
        dry = psnr(drawn(made, camera), drawn(truth, camera))
        print(suffix, same, dry)
        assert same > 50 and dry < 30
    ours = json.loads((tmp_path / "out_cameras" / "water.json").read_text())
    np.testing.assert_allclose(np.array(ours["beta_D"]) * 2, sea["beta_D"], rtol=1e-5)
    if suffix == "glb":
        data = (tmp_path / "out.glb").read_bytes()
        document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
        assert [camera["name"] for camera in document["cameras"]] == ["0.jpg", "1.jpg"]
