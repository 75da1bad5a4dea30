"""A reconstructed scene as Blender objects: cameras with their images, the sparse cloud, one root for all.

The root is an empty whose local frame is the COLMAP world: its matrix is the only place that converts COLMAP
coordinates to Blender coordinates (up is +Z, the scene is near the origin, its size is the measured one or at least
`LEAST_SIZE`). Sparse cloud and splats are its children, the cameras those of a hidden child of it, all with COLMAP
coordinates, so that moving the root moves all of them.
"""

import math
from pathlib import Path
from typing import Any, cast

import bpy
import numpy as np
from mathutils import Matrix, Vector
from mathutils.kdtree import KDTree

from ..swag_engine.base.errors import InputError
from . import framing
from .blender_types import present
from .georeference import apply_georeference, scale_about_origin
from .nodes import point_material
from .properties import swag_of
from .splats import is_splats, new_pointcloud

ROOT_KEY = "swag_scene"
"""Property of the root: the scene's folder."""
SIZE_KEY = "swag_size"
"""Property of a camera: image width, image height, pixel width / pixel height."""
PHOTO_KEY = "swag_photo"
"""Property of a camera: name of the photo, which Blender's name of the object may shorten or number."""
SENSOR_WIDTH = 36.0
"""Sensor width of the cameras in mm; any value works, because the focal length is computed from it."""
LEAST_SIZE = 10.0
"""Blender units that the longest side of a scene without a known scale takes at least.

COLMAP's unit is arbitrary and often makes a reef as small as Blender's default cube, which then hides it.
"""
DEFAULT_CUBE = "Cube"
"""Name of the cube in Blender's startup file."""
OPENCV_TO_BLENDER = Matrix.Diagonal((1.0, -1.0, -1.0, 1.0))
"""OpenCV camera axes (x right, y down, z forward) to Blender's (x right, y up, z backward)."""


def describe(result: dict[str, Any]) -> str:
    """The result of an `inspect` or `sfm` request in lines: what was found in the first, then doubts, one a line."""
    translate = bpy.app.translations.pgettext_iface
    taken = "".join(f"{note} " for note in result.get("notes", ()))
    text = translate("{registered} of {images} photos have a camera, {points} points")
    counts = {"registered": result["registered"], "images": result["images"], "points": result["points"]["count"]}
    found = taken + text.format(**counts)
    if lenses := result["summary"]["cameras"]:
        most, error = lenses[0], result["summary"]["focal_error"]
        sure = f" ± {error:.1%}" if error is not None and len(lenses) == 1 else ""
        text = translate("field of view {angle}° (focal length {length})")
        angle, length = f"{most['field_of_view']:.0f}", f"{most['focal_length']:.0f} px{sure}"
        found += ", " + text.format(angle=angle, length=length)
        if len(lenses) > 1:
            found += ", " + translate("the most frequent of {count} lenses").format(count=len(lenses))
    if masks := result["summary"].get("masks"):
        found += ", " + translate("masks for {count} photos").format(count=masks)
    if drift := result["summary"]["drift"]:
        found += ", " + translate("drift {fraction} of the path").format(fraction=f"{drift['fraction']:.1%}")
    return "\n".join((found, *result["warnings"]))


def choose(scene: bpy.types.Scene, result: dict[str, Any], settings: dict[str, Any]) -> str:
    """Make the folder of an `inspect` result for these settings the scene's chosen images; returns its description."""
    swag = swag_of(scene)
    swag.scene_folder, swag.found = result["scene"], describe(result)
    swag.keep_sizes(swag.sized_by(settings), result["sizes"])
    return swag.found


def add_to_scene(scene_name: str, result: dict[str, Any], settings: dict[str, Any]) -> tuple[bpy.types.Object, str]:
    """Import an `inspect` or `sfm` result to a Blender scene, choose its folder, and show all of it in the viewports.

    Args:
        scene_name: name of the Blender scene that was open when the result was asked for.
        result: the event.
        settings: those of the next run that the result was asked for with.

    Returns:
        The root, and what to tell the user.

    Raises:
        InputError: the scene was removed.
    """
    scene = bpy.data.scenes.get(scene_name)
    if not scene:
        raise InputError(f"The scene {scene_name} was removed; import {result['scene']} again.")
    root = import_scene(result, scene)
    if not bpy.app.background:
        for window in present(bpy.context.window_manager).windows:
            if window.scene == scene:
                framing.frame_viewports(window, root.children_recursive)
    found, *doubts = choose(scene, result, settings).splitlines()
    present(scene.view_layers[0]).update()  # world matrices of new objects
    return root, " ".join(filter(None, (f"{found}.", cube_note(scene, root), *doubts)))


def import_scene(result: dict[str, Any], scene: bpy.types.Scene) -> bpy.types.Object:
    """Build the objects of a worker's `inspect` result in a new collection of the Blender scene; returns the root.

    The first camera becomes the active one and gives the render its resolution. The view transform becomes Standard,
    which leaves the colors of images and splats as they are. A measured scale is applied; without one, a scene smaller
    than `LEAST_SIZE` is shown in that size. Raises OSError or ValueError when the arrays that the result names cannot
    be read.
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
        cloud.hide_render = True  # only for orientation: renders show the splats
        collection.objects.link(cloud)

    cameras = bpy.data.collections.new(f"{name} Cameras")
    collection.children.link(cameras)
    # Viewports draw a line from an object to its parent, unless that is hidden.
    parent = bpy.data.objects.new(f"{name} Cameras", None)
    parent.parent, parent.hide_viewport = root, True
    cameras.objects.link(parent)
    made = [camera_object(camera, parent, cameras) for camera in result["cameras"]]
    centres = np.array([np.linalg.inv(camera["world_to_camera"])[:3, 3] for camera in result["cameras"]]).reshape(-1, 3)
    low, high = framing.robust_box(positions, centres)
    extent = float(np.linalg.norm(high - low)) or 1.0
    for obj in made:
        data = cast(bpy.types.Camera, obj.data)
        data.display_size = _camera_display_size(centres, extent)
        data.clip_start, data.clip_end = extent * 0.001, extent * 100.0
    if measured := result.get("scale"):
        apply_georeference(root, scene, measured)
    else:
        scale_about_origin(root, enlargement(low, high))
    cast(Any, scene.view_settings).view_transform = "Standard"
    if made:
        look_through(scene, made[0])
    return root


def enlargement(low: np.ndarray, high: np.ndarray) -> float:
    """The factor by which a scene without a known scale is shown, from its lowest and highest corner (3,)."""
    side = float((high - low).max())
    return max(LEAST_SIZE / side, 1.0) if side > 0 else 1.0


def look_through(scene: bpy.types.Scene, camera: bpy.types.Object) -> None:
    """Make `camera` the scene's active camera and give the render its image size and pixel shape.

    Blender stores resolution and pixel aspect with the scene, not with the camera: images of different sizes need this
    at every change of camera.
    """
    scene.camera = camera
    width, height, pixel_aspect = camera.get(SIZE_KEY)
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = int(width), int(height), 100
    # Blender takes no aspect below one.
    render.pixel_aspect_x, render.pixel_aspect_y = max(pixel_aspect, 1.0), max(1.0 / pixel_aspect, 1.0)


def cube_note(scene: bpy.types.Scene, root: bpy.types.Object) -> str:
    """A sentence where Blender's default cube stands inside an imported scene, else ""; the cube is not changed."""
    cube = scene.objects.get(DEFAULT_CUBE)
    if cube is None or not isinstance(cube.data, bpy.types.Mesh) or not cube.visible_get():
        return ""
    low, high = framing.world_box(root.children_recursive)
    corners = np.array([cube.matrix_world @ Vector(corner) for corner in cube.bound_box])
    apart = (corners.max(axis=0) < low).any() or (corners.min(axis=0) > high).any()
    return "" if apart else "The default cube hides part of the scene: select it and press X to delete or H to hide it."


def find_root(obj: bpy.types.Object | None) -> bpy.types.Object | None:
    """The scene root that `obj` is or is a descendant of; None where there is none."""
    while obj is not None and obj.get(ROOT_KEY) is None:
        obj = obj.parent
    return obj


def roots(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The roots of all scenes imported into the Blender scene."""
    return [obj for obj in scene.objects if obj.get(ROOT_KEY) is not None]


def active_root(context: bpy.types.Context) -> bpy.types.Object | None:
    """The root of the active object, else the Blender scene's only root, else None."""
    if root := find_root(context.active_object):
        return root
    found = roots(present(context.scene))
    return found[0] if len(found) == 1 else None


def sparse_points(root: bpy.types.Object) -> bpy.types.Object | None:
    """The sparse cloud of an imported scene; None where it has none or it was removed."""
    for obj in root.children:
        data = obj.data
        if isinstance(data, bpy.types.PointCloud) and point_material.COLOR in data.attributes and not is_splats(obj):
            return obj
    return None


def layer_of_cameras(root: bpy.types.Object, layer: bpy.types.ViewLayer) -> bpy.types.LayerCollection | None:
    """The cameras of an imported scene in a view layer, to hide them; None where there are none.

    What is hidden there keeps being evaluated, unlike a collection that is hidden in all viewports, whose cameras would
    lose their places.
    """
    camera = next((obj for obj in root.children_recursive if obj.get(SIZE_KEY) is not None), None)
    if camera is None:
        return None
    layers = [present(layer.layer_collection)]
    for candidate in layers:
        layers += candidate.children
    # The scene's own collection cannot be hidden.
    return next((one for one in layers[1:] if camera.name in one.collection.objects), None)


def hide_sparse_points(root: bpy.types.Object | None) -> None:
    """Hide the sparse cloud of an imported scene in viewports, for splats that are shown in its place."""
    if root and (cloud := sparse_points(root)):
        cloud.hide_viewport = True


def up_of(root: bpy.types.Object) -> np.ndarray:
    """Blender's up (+Z) as a direction (3,) of the COLMAP world, unit length."""
    return np.array((root.matrix_world.to_3x3().inverted() @ Vector((0.0, 0.0, 1.0))).normalized(), dtype=np.float64)


def pixel_size(root: bpy.types.Object, width: int) -> float:
    """Median of 1 / focal length in pixels over the scene's images at a training width of `width` pixels.

    For the input of that name of the preview; 0 when the scene has no cameras.
    """
    cameras = [(obj.data, obj.get(SIZE_KEY)) for obj in root.children_recursive if obj.get(SIZE_KEY) is not None]
    sizes = [
        SENSOR_WIDTH / (camera.lens * min(width, size[0]))
        for camera, size in cameras
        if isinstance(camera, bpy.types.Camera)
    ]
    return float(np.median(sizes)) if sizes else 0.0


def colmap_to_blender(up: np.ndarray, positions: np.ndarray) -> Matrix:
    """Rigid matrix from the COLMAP world to Blender's world.

    The smallest rotation turns `up` (3,), a unit vector, to +Z. The median of the `positions` (P, 3) is then above the
    origin, and their 2nd percentile of height at z = 0.
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

    The pixel aspect of the render carries fx != fy (`look_through`). Shifts are in units of the sensor width.
    """
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH
    data.lens = fx * SENSOR_WIDTH / width
    data.shift_x = (width / 2 - cx) / width
    data.shift_y = (cy - height / 2) / width * (fx / fy)


def camera_object(camera: dict[str, Any], root: bpy.types.Object, collection: bpy.types.Collection) -> bpy.types.Object:
    """Make a camera of an `inspect` result below `root`, with its image as background if it names one."""
    data = bpy.data.cameras.new(camera["name"])
    set_intrinsics(data, *(camera[key] for key in ("width", "height", "fx", "fy", "cx", "cy")))
    if camera.get("image"):
        background = data.background_images.new()
        # This stores only the path: Blender reads the pixels when it draws the image for the first time.
        background.image = bpy.data.images.load(camera["image"], check_existing=True)
        background.alpha = 0.5
        background.frame_method = "STRETCH"
        data.show_background_images = True
    obj = bpy.data.objects.new(camera["name"], data)
    obj[PHOTO_KEY] = camera["name"]
    obj[SIZE_KEY] = (float(camera["width"]), float(camera["height"]), camera["fy"] / camera["fx"])
    obj.parent = root
    obj.matrix_basis = Matrix(np.linalg.inv(camera["world_to_camera"]).tolist()) @ OPENCV_TO_BLENDER
    collection.objects.link(obj)
    return obj


def _camera_display_size(centres: np.ndarray, extent: float) -> float:
    """Width of a camera's frame in the viewport, for camera centres (C, 3) in a scene of the size `extent`.

    Half of the median distance from a camera to the next one, so that they do not hide each other, but large enough to
    see in a view of the whole scene, and not larger than what they show.
    """
    least, most = 0.01 * extent, 0.05 * extent
    if len(centres) < 2:
        return most
    tree = KDTree(len(centres))
    for index, centre in enumerate(centres):
        tree.insert(centre, index)
    tree.balance()
    distances = [tree.find_n(centre, 2)[1][2] for centre in centres]  # the nearest is the camera itself
    return float(np.clip(np.median(distances) / 2, least, most))


def _sparse_cloud(name: str, positions: np.ndarray, colors: np.ndarray) -> bpy.types.PointCloud:
    cloud = new_pointcloud(name, positions)
    attributes: Any = cloud.attributes
    attributes.new("radius", "FLOAT", "POINT")
    attributes.new(point_material.COLOR, "FLOAT_COLOR", "POINT")
    spread = float(np.linalg.norm(np.percentile(positions, 95, axis=0) - np.percentile(positions, 5, axis=0)))
    radius = 0.3 * spread / math.sqrt(len(positions))
    attributes["radius"].data.foreach_set("value", np.full(len(positions), radius, np.float32))
    rgba = np.ones((len(positions), 4), np.float32)
    rgba[:, :3] = colors / np.float32(255)
    # The sRGB property converts to linear light, which is what the attribute stores.
    attributes[point_material.COLOR].data.foreach_set("color_srgb", rgba.ravel())
    cloud.materials.append(point_material.material())
    return cloud
