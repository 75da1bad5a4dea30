"""A scene's cameras, images and points as Blender objects."""

import json
from pathlib import Path

import bpy
import numpy as np
from bl_ext.user_default.swag_splatting.swag_blender import framing, runs, scene_import, splat_import
from bl_ext.user_default.swag_splatting.swag_engine.formats.ply import write_ply
from bl_ext.user_default.swag_splatting.swag_engine.splats.splats import Splats
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

scene = bpy.context.scene


def import_result(path):
    """Root object of the `inspect` result in a file, and the result."""
    result = json.loads(Path(path).read_text())
    root = scene_import.import_scene(result, scene)
    bpy.context.view_layer.update()
    return root, result


def projection_errors(path):
    """Largest difference in pixels (and depth) of Blender's projection from the pinhole's, per camera."""
    root, result = import_result(path)
    worst = {}
    for camera in result["cameras"]:
        obj = bpy.data.objects[camera["name"]]
        scene_import.look_through(scene, obj)
        bpy.context.view_layer.update()
        assert (scene.render.resolution_x, scene.render.resolution_y) == (camera["width"], camera["height"])
        assert scene.camera == obj
        pose = np.array(camera["world_to_camera"])
        errors = []
        for point in np.load(result["points"]["positions"]):
            x, y, z = pose[:3, :3] @ point + pose[:3, 3]
            depth = z * root.matrix_world.median_scale
            expected = np.array([camera["fx"] * x / z + camera["cx"], camera["fy"] * y / z + camera["cy"], depth])
            seen = world_to_camera_view(scene, obj, root.matrix_world @ Vector(point))
            found = np.array([seen.x * camera["width"], (1 - seen.y) * camera["height"], seen.z])
            errors.append(float(abs(found - expected).max()))
        worst[camera["name"]] = max(errors)
    return worst


def shown_box(path):
    """Factor and size in Blender units by which an import is shown."""
    root, _ = import_result(path)
    low, high = framing.world_box(root.children_recursive)
    return {"factor": root.matrix_world.median_scale, "size": (high - low).tolist()}


def root_matrices(ups, points):
    """Root matrices for up directions and the points of a file."""
    points = np.load(points)
    return [np.array(scene_import.colmap_to_blender(np.array(up), points)).tolist() for up in ups]


def describe(path):
    """Everything that an import of one camera makes."""
    root, _ = import_result(path)
    camera, cloud = bpy.data.objects["first.png"], bpy.data.objects["reef Points"]
    background = camera.data.background_images[0]
    return {
        "root": root.name,
        "folder": root[scene_import.ROOT_KEY],
        "found": scene_import.find_root(camera) == root,
        "parents": [camera.parent.parent == root, cloud.parent == root],
        # Blender draws a line from each visible object to its parent elsewhere, where that is visible, too.
        "lines": [
            obj.name
            for obj in scene.objects
            if obj.visible_get()
            and obj.parent
            and obj.parent.visible_get()
            and obj.matrix_world.translation != obj.parent.matrix_world.translation
        ],
        "collections": [collection.name for collection in bpy.data.collections],
        "image": background.image.filepath,
        "alpha": background.alpha,
        "shown": camera.data.show_background_images,
        "size": list(background.image.size),
        "count": len(cloud.data.points),
        "color": list(cloud.data.attributes["swag:color"].data[7].color_srgb),
        "radius": cloud.data.attributes["radius"].data[0].value,
        "material": cloud.data.materials[0].name,
        "position": list(cloud.matrix_world @ cloud.data.points[3].co),
        "expected position": list(root.matrix_world @ cloud.data.points[3].co),
        "pixel size": scene_import.pixel_size(root, 320),
        "scenes": len(bpy.data.scenes),
        "meshes": len(bpy.data.meshes),
        "up": list(scene_import.up_of(root)),
    }


def camera_sizes(path):
    import_result(path)
    cameras = list(bpy.data.cameras)
    assert len({camera.display_size for camera in cameras}) == 1
    return {"size": cameras[0].display_size, "clip": [cameras[0].clip_start, cameras[0].clip_end]}


def move_root(path):
    """How far each camera and the sparse cloud move when the root moves by 7 along z."""
    root, _ = import_result(path)
    objects = [obj for obj in scene.objects if obj.type in {"CAMERA", "POINTCLOUD"}]
    before = {obj.name: obj.matrix_world.translation.copy() for obj in objects}
    root.location.z += 7
    bpy.context.view_layer.update()
    return {obj.name: list(obj.matrix_world.translation - before[obj.name]) for obj in objects}


def splats_arrive(path, folder):
    """Whether the sparse points are hidden after each step."""
    root, _ = import_result(path)
    points = scene_import.sparse_points(root)
    found = {"imported": points.hide_viewport}
    loaded = Splats(
        positions=np.zeros((3, 3), np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1)),
        scales=np.ones((3, 3), np.float32),
        opacities=np.ones(3, np.float32),
        sh=np.zeros((3, 1, 3), np.float32),
    )
    runs.show_splats(scene, loaded, "/run", root[scene_import.ROOT_KEY])
    assert scene_import.sparse_points(root) == points
    found["first preview"] = points.hide_viewport
    points.hide_viewport = False  # the switch in the sidebar
    runs.show_splats(scene, loaded, "/run", root[scene_import.ROOT_KEY])
    found["shown again"] = points.hide_viewport
    write_ply(Path(folder, "splats.ply"), loaded)
    opened, failed = splat_import.open_splats(bpy.context, [Path(folder, "splats.ply")], in_scene=True, sh_degree=0)
    assert len(opened) == 1 and not failed
    found["opened file"] = points.hide_viewport
    return found


def frame(low, high, lens, width, height):
    return framing.frame((np.array(low), np.array(high)), lens, width, height)


def box(points, cameras):
    low, high = framing.robust_box(np.array(points).reshape(-1, 3), np.array(cameras).reshape(-1, 3))
    return [low.tolist(), high.tolist()]


def direction(directions):
    found = framing.viewing_direction(np.array(directions, float).reshape(-1, 3))
    return None if found is None else found.tolist()


def up_direction(path):
    return list(scene_import.up_of(import_result(path)[0]))


def decoded_images(path):
    """How many images an import makes, and how many of them are in memory: decoding hundreds would take minutes."""
    import_result(path)
    images = [camera.background_images[0].image for camera in bpy.data.cameras]
    return {"images": len(images), "decoded": sum(image.has_data for image in images)}


def beside_the_default_cube(path):
    """What an import says about the default cube: inside the scene, hidden, and far away; and the cube afterwards."""
    cube = bpy.data.objects.get("Cube") or bpy.data.objects.new("Cube", bpy.data.meshes.new("Cube"))
    if not len(cube.data.vertices):
        cube.data.from_pydata([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], [], [])
        scene.collection.objects.link(cube)
    result = {"images": 1, "registered": 1, "summary": {"cameras": [], "drift": None}, "warnings": [], "sizes": {}}
    result |= json.loads(Path(path).read_text())
    root, inside = scene_import.add_to_scene(scene.name, result, scene.swag.train_settings())
    kept = [*cube.matrix_world.translation, *cube.scale, cube.hide_viewport, cube.hide_get()]
    cube.hide_viewport = True
    hidden = scene_import.cube_note(scene, root)
    cube.hide_viewport, cube.location.x = False, 1000
    bpy.context.view_layer.update()
    return {"inside": inside, "kept": kept, "hidden": hidden, "apart": scene_import.cube_note(scene, root)}
