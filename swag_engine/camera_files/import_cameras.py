"""A COLMAP scene from the cameras of another program and its photos."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..base.errors import InputError
from ..scene.camera_page import write_camera_page
from ..scene.cameras import CAMERA_PAGE
from ..scene.colmap import load_scene
from ..scene.colmap_library import pycolmap
from ..scene.georeference import write_georeference
from ..scene.images import read_image
from ..scene.new_scene import new_scene
from ..scene.ply_points import FEWEST_VISIBLE, read_points, visible_fraction
from ..sfm.photos import copy_name, equalise, write_feature_masks, write_jpeg
from ..sfm.progress import Progress
from .camera_file import CameraFile, FilePoints
from .find_photos import find_photos
from .model import add_cloud, add_observed_points, build_model
from .place_photos import PlacedPhoto, place_photos
from .registry import read_camera_file
from .triangulation import triangulate

_LARGE_ERROR = 2.0
"""Median distance in pixels from epipolar lines above which poses and photos hardly fit: correct ones have below 1."""
_FAR = 100.0
"""Distance of the cameras from the origin, over their extent, above which they are moved there: Gaussians and Blender
count in 32 bits."""


def import_cameras(
    file: Path, out: Path, photos: Path | None = None, points: Path | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Make a COLMAP scene of the cameras of another program.

    The scene gets images/ (copies of the photos that have a pose), their masks/ and depths/, sparse/0, the page about
    its cameras and, where the file has metres, scale.json; it appears when all is done. Sparse points are those
    of `points`, else those of the file, else they are triangulated from the known poses.

    Args:
        file: File of the cameras, or a folder with one.
        out: Folder of the scene; it must not exist or be empty.
        photos: Folder of the photos, None for that of the file.
        points: PLY file of sparse points in the coordinates of the file.
        progress: Called with a stage (words for the user) and its fraction; what it raises ends the work.

    Returns:
        `program`, numbers of `images` (poses in the file), `registered` images and `points`, `points_from` (a file, or
        "photos" where they were triangulated), `reprojection_error` (pixels, None where it is not known), where they
        were triangulated `epipolar_error` (pixels, see `triangulation`), `scale` (that of scale.json, None where the
        file has no metres), seconds, and warnings.

    Raises:
        InputError: When the cameras or the photos cannot be used.
    """
    started = time.monotonic()
    report = progress or (lambda stage, fraction: None)
    file, out = (path.expanduser().absolute() for path in (file, out))
    folder = (photos or (file if file.is_dir() else file.parent)).expanduser().absolute()
    if not file.exists():
        raise InputError(f"There is no file {file}.")
    if not folder.is_dir():
        raise InputError(f"There is no folder of photos {folder}.")
    report("Reading cameras", 0.0)
    cameras = read_camera_file(file)
    warnings = list(cameras.warnings)
    ply = points or (cameras.points_file if cameras.points is None else None)
    if ply is not None:
        cameras = _with_cloud(cameras, ply)
    cameras = _near_origin(cameras, warnings)
    found = find_photos(folder, [camera.name for camera in cameras.cameras])
    named = {index: camera.mask for index, camera in enumerate(cameras.cameras) if camera.mask}
    masks = {index: found.masks.of[path] for index, path in found.paths.items() if path in found.masks.of} | named
    unused = tuple(mask for mask in found.masks.unused if mask not in named.values())
    warnings += [*found.warnings, *replace(found.masks, unused=unused).warnings()]
    with new_scene(out) as (scene, scratch):
        placed = place_photos(cameras.cameras, found.paths, masks, folder, scene / "images", warnings, report)
        model = build_model(cameras, placed)
        if cameras.points is None:
            names = [photo.name for photo in placed]
            _write_pictures(scene / "images", names, scratch / "pictures", report)
            result = triangulate(model, scene, scratch, names, report)
        else:
            report("Writing the scene", 0.0)
            result = _write_with_points(model, cameras.points, placed, scene)
        if cameras.georeference is not None:
            write_georeference(scene, cameras.georeference)
    write_camera_page(load_scene(out), out / CAMERA_PAGE)
    misfit = result.get("epipolar_error")
    if misfit is not None and misfit > _LARGE_ERROR:
        warnings.append(
            f"Matched features miss their epipolar lines by {misfit:.1f} px (threshold {_LARGE_ERROR:g} px): the poses "
            f"or lenses of {file.name} do not fit these photos."
        )
    return {
        "program": cameras.program,
        "images": len(cameras.cameras),
        "registered": len(placed),
        "points_from": "photos" if cameras.points is None else str(ply or file),
        "scale": cameras.georeference.to_json() if cameras.georeference else None,
        **result,
        "seconds": time.monotonic() - started,
        "warnings": warnings,
    }


def _write_pictures(images: Path, names: list[str], folder: Path, report: Progress) -> None:
    """Write the grey copies in which features are detected."""
    folder.mkdir()
    for number, name in enumerate(names):
        report("Preparing photos", number / len(names))
        grey = cv2.cvtColor(read_image(images / name)[0], cv2.COLOR_RGB2GRAY)
        write_jpeg(folder / copy_name(number), equalise(grey))
    write_feature_masks(images, names, folder)


def _with_cloud(cameras: CameraFile, ply: Path) -> CameraFile:
    """Add the points of a PLY file, which may be in the coordinates of the poses or in those of the georeference.

    Raises:
        InputError: When few of them are in front of the cameras in either.
    """
    positions, colors = read_points(ply)
    placements = [positions]
    if (reference := cameras.georeference) is not None:
        for offset in (np.zeros(3), *([reference.placement.offset] if reference.placement else [])):
            local = positions - offset - reference.translation
            placements.append(local @ reference.rotation / reference.metres_per_unit)
    lenses = [
        (camera.world_to_camera, camera.calibration.lens(*(camera.calibration.size or (4000, 3000))))
        for camera in cameras.cameras
    ]
    shares = [visible_fraction(placement, lenses) for placement in placements]
    best = int(np.argmax(shares))
    if shares[best] < FEWEST_VISIBLE:
        raise InputError(
            f"Only {shares[best]:.0%} of the points of {ply} are in front of the cameras: export them in the "
            "coordinates of the cameras, or leave the file out, so that points are found in the photos."
        )
    return replace(cameras, points=FilePoints(placements[best], colors))


def _near_origin(cameras: CameraFile, warnings: list[str]) -> CameraFile:
    """Move cameras and points to the origin where they are far away from it; the georeference keeps their place."""
    centres = np.stack([camera.centre for camera in cameras.cameras])
    middle = np.median(centres, axis=0)
    extent = float(np.quantile(np.linalg.norm(centres - middle, axis=1), 0.9))
    if np.linalg.norm(middle) <= _FAR * extent:
        return cameras
    origin = np.round(middle)
    moved = []
    for camera in cameras.cameras:
        pose = camera.world_to_camera.copy()
        pose[:3, 3] += pose[:3, :3] @ origin
        moved.append(replace(camera, world_to_camera=pose))
    points, reference = cameras.points, cameras.georeference
    if points is not None:
        points = replace(points, positions=points.positions - origin)
    if reference is not None:
        shifted = reference.translation + reference.metres_per_unit * reference.rotation @ origin
        reference = replace(reference, translation=shifted)
    else:
        warnings.append(
            f"The origin of the scene is ({', '.join(f'{value:.0f}' for value in origin)}) of the file, whose "
            "coordinates are too large to be drawn exactly."
        )
    if reference is not None and (place := reference.placement) is not None:
        x, y, z = (float(value) for value in reference.translation + place.offset)
        reference = replace(reference, translation=np.zeros(3), placement=replace(place, offset=(x, y, z)))
    return replace(cameras, cameras=tuple(moved), points=points, georeference=reference)


def _write_with_points(
    model: pycolmap.Reconstruction, points: FilePoints, placed: list[PlacedPhoto], scene: Path
) -> dict[str, Any]:
    """Add the points to the model and write it; return number of points and reprojection error."""
    observed = len(points.observations) > 0 and all(photo.scale for photo in placed)
    (add_observed_points if observed else add_cloud)(model, points, placed)
    if not model.num_points3D():
        raise InputError("No point of the file is seen by two of the photos: choose the photos of the cameras.")
    if not len(points.colors):
        model.extract_colors_for_all_images(str(scene / "images"))
    sparse = scene / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    error = model.compute_mean_reprojection_error() if observed else None
    return {"points": model.num_points3D(), "reprojection_error": error}
