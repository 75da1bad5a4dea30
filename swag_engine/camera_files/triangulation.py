"""Points triangulated from known poses, run as a child process: `python -m swag_engine.camera_files.triangulation JOB`.

The scratch folder has the known model in known/, whose images are named as in the scene.
"""

from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..scene.colmap_library import pycolmap
from ..sfm.child_process import do_job, run_child, say
from ..sfm.features import extraction_options, match_pairs
from ..sfm.mapping import FEATURES_STAGE
from ..sfm.photos import copy_name, reader_options
from ..sfm.progress import Progress
from .pairs import pairs_from_poses


def triangulate(
    model: pycolmap.Reconstruction, scene: Path, scratch: Path, names: list[str], report: Progress
) -> dict[str, Any]:
    """Triangulate points of the photos of a scene in a child process, which writes the model to sparse/0.

    Args:
        model: The known poses.
        scene: Folder with images/.
        scratch: Folder for temporary files, with pictures/ (grey copies, see `photos.equalise`).
        names: Names of the photos in images/, in the order of their pictures.
        report: Called with the stages.

    Returns:
        Number of `points`, `reprojection_error` and `epipolar_error` (pixels, see `_epipolar_error`).

    Raises:
        InputError: When no point could be triangulated, or the child failed.
    """
    (scratch / "known").mkdir()
    model.write_binary(str(scratch / "known"))
    task = {"scene": str(scene), "scratch": str(scratch), "names": names}
    return run_child("swag_engine.camera_files.triangulation", task, scratch, FEATURES_STAGE, report)


def _child(task: dict[str, Any]) -> dict[str, Any]:
    names: list[str] = task["names"]
    scene, scratch = Path(task["scene"]), Path(task["scratch"])
    database, pictures = scratch / "database.db", scratch / "pictures"
    copies = [copy_name(number) for number in range(len(names))]
    pycolmap.set_random_seed(0)
    model = pycolmap.Reconstruction(str(scratch / "known"))
    known = {image.name: image for image in model.images.values()}
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    poses[:, :3] = [known[name].cam_from_world().matrix() for name in names]
    groups: dict[int, list[str]] = {}
    for name, copy in zip(names, copies, strict=True):
        groups.setdefault(known[name].camera_id, []).append(copy)

    say(stage=FEATURES_STAGE, table="keypoints", total=len(names))
    for camera_id, group in sorted(groups.items()):
        camera = model.cameras[camera_id]
        pycolmap.extract_features(
            str(database),
            str(pictures),
            image_names=group,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader_options(pictures, camera.model.name, camera.params_to_string()),
            extraction_options=extraction_options(camera.width, camera.height),
        )
    pairs = pairs_from_poses(poses)
    say(stage="Matching photos", table="two_view_geometries", total=len(pairs))
    match_pairs(database, pairs)

    say(stage="Triangulating points")
    with pycolmap.Database.open(str(database)) as opened:
        model = _with_ids_of(opened, dict(zip(copies, poses, strict=True)))
        misfit = _epipolar_error(model, opened)
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False  # they come from the images, not from the grey copies
    options.random_seed = 0
    triangulated = scratch / "triangulated"
    triangulated.mkdir()
    model = pycolmap.triangulate_points(model, str(database), str(pictures), str(triangulated), options=options)
    if not model.num_points3D():
        fit = "" if misfit is None else f" Matched features miss their epipolar lines by {misfit:.1f} px (median)."
        raise InputError(
            f"No point could be triangulated from the {len(names)} photos and their poses.{fit} Choose the photos that "
            "the cameras were made from, or a PLY file of points."
        )
    for image in model.images.values():
        image.name = names[copies.index(image.name)]
    model.extract_colors_for_all_images(str(scene / "images"))
    sparse = scene / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    return {
        "points": model.num_points3D(),
        "reprojection_error": model.compute_mean_reprojection_error(),
        "epipolar_error": misfit,
    }


def _with_ids_of(database: pycolmap.Database, poses: dict[str, np.ndarray]) -> pycolmap.Reconstruction:
    """Return the model of the known poses (4, 4) by name, with the cameras and the ids of the database."""
    model = pycolmap.Reconstruction()
    for camera in database.read_all_cameras():
        model.add_camera_with_trivial_rig(camera)
    for image in database.read_all_images():
        pose = poses[image.name]
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(np.ascontiguousarray(pose[:3, :3])), pose[:3, 3].copy())
        entry = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(entry, rigid)
    return model


def _epipolar_error(model: pycolmap.Reconstruction, database: pycolmap.Database) -> float | None:
    """Return the median distance in pixels of matched features from the epipolar lines of the known poses.

    It is large where poses and photos do not belong together: triangulation would only drop most of the matches.
    """
    errors = []
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        first, second = (model.images[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair))
        matches = geometry.inlier_matches
        if not len(matches):
            continue
        rays = []
        for image, indices in zip((first, second), np.asarray(matches).T, strict=True):
            camera = model.cameras[image.camera_id]
            keypoints = database.read_keypoints(image.image_id)[indices, :2].astype(np.float64)
            rays.append(np.asarray(camera.cam_ray_from_img(np.ascontiguousarray(keypoints))))
        relative = np.asarray((second.cam_from_world() * first.cam_from_world().inverse()).matrix())
        baseline = float(np.linalg.norm(relative[:, 3]))
        if not baseline:  # no epipolar lines
            continue
        normals = np.cross(relative[:, 3] / baseline, rays[0] @ relative[:, :3].T)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        sine = np.abs((normals / np.maximum(lengths, 1e-12) * rays[1]).sum(1))
        errors.append(np.arcsin(np.minimum(1.0, sine)) * model.cameras[second.camera_id].mean_focal_length())
    return float(np.median(np.concatenate(errors))) if errors else None


if __name__ == "__main__":
    do_job(_child)
