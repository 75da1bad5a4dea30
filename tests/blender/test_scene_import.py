"""A scene's cameras, photographs and points as Blender objects."""

import json

import numpy as np
import pytest

IMPORT = """
import json, sys, time
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import scene_import

bpy.ops.wm.read_factory_settings(use_empty=True)
result = json.load(open(sys.argv[1]))
start = time.perf_counter()
root = scene_import.import_scene(result, bpy.context.scene)
bpy.context.view_layer.update()
seconds = time.perf_counter() - start
"""


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
    printed = blender.run(
        IMPORT
        + """
from bpy_extras.object_utils import world_to_camera_view
worst = {}
for camera in result["cameras"]:
    obj = bpy.data.objects[camera["name"]]
    scene_import.look_through(bpy.context.scene, obj)
    bpy.context.view_layer.update()
    render = bpy.context.scene.render
    assert (render.resolution_x, render.resolution_y) == (camera["width"], camera["height"])
    assert bpy.context.scene.camera == obj
    pose = np.array(camera["world_to_camera"])
    for point in np.load(result["points"]["positions"]):
        x, y, z = pose[:3, :3] @ point + pose[:3, 3]
        wanted = np.array([camera["fx"] * x / z + camera["cx"], camera["fy"] * y / z + camera["cy"], z])
        from mathutils import Vector
        seen = world_to_camera_view(bpy.context.scene, obj, root.matrix_world @ Vector(point))
        got = np.array([seen.x * camera["width"], (1 - seen.y) * camera["height"], seen.z])
        worst[camera["name"]] = max(worst.get(camera["name"], 0), float(abs(got - wanted).max()))
print("WORST", json.dumps(worst))
        """,
        write_result(tmp_path, CAMERAS, points),
    )
    worst = blender.json_after("WORST", printed)
    assert len(worst) == 4 and max(worst.values()) < 0.01, worst


def test_root_turns_up_to_z_and_puts_the_scene_on_the_ground(blender):
    printed = blender.run(
        """
        import json
        import numpy as np
        from bl_ext.user_default.swag_splatting.swag_blender import scene_import
        points = np.random.default_rng(1).normal((5, 6, 7), (1, 2, 3), (1000, 3))
        ups = ((0.0, -1.0, 0.0), (0.6, 0.0, -0.8), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0))
        placed = [np.array(scene_import.colmap_to_blender(np.array(up), points)).tolist() for up in ups]
        print("PLACED", json.dumps(placed))
        """
    )
    points = np.random.default_rng(1).normal((5, 6, 7), (1, 2, 3), (1000, 3))
    ups = ((0.0, -1.0, 0.0), (0.6, 0.0, -0.8), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0))
    for up, matrix in zip(ups, np.array(blender.json_after("PLACED", printed)), strict=True):
        assert np.allclose(matrix[:3, :3] @ up, (0, 0, 1), atol=1e-6)
        assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1, abs=1e-6)
        placed = points @ matrix[:3, :3].T + matrix[:3, 3]
        assert np.allclose(np.median(placed[:, :2], axis=0), 0, atol=1e-5)
        assert np.percentile(placed[:, 2], 2) == pytest.approx(0, abs=1e-5)


def test_objects_hang_from_one_root_with_photograph_and_colours(blender, tmp_path):
    photograph = tmp_path / "Foto ä 1.png"
    import cv2

    cv2.imencode(".png", np.full((360, 640, 3), 90, np.uint8))[1].tofile(photograph)
    cameras = [camera("first.png", 640, 360, 500.0, 500.0, 320.0, 180.0, str(photograph))]
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    printed = blender.run(
        IMPORT
        + """
obj = bpy.data.objects["first.png"]
cloud = bpy.data.objects["reef Points"]
background = obj.data.background_images[0]
print("SCENE", json.dumps({
    "root": root.name, "folder": root[scene_import.ROOT_KEY], "found": scene_import.find_root(obj) == root,
    "parents": [obj.parent == root, cloud.parent == root],
    "collections": [c.name for c in bpy.data.collections],
    "photograph": background.image.filepath, "loaded": background.image.has_data, "alpha": background.alpha,
    "shown": obj.data.show_background_images, "size": list(background.image.size),
    "count": len(cloud.data.points), "color": list(cloud.data.attributes["swag:color"].data[7].color_srgb),
    "radius": cloud.data.attributes["radius"].data[0].value, "material": cloud.data.materials[0].name,
    "position": list(cloud.matrix_world @ cloud.data.points[3].co),
    "wanted": list(root.matrix_world @ cloud.data.points[3].co),
    "pixel_size": scene_import.pixel_size(root, 320), "scenes": len(bpy.data.scenes), "meshes": len(bpy.data.meshes),
    "up": list(scene_import.up_of(root)),
}))
        """,
        write_result(tmp_path, cameras, points),
    )
    scene = blender.json_after("SCENE", printed)
    assert scene["root"] == "reef" and scene["folder"] == "/data/reef" and scene["found"]
    assert scene["parents"] == [True, True] and scene["collections"] == ["reef", "reef Cameras"]
    assert scene["photograph"] == str(photograph) and scene["shown"] and 0 < scene["alpha"] < 1
    assert not scene["loaded"] or scene["size"] == [640, 360]
    assert scene["count"] == 50 and scene["material"] == "SWAG Points" and scene["radius"] > 0
    assert np.allclose(np.array(scene["color"]) * 255, (10, 128, 250, 255), atol=0.01)
    assert np.allclose(scene["position"], scene["wanted"])
    assert scene["pixel_size"] == pytest.approx(1 / 250)
    assert scene["scenes"] == 1 and scene["meshes"] == 0
    assert np.allclose(scene["up"], (0, -1, 0), atol=1e-6)


def test_scene_without_points_and_up_beside_the_axes(blender, tmp_path):
    up = (0.6, 0.0, -0.8)
    printed = blender.run(
        IMPORT + "print('UP', json.dumps(list(scene_import.up_of(root))), flush=True)",
        write_result(tmp_path, CAMERAS, np.zeros((0, 3)), up),
    )
    assert np.allclose(blender.json_after("UP", printed), up, atol=1e-6)


def test_a_hundred_images_and_a_hundred_thousand_points_in_three_seconds(blender, tmp_path):
    import cv2

    cameras = []
    for i in range(100):
        photograph = tmp_path / f"{i:03}.jpg"
        photograph.write_bytes(cv2.imencode(".jpg", np.full((1080, 1920, 3), i, np.uint8))[1].tobytes())
        cameras.append(camera(photograph.name, 1920, 1080, 1500.0, 1500.0, 960.0, 540.0, str(photograph)))
    points = np.random.default_rng(0).normal(size=(100_000, 3))
    printed = blender.run(IMPORT + "print('SECONDS', seconds)", write_result(tmp_path, cameras, points))
    print(blender.path, blender.json_after("SECONDS", printed))
    assert blender.json_after("SECONDS", printed) < 3
