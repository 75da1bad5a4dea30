"""A scene's cameras, images and points as Blender objects."""

import json

import cv2
import numpy as np
import pytest


def turned(axis, angle):
    """Rotation (3, 3) by Rodrigues' formula."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def write_result(folder, cameras, points, up=(0.0, -1.0, 0.0)):
    """The `inspect` result of a scene of cameras (dicts) and points (P, 3), as a file for the script."""
    np.save(folder / "xyz.npy", points.astype(np.float32))
    np.save(folder / "rgb.npy", np.full((len(points), 3), (10, 128, 250), np.uint8))
    arrays = {"positions": str(folder / "xyz.npy"), "colors": str(folder / "rgb.npy"), "count": len(points)}
    path = folder / "result.json"
    path.write_text(json.dumps({"scene": "/data/reef", "points": arrays, "up": list(up), "cameras": cameras}))
    return path


def camera(name, width, height, fx, fy, cx, cy, image=""):
    pose = np.eye(4)
    pose[:3, :3] = turned((1, 2, 3), 0.8)
    pose[:3, 3] = (0.3, -0.2, 4.0)
    size = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return {"name": name, **size, "world_to_camera": pose.tolist(), "image": image}


CAMERAS = [
    camera("landscape", 640, 360, 500.0, 500.0, 320.0, 180.0),
    camera("portrait, shifted", 300, 400, 350.0, 350.0, 130.5, 222.25),
    camera("flat pixels, landscape", 640, 480, 500.0, 550.0, 310.0, 250.0),
    camera("tall pixels, portrait", 480, 640, 600.0, 510.0, 250.0, 300.0),
]


def test_cameras_project_as_the_pinhole_does(blender, tmp_path):
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    worst = blender.run("scene_objects.projection_errors", write_result(tmp_path, CAMERAS, points))
    assert len(worst) == 4 and max(worst.values()) < 0.01, worst


def test_the_root_turns_up_to_z_and_puts_the_scene_on_the_ground(blender, tmp_path):
    points = np.random.default_rng(1).normal((5, 6, 7), (1, 2, 3), (1000, 3))
    np.save(tmp_path / "points.npy", points)
    ups = ((0.0, -1.0, 0.0), (0.6, 0.0, -0.8), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0))
    matrices = blender.run("scene_objects.root_matrices", ups, tmp_path / "points.npy")
    for up, matrix in zip(ups, np.array(matrices), strict=True):
        assert np.allclose(matrix[:3, :3] @ up, (0, 0, 1), atol=1e-6)
        assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1, abs=1e-6)
        placed = points @ matrix[:3, :3].T + matrix[:3, 3]
        assert np.allclose(np.median(placed[:, :2], axis=0), 0, atol=1e-5)
        assert np.percentile(placed[:, 2], 2) == pytest.approx(0, abs=1e-5)


def test_cameras_with_images_and_points_with_colors_have_one_root(blender, tmp_path):
    image = tmp_path / "Foto ä 1.png"
    cv2.imencode(".png", np.full((360, 640, 3), 90, np.uint8))[1].tofile(image)
    cameras = [camera("first.png", 640, 360, 500.0, 500.0, 320.0, 180.0, str(image))]
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    scene = blender.run("scene_objects.describe", write_result(tmp_path, cameras, points))
    assert scene["root"] == "reef" and scene["folder"] == "/data/reef" and scene["found"]
    assert scene["parents"] == [True, True] and scene["collections"] == ["reef", "reef Cameras"]
    assert scene["image"] == str(image) and scene["shown"] and 0 < scene["alpha"] < 1
    assert scene["size"] == [640, 360]
    assert scene["count"] == 50 and scene["material"] == "SWAG Points" and scene["radius"] > 0
    assert np.allclose(np.array(scene["color"]) * 255, (10, 128, 250, 255), atol=0.01)
    assert np.allclose(scene["position"], scene["expected position"])
    assert scene["pixel size"] == pytest.approx(1 / 250)
    assert scene["scenes"] == 1 and scene["meshes"] == 0
    assert np.allclose(scene["up"], (0, -1, 0), atol=1e-6)


def test_a_scene_without_points_keeps_its_up_direction(blender, tmp_path):
    up = (0.6, 0.0, -0.8)
    found = blender.run("scene_objects.up_direction", write_result(tmp_path, CAMERAS, np.zeros((0, 3)), up))
    assert np.allclose(found, up, atol=1e-6)


def test_a_hundred_images_and_a_hundred_thousand_points_are_imported_in_three_seconds(blender, tmp_path):
    cameras = []
    for i in range(100):
        image = tmp_path / f"{i:03}.jpg"
        image.write_bytes(cv2.imencode(".jpg", np.full((1080, 1920, 3), i, np.uint8))[1].tobytes())
        cameras.append(camera(image.name, 1920, 1080, 1500.0, 1500.0, 960.0, 540.0, str(image)))
    points = np.random.default_rng(0).normal(size=(100_000, 3))
    seconds = blender.run("scene_objects.import_seconds", write_result(tmp_path, cameras, points))
    print(blender.version, seconds)
    assert seconds < 3
