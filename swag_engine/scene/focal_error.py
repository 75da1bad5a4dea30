"""Standard error of the focal lengths of a COLMAP model."""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from .colmap_library import pycolmap
from .model_observations import Observations


def focal_errors(model: pycolmap.Reconstruction, observations: Observations) -> dict[int, float | None]:
    """Return the relative standard error of the focal length of each camera, None where it cannot be computed.

    The covariance is that of a bundle adjustment of poses, points, focal lengths and distortion, from its Gauss-Newton
    matrix without the points (Schur complement; Triggs et al. 2000, Bundle Adjustment - A Modern Synthesis), times the
    variance of the residuals. The points are a sample, and information is proportional to their number.
    """
    cameras = list(dict.fromkeys(observations.camera_ids.tolist()))
    undetermined: dict[int, float | None] = dict.fromkeys(cameras)
    usable = np.isfinite(observations.residuals).all(1)
    usable &= (np.bincount(observations.point[usable], minlength=len(observations.positions)) >= 2)[observations.point]
    image, point = observations.image[usable], np.unique(observations.point[usable], return_inverse=True)[1]
    seen, residuals = observations.in_camera()[usable], observations.residuals[usable]
    views, count = len(observations.image_ids), len(image)
    parameters = {camera_id: _free_parameters(model.camera(camera_id)) for camera_id in cameras}
    first_column = dict(zip(cameras, 6 * views + np.cumsum([0, *map(len, parameters.values())])[:-1], strict=True))
    unknowns = 6 * views + sum(map(len, parameters.values()))
    if not count:
        return undetermined
    points = point.max() + 1
    freedom = 2 * count - unknowns - 3 * points + 7
    if freedom <= 0:
        return undetermined

    by_point = np.zeros((count, 2, 3))
    by_lens: list[tuple[np.ndarray, int, np.ndarray]] = []  # rows of observations, column, derivatives
    for camera_id, indices in parameters.items():
        camera = model.camera(camera_id)
        own = np.flatnonzero(observations.camera_ids[image] == camera_id)
        by_point[own] = _by_point(camera, seen[own])
        for column, index in enumerate(indices, first_column[camera_id]):
            by_lens.append((own, column, _by_parameter(camera, index, seen[own])))
    cross = np.zeros((count, 3, 3))  # derivative of the point in the camera by a rotation of the camera
    cross[:, 0, 1], cross[:, 0, 2] = seen[:, 2], -seen[:, 1]
    cross[:, 1, 0], cross[:, 1, 2] = -seen[:, 2], seen[:, 0]
    cross[:, 2, 0], cross[:, 2, 1] = seen[:, 1], -seen[:, 0]
    unit = np.median(np.linalg.norm(seen, axis=1))  # so that turns and moves have derivatives of one size
    by_pose = np.concatenate([by_point @ cross, by_point * unit], axis=2)
    by_position = by_point @ observations.world_to_camera[image, :, :3] * unit
    blocks = np.zeros((points, 3, 3))
    np.add.at(blocks, point, np.einsum("mki,mkj->mij", by_position, by_position))
    sizes = np.trace(blocks, axis1=1, axis2=2)
    lens_values = np.concatenate([values.ravel() for _, _, values in by_lens])
    if not (np.isfinite(blocks).all() and np.isfinite(by_pose).all() and np.isfinite(lens_values).all()):
        return undetermined
    if not sizes.min() > 0:
        return undetermined

    pose_columns = np.broadcast_to(6 * image[:, None, None] + np.arange(6), by_pose.shape)
    jacobian = sparse.csr_matrix(
        (
            np.concatenate([by_pose.ravel(), lens_values]),
            (
                np.concatenate(
                    [
                        np.repeat(np.arange(2 * count), 6),
                        *((2 * own[:, None] + [0, 1]).ravel() for own, _, _ in by_lens),
                    ]
                ),
                np.concatenate([pose_columns.ravel(), *(np.full(2 * len(own), column) for own, column, _ in by_lens)]),
            ),
        ),
        (2 * count, unknowns),
    )
    point_columns = np.broadcast_to(3 * point[:, None, None] + np.arange(3), by_position.shape)
    point_jacobian = sparse.csr_matrix(
        (by_position.ravel(), (np.repeat(np.arange(2 * count), 3), point_columns.ravel())), (2 * count, 3 * points)
    )
    blocks += 1e-9 * sizes[:, None, None] * np.eye(3)  # a point without parallax stays where it is
    inverse = sparse.block_diag(list(np.linalg.inv(blocks)), format="csr")
    coupling = (jacobian.T @ point_jacobian).tocsr()
    information = (jacobian.T @ jacobian - coupling @ inverse @ coupling.T).tocsc() * (1 / observations.fraction)

    # Place, orientation and scale of the world are free: the first camera stays, and one coordinate of the farthest.
    centres = observations.centres
    far = int(np.argmax(np.linalg.norm(centres - centres[0], axis=1)))
    along = observations.world_to_camera[far, :, :3] @ (centres[far] - centres[0])
    fixed = [*range(6), 6 * far + 3 + int(np.argmax(np.abs(along)))]
    observed = np.flatnonzero(information.diagonal() > 0)  # an image may have no observation in the sample
    kept = np.setdiff1d(observed, fixed)
    known = [camera_id for camera_id in cameras if first_column[camera_id] in kept]
    wanted = np.searchsorted(kept, [first_column[camera_id] for camera_id in known])
    selector = np.zeros((len(kept), len(known)))
    selector[wanted, np.arange(len(known))] = 1
    try:
        covariance = splu(information[kept][:, kept].tocsc()).solve(selector)[wanted]
    except (RuntimeError, ValueError):  # exactly singular: no parallax at all
        return undetermined
    variance = float((residuals**2).sum() / freedom)
    errors = np.sqrt(np.maximum(np.diag(covariance), 0) * variance)
    determined = {camera_id: float(error) for camera_id, error in zip(known, errors, strict=True) if error > 0}
    return undetermined | {camera_id: error for camera_id, error in determined.items() if np.isfinite(error)}


def _by_point(camera: pycolmap.Camera, seen: np.ndarray) -> np.ndarray:
    """Return the derivatives (M, 2, 3) of pixels by points (M, 3) in the coordinates of the camera."""
    derivatives = np.zeros((len(seen), 2, 3))
    length = 1e-5 * np.linalg.norm(seen, axis=1, keepdims=True)
    for axis, step in enumerate(np.eye(3)):
        change = camera.img_from_cam(seen + length * step) - camera.img_from_cam(seen - length * step)
        derivatives[:, :, axis] = change / (2 * length)
    return derivatives


def _by_parameter(camera: pycolmap.Camera, index: int, seen: np.ndarray) -> np.ndarray:
    """Return the derivatives (M, 2) of pixels by a parameter of the lens; by relative changes of focal lengths.

    Distortion is of the order of 1, but focal lengths are of that of a thousand.
    """
    step = 1e-5 * max(abs(camera.params[index]), 1.0)
    before, after = (_with_parameter(camera, index, change).img_from_cam(seen) for change in (-step, step))
    scale = camera.focal_length_x if index in camera.focal_length_idxs() else 1.0
    return np.asarray((after - before) / (2 * step) * scale)


def _free_parameters(camera: pycolmap.Camera) -> list[int]:
    """Return the parameters that COLMAP refines, the focal length first; a principal point stays where it is."""
    return [*camera.focal_length_idxs(), *camera.extra_params_idxs()]


def _with_parameter(camera: pycolmap.Camera, index: int, change: float) -> pycolmap.Camera:
    params = np.array(camera.params)
    params[index] += change
    return pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=list(params))
