"""COLMAP models of known cameras, made from observations without any image, and adjusted as COLMAP does."""

from collections.abc import Callable

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 960, 720


def look(forward: np.ndarray, down: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Pose (3, 4), world to camera, of a camera at a place."""
    z = forward / np.linalg.norm(forward)
    x = np.cross(down, z) / np.linalg.norm(np.cross(down, z))
    rotation = np.stack([x, np.cross(z, x), z])
    return np.column_stack([rotation, -rotation @ centre])


def lawn_mower(rows: int = 3, columns: int = 8) -> list[np.ndarray]:
    """Poses of a camera 4 above a floor (z = 0) that looks down and goes there and back."""
    poses: list[np.ndarray] = []
    for row in range(rows):
        for column in range(columns):
            x = column if row % 2 == 0 else columns - 1 - column
            tilt = 0.15 * np.array([np.sin(1.7 * len(poses)), np.cos(2.3 * len(poses)), 0])
            poses.append(look(np.array([0, 0, -1.0]) + tilt, np.array([0, -1.0, 0]), np.array([x, row * 1.5, 4])))
    return poses


def orbit(count: int = 30, turns: float = 1.0) -> list[np.ndarray]:
    """Poses on a circle of radius 6, at a height of 3, that look at the origin."""
    poses = []
    for share in np.arange(count) / count:
        angle = 2 * np.pi * turns * share
        centre = np.array([6 * np.cos(angle), 6 * np.sin(angle), 3.0])
        poses.append(look(-centre, np.array([0, 0, -1.0]), centre))
    return poses


def forward_dive(count: int) -> list[np.ndarray]:
    """Poses of a camera that looks where it goes."""
    return [look(np.array([0, 1.0, 0]), np.array([0, 0, -1.0]), np.array([0, 0.05 * k, 1.0])) for k in range(count)]


def floor(count: int = 2000) -> np.ndarray:
    """Points (count, 3) of an uneven floor around (3.5, 1.5, 0)."""
    random = np.random.default_rng(3)
    points = random.uniform(-9, 9, (count, 3)) + [3.5, 1.5, 0]
    points[:, 2] = 0.6 * np.sin(1.3 * points[:, 0]) * np.cos(1.1 * points[:, 1]) + random.normal(0, 0.1, count)
    return points


def block(count: int = 1500) -> np.ndarray:
    """Points (count, 3) around the origin."""
    return np.random.default_rng(3).normal(0, 1, (count, 3))


def make_model(
    poses: list[np.ndarray],
    positions: np.ndarray,
    *,
    focal: float = 800.0,
    first_focal: float = 0.0,
    model: str = "SIMPLE_RADIAL",
    noise: float = 0.4,
    readout: float = 0.0,
    velocity: np.ndarray | None = None,
    farthest: float = 12.0,
    seen: Callable[[int, np.ndarray], np.ndarray] | None = None,
    names: str = "frame_{:04d}.jpg",
    adjust: bool = True,
    seed: int = 11,
) -> pycolmap.Reconstruction:
    """Make a model of one camera.

    Args:
        poses: World to camera (3, 4), in the order of the images' names.
        positions: Points (P, 3).
        focal: True focal length, pixels.
        first_focal: Focal length that adjustment begins with; 0 for the true one.
        model: Camera model.
        noise: Standard deviation of observations, pixels.
        readout: Time between the first and the last row, over that between two images.
        velocity: Motion of each point from image to image, (P, 3).
        farthest: Range beyond which points are not seen.
        seen: Given an image and which points it could see (P,), those that it does.
        names: Names of the images.
        adjust: Whether to run bundle adjustment and drop observations as COLMAP does.
        seed: Seed of the noise.

    Returns:
        The model.
    """
    random = np.random.default_rng(seed)
    camera = pycolmap.Camera.create_from_model_name(1, model, focal, WIDTH, HEIGHT)
    rotations = Rotation.from_matrix([pose[:, :3] for pose in poses])
    centres = np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])
    reconstruction = pycolmap.Reconstruction()
    tracks: list[list[tuple[int, int]]] = [[] for _ in positions]
    reconstruction.add_camera_with_trivial_rig(camera)
    for index, pose in enumerate(poses):
        places = positions + (velocity * (index - len(poses) / 2) if velocity is not None else 0)
        local = places @ pose[:, :3].T + pose[:, 3]
        pixels = _project(camera, local)
        if readout:
            neighbour = index + 1 if index + 1 < len(poses) else index - 1
            turn = (rotations[neighbour] * rotations[index].inv()).as_rotvec() * (neighbour - index)
            move = (centres[neighbour] - centres[index]) * (neighbour - index)
            for _ in range(4):
                time = readout * (pixels[:, 1] / HEIGHT - 0.5)
                turned = Rotation.from_rotvec(time[:, None] * turn) * rotations[index]
                local = turned.apply(places - centres[index] - time[:, None] * move)
                pixels = _project(camera, local)
        visible = (local[:, 2] > 0.2) & (np.linalg.norm(local, axis=1) < farthest)
        visible &= (pixels >= 0).all(1) & (pixels[:, 0] < WIDTH) & (pixels[:, 1] < HEIGHT)
        if seen is not None:
            visible &= seen(index, visible)
        chosen = np.flatnonzero(visible)
        image = pycolmap.Image(
            names.format(index), pixels[chosen] + random.normal(0, noise, (len(chosen), 2)), 1, index + 1
        )
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for feature, point in enumerate(chosen):
            tracks[point].append((index + 1, feature))
    for position, track in zip(positions, tracks, strict=True):
        if len(track) >= 2:
            elements = [pycolmap.TrackElement(*element) for element in track]
            reconstruction.add_point3D(position, pycolmap.Track(elements), np.zeros(3, np.uint8))
    if adjust:
        if first_focal:
            camera = reconstruction.camera(1)
            camera.params = [first_focal, *camera.params[1:]]
        for _ in range(2):
            options = pycolmap.BundleAdjustmentOptions()
            options.print_summary = False
            pycolmap.bundle_adjustment(reconstruction, options)
            manager = pycolmap.ObservationManager(reconstruction)
            manager.filter_all_points3D(4.0, 1.5)
    reconstruction.update_point_3d_errors()
    return reconstruction


def _project(camera: pycolmap.Camera, local: np.ndarray) -> np.ndarray:
    ahead = local[:, 2] > 0.1
    pixels = np.full((len(local), 2), -1.0)
    pixels[ahead] = camera.img_from_cam(local[ahead])
    return pixels
