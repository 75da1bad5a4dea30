"""The two solutions of the motion of a camera that moves over a plane.

What a camera sees of a plane while it moves straight on has two solutions, in which the direction of motion and the
normal of the plane change places (Longuet-Higgins 1986, The reconstruction of a plane surface from two perspective
projections). Only what stands out of the plane tells them apart, and mapping can end in the wrong one, with a wrong
focal length that makes up for it.
"""

import copy
from typing import Any

import cv2
import numpy as np

from ..scene.colmap_library import pycolmap

_LARGEST_RELIEF = 0.15
"""Median distance of the points from the plane, over that of a camera, above which mapping finds the right solution."""
_LARGEST_ANGLE = 35.0
"""Mean angle in degrees between the normals of the other solution, one for each image, above which there is none: the
camera does not move in one direction."""
_FITTING_ROUNDS = 20
"""Rounds of the robust fit of a plane."""


def other_plane_solution(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction | None:
    """Return a copy of a model with the poses of the other solution, None where there is none.

    Its points lie on the plane of that solution, and the lenses have no distortion: they are to be adjusted.
    """
    normal, offset, relief = _fit_plane(np.array([point.xyz for point in model.points3D.values()]))
    images = sorted((model.image(key) for key in model.reg_image_ids()), key=lambda image: image.name)
    reference = images[len(images) // 2]
    to_reference = _matrix(reference)
    normal = to_reference[:3, :3] @ normal
    distance = offset + normal @ to_reference[:3, 3]
    if relief > _LARGEST_RELIEF * abs(distance):
        return None
    normal /= distance  # normal @ point = 1 on the plane
    rays = _rays(model, reference)
    rotations, translations, normals = [], [], []
    for image in images:
        motion: Any = _matrix(image) @ np.linalg.inv(to_reference)
        homography: Any = motion[:3, :3] + np.outer(motion[:3, 3], normal)
        solutions: list[Any] = [
            (rotation, translation.ravel(), other.ravel())
            for rotation, translation, other in zip(*cv2.decomposeHomographyMat(homography, np.eye(3))[1:], strict=True)
            if np.mean(rays @ other.ravel() > 0) > 0.5
        ]
        if image is reference or not solutions:
            chosen: Any = motion[:3, :3], motion[:3, 3] / distance, np.zeros(3)
        else:
            chosen = min(solutions, key=lambda solution: float(solution[2] @ normal))
        rotations.append(chosen[0])
        translations.append(chosen[1])
        normals.append(chosen[2])
    lengths = np.linalg.norm(translations, axis=1)
    mean = lengths @ np.array(normals)
    if not np.linalg.norm(mean) > 0:
        return None
    mean /= np.linalg.norm(mean)
    angles = np.degrees(np.arccos(np.clip(np.array(normals) @ mean, -1, 1)))
    if lengths @ angles > _LARGEST_ANGLE * lengths.sum():
        return None
    other_model = copy.deepcopy(model)
    for image, rotation, translation in zip(images, rotations, translations, strict=True):
        frame = other_model.image(image.image_id).frame
        assert frame is not None
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
    for camera in other_model.cameras.values():
        params = camera.params
        params[camera.extra_params_idxs()] = 0
        camera.params = params
    _move_points_to_plane(other_model, mean)
    return other_model


def _fit_plane(points: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return the normal (3,) and the offset of the plane that fits points (N, 3), and their median distance from it."""
    weights = np.ones(len(points))
    for _ in range(_FITTING_ROUNDS):
        centre = weights @ points / weights.sum()
        normal = np.linalg.svd((points - centre) * np.sqrt(weights)[:, None], full_matrices=False)[2][2]
        distances = np.abs((points - centre) @ normal)
        relief = float(np.median(distances))
        weights = 1 / (1 + (distances / max(3 * relief, 1e-300)) ** 2)
    return normal, float(normal @ centre), relief


def _move_points_to_plane(model: pycolmap.Reconstruction, normal: np.ndarray) -> None:
    """Move the points to where a ray meets the plane `normal @ point = 1`; delete those whose ray does not."""
    for key in list(model.point3D_ids()):
        element = model.point3D(key).track.elements[0]
        image = model.image(element.image_id)
        pose = _matrix(image)
        pixel = image.points2D[element.point2D_idx].xy
        seen = model.camera(image.camera_id).cam_from_img(pixel[None])[0]
        ray = pose[:3, :3].T @ np.append(seen, 1.0)
        centre = -pose[:3, :3].T @ pose[:3, 3]
        along = (1 - normal @ centre) / (normal @ ray)
        if along > 0:
            model.point3D(key).xyz = centre + along * ray
        else:
            model.delete_point3D(key)


def _rays(model: pycolmap.Reconstruction, image: pycolmap.Image) -> np.ndarray:
    """Return the rays (M, 3) of the observed points of an image."""
    pixels = np.array([feature.xy for feature in image.points2D if feature.has_point3D()]).reshape(-1, 2)
    rays = model.camera(image.camera_id).cam_from_img(pixels)
    return np.column_stack([rays, np.ones(len(rays))])


def _matrix(image: pycolmap.Image) -> np.ndarray:
    """Return the pose (4, 4) of an image, from world to camera."""
    return np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
