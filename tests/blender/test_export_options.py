"""Options of the export: selection, modifiers, transforms, water and cameras, against images of the engine."""

import json
from typing import Any

import numpy as np
import pycolmap
import pytest

from swag_engine.formats import water
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.scene.cameras import Camera
from swag_engine.settings.settings import TrainSettings
from tests.scenes.clouds import draw_splats, random_splats


def heap(count=1500, degree=3):
    """Splats around the origin with colors that change much with the view."""
    return random_splats(count, [1, 1, 1], (np.log(0.01), np.log(0.15)), degree)


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


def render_splats(splats, camera):
    return draw_splats(splats, camera).color.numpy()


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))


def moved_pose(matrix, pose):
    """The pose in a world that the similarity has moved."""
    moved = matrix @ pose
    moved[:3, :3] /= np.cbrt(np.linalg.det(matrix[:3, :3]))
    return moved


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_a_moved_and_cut_object_renders_the_same_after_export(blender, tmp_path, suffix):
    """The engine's image of the exported file, by a camera that moved with the object, equals that of the original."""
    made = heap()
    write_ply(tmp_path / "heap.ply", made)
    matrix = np.array(blender.run("export_options.move_and_cut", tmp_path, suffix))
    back = read_ply(tmp_path / "moved.ply") if suffix == "ply" else read_glb(tmp_path / "moved.glb")
    kept = made.subset(made.positions[:, 0] <= 0.3)
    assert len(back) == len(kept) < 1200
    for place in ((0, 0, -4), (3, 1, 2), (-1, -3, 2)):
        pose = looking_from(*place)
        truth = render_splats(kept, camera_at(pose))
        moved = psnr(render_splats(back, camera_at(moved_pose(matrix, pose))), truth)
        unmoved = psnr(render_splats(made, camera_at(pose)), truth)
        print(suffix, place, moved, unmoved)
        assert moved > 60 and unmoved < 25 and truth.mean() > 0.1


def test_points_that_a_modifier_moves_are_exported_moved(blender, tmp_path):
    made = heap()
    write_ply(tmp_path / "heap.ply", made)
    blender.run("export_options.moving_modifier", tmp_path)
    np.testing.assert_allclose(read_ply(tmp_path / "moved.ply").positions, made.positions + (1, 2, 3), atol=1e-5)
    np.testing.assert_allclose(read_ply(tmp_path / "off.ply").positions, made.positions, atol=1e-6)
    assert read_ply(tmp_path / "moved.ply").degree == 3 and "label" in read_ply(tmp_path / "moved.ply").extras


def test_points_deleted_in_edit_mode_are_not_exported(blender, tmp_path):
    made = heap(100, 1)
    write_ply(tmp_path / "heap.ply", made)
    blender.run("export_options.delete_in_edit_mode", tmp_path)
    for name in ("edited.ply", "cut.ply"):
        np.testing.assert_allclose(read_ply(tmp_path / name).positions, made.positions[30:], atol=1e-6)


def test_each_option_selects_or_converts_the_splats(blender, tmp_path):
    """Selected or visible, labels by name, a rotated crop box, opacity, degree, extras, metres, axes."""
    made = heap()
    write_ply(tmp_path / "heap.ply", made)
    (tmp_path / "labels.json").write_text(json.dumps({"labels": [{"id": 2, "name": "coral"}]}))
    found = blender.run("export_options.options", tmp_path)
    read = {path.stem: read_ply(path) for path in tmp_path.glob("*.ply")}
    np.testing.assert_allclose(read["selected"].positions, made.positions, atol=1e-6)
    assert len(read["visible"]) == 2 * len(made) and read["visible"].positions[:, 0].max() > 98
    np.testing.assert_array_equal(read["coral"].extras["label"], made.extras["label"][made.extras["label"] >= 2])
    to_box = np.array(found["to_box"])
    inside = (np.abs(made.positions @ to_box[:3, :3].T + to_box[:3, 3]) <= 0.5).all(axis=1)
    np.testing.assert_allclose(read["cropped"].positions, made.positions[inside], atol=1e-6)
    assert 50 < inside.sum() < 400
    assert read["plain"].degree == 1 and not read["plain"].extras
    assert len(read["plain"]) == (made.opacities >= 0.5).sum()
    x, y, z = made.positions.T
    np.testing.assert_allclose(read["metres"].positions.T, [3 * x, 3 * z, -3 * y], atol=1e-5)
    np.testing.assert_allclose(read["metres"].scales, 3 * made.scales, rtol=1e-4)
    np.testing.assert_allclose(read["y_up"].positions.T, [x, -y, -z], atol=1e-6)
    size = (tmp_path / "plain.ply").stat().st_size
    assert found["expected sizes"][0] == f"{len(read['plain'])} splats, {size / 1e6:.1f} MB"
    assert found["expected sizes"][1].startswith("No splat is left")
    for words, message in found["messages"].items():
        assert words in message and message.endswith("."), (words, message)
    assert not list(tmp_path.glob("refused*"))


def test_all_visible_or_selected_splats_are_exported(blender, tmp_path):
    """After isolating a label, only what is shown is written by default; a crop box moves with its object."""
    made = heap()
    write_ply(tmp_path / "heap.ply", made)
    messages = blender.run("export_options.parts", tmp_path)
    read = {path.stem: read_ply(path) for path in tmp_path.glob("*.ply")}
    label = made.extras["label"]
    shown = made.positions[label == 2]
    np.testing.assert_allclose(read["visible"].positions, np.concatenate([shown, shown]), atol=1e-6)
    # What was exported later was moved by 7 as an object, and by 1 with a modifier.
    moved = made.positions + (8, 0, 0)
    selected = (np.arange(len(made)) < 50) & (label == 2)  # of those that are shown
    np.testing.assert_allclose(read["selected"].positions, moved[selected], atol=2e-6)
    np.testing.assert_allclose(read["all"].positions, moved, atol=2e-6)
    assert set(read["all"].extras) == {"label"}, "what the viewport shows is no property of the file"
    x, y, z = made.positions.T  # Blender's z is -y of the file
    inside = (np.abs(x) <= 0.5) & (np.abs(y) <= 2) & (np.abs(z) <= 0.5) & (label == 2)
    np.testing.assert_allclose(read["cropped"].positions, moved[inside], atol=2e-6)
    assert 20 < inside.sum() < (label == 2).sum() / 2
    assert len(read["flat"]) == len(shown), "a box without volume does not crop"
    assert len(read["outside"]) == len(made)
    for words, message in messages.items():
        assert words in message and message.endswith("."), (words, message)
    assert not (tmp_path / "refused.ply").exists()


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_water_and_cameras_of_an_imported_scene_are_exported(blender, tmp_path, suffix):
    """The scene was moved and scaled in Blender: the exported cameras see what the cameras of the scene saw."""
    made = heap()
    write_ply(tmp_path / "heap.ply", made)
    fitted: dict[str, Any] = {"beta_D": [0.3, 0.1, 0.05], "beta_B": [0.1, 0.1, 0.1], "light": "linear", "per": "unit"}
    fitted["background_sh"] = np.random.default_rng(0).normal(size=(9, 3)).tolist()
    (tmp_path / "water.json").write_text(json.dumps(fitted))
    RunFolder(tmp_path).write_config(tmp_path, TrainSettings(), [0, -1, 0])
    poses = [looking_from(0, 0.5, -4), looking_from(2, -1, -3)]
    cameras = [camera_at(pose, f"{i}.jpg", 83.0, 57.0) for i, pose in enumerate(poses)]
    given = [
        {"name": c.name, "width": 160, "height": 120, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}
        | {"world_to_camera": c.world_to_camera.tolist()}
        for c in cameras
    ]
    (tmp_path / "cameras.json").write_text(json.dumps(given))
    blender.run("export_options.water_and_cameras", tmp_path, suffix)
    back = read_ply(tmp_path / "out.ply") if suffix == "ply" else read_glb(tmp_path / "out.glb", up=(0, 1, 0))
    truth = water.bake_water(made, fitted, cameras, 0.7)
    model = pycolmap.Reconstruction(str(tmp_path / "out_cameras" / "sparse" / "0"))
    assert len(model.images) == 2
    for image, camera in zip(sorted(model.images.values(), key=lambda image: image.name), cameras, strict=True):
        lens = model.cameras[image.camera_id]
        np.testing.assert_allclose(lens.params, (camera.fx, camera.fy, camera.cx, camera.cy), atol=1e-3)
        pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        fx, fy, cx, cy = lens.params
        outside = Camera(image.name, lens.width, lens.height, fx, fy, cx, cy, pose)
        same = psnr(render_splats(back, outside), render_splats(truth, camera))
        dry = psnr(render_splats(made, camera), render_splats(truth, camera))
        print(suffix, same, dry)
        assert same > 50 and dry < 30
    exported = json.loads((tmp_path / "out_cameras" / "water.json").read_text())
    np.testing.assert_allclose(np.array(exported["beta_D"]) * 2, fitted["beta_D"], rtol=1e-5)
    if suffix == "glb":
        data = (tmp_path / "out.glb").read_bytes()
        document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
        assert [camera["name"] for camera in document["cameras"]] == ["0.jpg", "1.jpg"]
