"""A reconstructed scene as Blender objects: cameras with their photographs, the sparse cloud, one root that places all.

The root is an empty whose local frame is the COLMAP world: its matrix is the one place that says how COLMAP coordinates
become Blender coordinates (up is +Z, the scene stands near the origin, one unit stays one unit). Cameras, sparse cloud
and splats are its children with COLMAP coordinates, so moving, turning or scaling the root moves everything together.
"""

import math
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

from .nodes import point_material
from .splats import new_pointcloud

ROOT_KEY = "swag_scene"  # on the root: the scene's folder
SIZE_KEY = "swag_size"  # on a camera: image width, height, pixel width / pixel height
SENSOR_WIDTH = 36.0  # mm; any value does, the focal length follows it
# OpenCV camera axes (x right, y down, z forward) to Blender's (x right, y up, z backward).
OPENCV_TO_BLENDER = Matrix.Diagonal((1.0, -1.0, -1.0, 1.0))


def import_scene(result: dict, scene: bpy.types.Scene) -> bpy.types.Object:
    """Build the objects of a worker's `inspect` result in a new collection of the Blender scene; returns the root.

    The first camera becomes the active one and gives the render its resolution. The view transform becomes Standard,
    under which photographs and splats show their own colours.
    Raises OSError or ValueError when the arrays that the result names cannot be read.
    """
    positions = np.load(result["points"]["positions"]).astype(np.float32)
    colors = np.load(result["points"]["colors"])
    name = Path(result["scene"]).name or "Scene"
    collection = bpy.data.collections.new(name)
    scene.collection.children.link(collection)

    root = bpy.data.objects.new(name, None)
    root.empty_display_type = "PLAIN_AXES"
    root[ROOT_KEY] = result["scene"]
    root.matrix_world = colmap_to_blender(np.asarray(result["up"], float), positions)
    collection.objects.link(root)

    if len(positions):
        cloud = bpy.data.objects.new(f"{name} Points", _sparse_cloud(f"{name} Points", positions, colors))
        cloud.parent = root
        cloud.hide_render = True  # a guide for the eye: renders show the splats
        collection.objects.link(cloud)

    cameras = bpy.data.collections.new(f"{name} Cameras")
    collection.children.link(cameras)
    made = [camera_object(camera, root, cameras) for camera in result["cameras"]]
    size = _camera_display_size(result["cameras"])
    for obj in made:
        obj.data.display_size = size
        obj.data.clip_start, obj.data.clip_end = size * 0.05, size * 5000.0
    scene.view_settings.view_transform = "Standard"
    if made:
        look_through(scene, made[0])
    return root


def look_through(scene: bpy.types.Scene, camera: bpy.types.Object) -> None:
    """Make `camera` the scene's active camera and give the render its image size and pixel shape.

    Blender keeps resolution and pixel aspect with the scene, not with the camera, so photographs of different sizes
    need this at every change of camera.
    """
    scene.camera = camera
    width, height, pixel_aspect = camera[SIZE_KEY]
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = int(width), int(height), 100
    # Blender takes no aspect below one.
    render.pixel_aspect_x, render.pixel_aspect_y = max(pixel_aspect, 1.0), max(1.0 / pixel_aspect, 1.0)


def show_colors(screen: bpy.types.Screen) -> None:
    """Turn solid 3D viewports to Material Preview, for solid shading draws point clouds grey, and there switch the
    outlines of what is selected off, which would be drawn round every single point."""
    for area in screen.areas:
        if area.type == "VIEW_3D" and area.spaces.active.shading.type == "SOLID":
            area.spaces.active.shading.type = "MATERIAL"
            area.spaces.active.overlay.show_outline_selected = False


def find_root(obj: bpy.types.Object | None) -> bpy.types.Object | None:
    """The scene root that `obj` is or hangs from, or None."""
    while obj is not None and ROOT_KEY not in obj:
        obj = obj.parent
    return obj


def roots(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The roots of all scenes imported into the Blender scene."""
    return [obj for obj in scene.objects if ROOT_KEY in obj]


def active_root(context: bpy.types.Context) -> bpy.types.Object | None:
    """The root that the active object hangs from, else the Blender scene's only root, else None."""
    if root := find_root(context.active_object):
        return root
    found = roots(context.scene)
    return found[0] if len(found) == 1 else None


def up_of(root: bpy.types.Object) -> np.ndarray:
    """Blender's up (+Z) as a direction (3,) of the COLMAP world, unit length."""
    return np.array((root.matrix_world.to_3x3().inverted() @ Vector((0.0, 0.0, 1.0))).normalized(), dtype=np.float64)


def pixel_size(root: bpy.types.Object, width: int) -> float:
    """1 / focal length in pixels of the scene's images when they are trained `width` pixels wide (their median).

    For the preview's input of that name; 0 when the scene has no cameras.
    """
    cameras = [obj for obj in root.children_recursive if SIZE_KEY in obj]
    sizes = [SENSOR_WIDTH / (obj.data.lens * min(width, obj[SIZE_KEY][0])) for obj in cameras]
    return float(np.median(sizes)) if sizes else 0.0


def colmap_to_blender(up: np.ndarray, positions: np.ndarray) -> Matrix:
    """Rigid COLMAP-world-to-Blender matrix: `up` (3,) unit becomes +Z by the smallest turn; the middle of the
    `positions` (P, 3) comes over the origin and their lower end (the 2nd percentile of height) onto z = 0.
    """
    x, y, z = up
    if z > -1.0 + 1e-9:
        # Rotation that takes `up` to +Z about their common normal (Rodrigues, with cos = z).
        normal = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
        rotation = np.eye(3) + normal + normal @ normal / (1.0 + z)
    else:
        rotation = np.diag([1.0, -1.0, -1.0])
    shift = np.zeros(3)
    if len(positions):
        turned = positions @ rotation.T
        shift = -np.append(np.median(turned[:, :2], axis=0), np.percentile(turned[:, 2], 2))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    return Matrix(matrix.tolist())


def set_intrinsics(data: bpy.types.Camera, width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> None:
    """Give a Blender camera the pinhole of an image (all in pixels; the top-left corner of the image is (0, 0)).

    fx != fy is carried by the render's pixel aspect (`look_through`); the shifts are in units of the sensor width.
    """
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH
    data.lens = fx * SENSOR_WIDTH / width
    data.shift_x = (width / 2 - cx) / width
    data.shift_y = (cy - height / 2) / width * (fx / fy)


def camera_object(camera: dict, root: bpy.types.Object, collection: bpy.types.Collection) -> bpy.types.Object:
    """One camera of an `inspect` result, with its photograph as background if it names one, under `root`."""
    data = bpy.data.cameras.new(camera["name"])
    set_intrinsics(data, *(camera[key] for key in ("width", "height", "fx", "fy", "cx", "cy")))
    if camera.get("image"):
        background = data.background_images.new()
        # Only the path is taken now; Blender reads the pixels when the image is first drawn.
        background.image = bpy.data.images.load(camera["image"], check_existing=True)
        background.alpha = 0.5
        background.frame_method = "STRETCH"
        data.show_background_images = True
    obj = bpy.data.objects.new(camera["name"], data)
    obj[SIZE_KEY] = (float(camera["width"]), float(camera["height"]), camera["fy"] / camera["fx"])
    obj.parent = root
    obj.matrix_basis = Matrix(np.linalg.inv(camera["world_to_camera"]).tolist()) @ OPENCV_TO_BLENDER
    collection.objects.link(obj)
    return obj


def _camera_display_size(cameras: list[dict]) -> float:
    centres = np.array([np.linalg.inv(camera["world_to_camera"])[:3, 3] for camera in cameras])
    if len(centres) < 2:
        return 0.1
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    # A third of the usual distance between neighbours if the cameras were spread evenly along the extent.
    return extent / len(centres) / 3 if extent > 0 else 0.1


def _sparse_cloud(name: str, positions: np.ndarray, colors: np.ndarray) -> bpy.types.PointCloud:
    cloud = new_pointcloud(name, positions)
    cloud.attributes.new("radius", "FLOAT", "POINT")
    cloud.attributes.new(point_material.COLOR, "FLOAT_COLOR", "POINT")
    spread = float(np.linalg.norm(np.percentile(positions, 95, axis=0) - np.percentile(positions, 5, axis=0)))
    radius = 0.3 * spread / math.sqrt(len(positions))
    cloud.attributes["radius"].data.foreach_set("value", np.full(len(positions), radius, np.float32))
    rgba = np.ones((len(positions), 4), np.float32)
    rgba[:, :3] = colors / np.float32(255)
    # Through the sRGB property the values are stored as linear light.
    cloud.attributes[point_material.COLOR].data.foreach_set("color_srgb", rgba.ravel())
    cloud.materials.append(point_material.material())
    return cloud
