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


@pytest.mark.parametrize(("extent", "factor"), [(0.2, 50), (3, 10 / 3), (10, 1), (400, 1)])
def test_a_small_scene_without_a_known_scale_is_shown_larger_than_the_default_cube(blender, tmp_path, extent, factor):
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 0.5) for z in (0, 0.1)]) * extent
    path = write_result(tmp_path, [], np.repeat(corners, 20, axis=0))
    found = blender.run("scene_objects.shown_box", path)
    assert found["factor"] == pytest.approx(factor)
    assert max(found["size"]) == pytest.approx(extent * factor)


def test_cameras_with_images_and_points_with_colors_have_one_root(blender, tmp_path):
    image = tmp_path / "Foto ä 1.png"
    cv2.imencode(".png", np.full((360, 640, 3), 90, np.uint8))[1].tofile(image)
    cameras = [camera("first.png", 640, 360, 500.0, 500.0, 320.0, 180.0, str(image))]
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    scene = blender.run("scene_objects.describe", write_result(tmp_path, cameras, points))
    assert scene["root"] == "reef" and scene["folder"] == "/data/reef" and scene["found"]
    assert scene["parents"] == [True, True] and scene["lines"] == []
    assert scene["collections"] == ["reef", "reef Cameras"]
    assert scene["image"] == str(image) and scene["shown"] and 0 < scene["alpha"] < 1
    assert scene["size"] == [640, 360]
    assert scene["count"] == 50 and scene["material"] == "SWAG Points" and scene["radius"] > 0
    assert np.allclose(np.array(scene["color"]) * 255, (10, 128, 250, 255), atol=0.01)
    assert np.allclose(scene["position"], scene["expected position"])
    assert scene["pixel size"] == pytest.approx(1 / 250)
    assert scene["scenes"] == 1 and scene["meshes"] == 0
    assert np.allclose(scene["up"], (0, -1, 0), atol=1e-6)


def row_of_cameras(count, step):
    """Cameras `step` apart in a row."""
    made = []
    for index in range(count):
        own = camera(f"{index}.png", 640, 360, 500.0, 500.0, 320.0, 180.0)
        own["world_to_camera"] = np.eye(4).tolist()
        own["world_to_camera"][0][3] = -index * step
        made.append(own)
    return made


@pytest.mark.parametrize(
    ("count", "step", "size"),
    [
        pytest.param(5, 2.0, 1.0, id="half the distance to the next camera"),
        pytest.param(50, 0.01, 0.2, id="crowded: a hundredth of the scene"),
        pytest.param(2, 100.0, 5.0, id="far apart: a twentieth of the scene"),
        pytest.param(1, 0.0, 1.0, id="one camera: a twentieth of the scene"),
        pytest.param(3, 0.0, 0.2, id="at one place: a hundredth of the scene"),
    ],
)
def test_cameras_are_drawn_at_a_size_that_fits_the_scene(blender, tmp_path, count, step, size):
    # The inner 90 % of each axis span 20 / sqrt(3), their diagonal 20; points that are wrong are far away.
    points = np.random.default_rng(0).uniform(-1, 1, (20_000, 3)) * 10 / 0.9 / 3**0.5
    points[:100] *= 1000
    found = blender.run("scene_objects.camera_sizes", write_result(tmp_path, row_of_cameras(count, step), points))
    assert found["size"] == pytest.approx(size, rel=0.15)
    assert found["clip"][0] < 0.15 and found["clip"][1] > 1000


def test_cameras_points_and_splats_move_with_the_root(blender, tmp_path):
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    moved = blender.run("scene_objects.move_root", write_result(tmp_path, CAMERAS, points))
    assert len(moved) == 5 and np.allclose(list(moved.values()), (0, 0, 7), atol=1e-5)


def test_sparse_points_are_hidden_when_splats_arrive_and_can_be_shown_again(blender, tmp_path):
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    found = blender.run("scene_objects.splats_arrive", write_result(tmp_path, CAMERAS, points), tmp_path)
    assert found == {"imported": False, "first preview": True, "shown again": False, "opened file": True}


def test_a_framed_viewport_shows_the_whole_scene_from_any_direction(blender):
    random = np.random.default_rng(0)
    for low, high, lens, width, height in (
        ((-1, -2, -3), (4, 5, 6), 50.0, 1000, 700),
        ((10, 10, 10), (10.1, 12, 10.1), 35.0, 400, 900),
    ):
        location, distance = blender.run("scene_objects.frame", low, high, lens, width, height)
        assert np.allclose(location, (np.array(low) + high) / 2)
        corners = np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)]) * (np.array(high) - low) + low
        fills = []
        for _ in range(50):
            rotation = turned(random.normal(size=3), random.uniform(0, np.pi))
            seen = (corners - location) @ rotation.T + (0, 0, distance)
            # Blender's viewport: 72 mm wide where it is longest.
            across = np.abs(seen[:, :2] / seen[:, 2:]).max(0) * lens / 36 * max(width, height) / (width, height)
            fills.append(across.max())
        assert 0.5 < max(fills) <= 1.0, fills


@pytest.mark.main_version
def test_a_framed_viewport_looks_as_the_cameras_do(blender):
    assert blender.run("scene_objects.direction", []) is None
    along = np.array([[0.6, 0.8, 0], [0.8, 0.6, 0]])
    assert np.allclose(blender.run("scene_objects.direction", along.tolist()), np.sqrt([0.5, 0.5, 0]))
    inwards = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]
    assert blender.run("scene_objects.direction", inwards) == [1, 0, 0]


def test_points_far_away_do_not_count_for_the_frame(blender):
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    points[::100] *= 1e4
    low, high = np.array(blender.run("scene_objects.box", points.tolist(), [[0, 0, 5]]))
    assert np.allclose(low, -0.9, atol=0.1) and np.allclose(high, (0.9, 0.9, 5), atol=0.1)
    assert blender.run("scene_objects.box", [], []) == [[-1] * 3, [1] * 3]


def test_a_scene_without_points_keeps_its_up_direction(blender, tmp_path):
    up = (0.6, 0.0, -0.8)
    found = blender.run("scene_objects.up_direction", write_result(tmp_path, CAMERAS, np.zeros((0, 3)), up))
    assert np.allclose(found, up, atol=1e-6)


def test_an_import_decodes_no_image(blender, tmp_path):
    cameras = []
    for i in range(20):
        image = tmp_path / f"{i:03}.jpg"
        image.write_bytes(cv2.imencode(".jpg", np.full((1080, 1920, 3), i, np.uint8))[1].tobytes())
        cameras.append(camera(image.name, 1920, 1080, 1500.0, 1500.0, 960.0, 540.0, str(image)))
    found = blender.run("scene_objects.decoded_images", write_result(tmp_path, cameras, np.zeros((10, 3))))
    assert found == {"images": 20, "decoded": 0}


def test_the_default_cube_in_a_scene_is_pointed_out_and_left_alone(blender, tmp_path):
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    found = blender.run("scene_objects.beside_the_default_cube", write_result(tmp_path, CAMERAS, points))
    assert "The default cube hides part of the scene" in found["inside"]
    assert found["kept"] == [0, 0, 0, 1, 1, 1, False, False]
    assert found["hidden"] == found["apart"] == ""
