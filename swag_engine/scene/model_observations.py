"""Observations of a COLMAP model as arrays."""

import math
from dataclasses import dataclass

import numpy as np

from .colmap_library import pycolmap

_SAMPLE = 40_000
"""Observations that are read, at most, so that the time is bounded."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of a sample of a model's points, in arrays.

    Attributes:
        image_ids: Ids (V,) of the registered images, in the order of their names.
        world_to_camera: Their poses (V, 3, 4).
        camera_ids: Ids (V,) of their cameras.
        positions: The points (P, 3).
        fraction: Fraction of the model's points that they are, 0..1.
        image: Row of `image_ids` of each observation (M,), sorted within each point.
        point: Row of `positions` of each observation (M,), sorted.
        pixels: Where it was seen (M, 2), COLMAP's pixels.
        residuals: `pixels` less the projection of the point (M, 2), pixels.
    """

    image_ids: np.ndarray
    world_to_camera: np.ndarray
    camera_ids: np.ndarray
    positions: np.ndarray
    fraction: float
    image: np.ndarray
    point: np.ndarray
    pixels: np.ndarray
    residuals: np.ndarray

    @property
    def centres(self) -> np.ndarray:
        """Camera centres (V, 3)."""
        return -np.einsum("vji,vj->vi", self.world_to_camera[:, :, :3], self.world_to_camera[:, :, 3])

    @classmethod
    def of(cls, model: pycolmap.Reconstruction) -> "Observations":
        """Read about `_SAMPLE` observations at most, of points that are evenly spaced in the order of their ids."""
        images = sorted(
            (model.image(key) for key in model.reg_image_ids()), key=lambda image: (image.name, image.image_id)
        )
        row = {image.image_id: index for index, image in enumerate(images)}
        ids = np.array(sorted(model.point3D_ids()), np.uint64)
        chosen = ids[:: max(1, math.ceil(model.compute_num_observations() / _SAMPLE))]
        found = []
        positions = np.zeros((len(chosen), 3))
        features = [image.points2D for image in images]
        for number, point_id in enumerate(chosen):
            point = model.point3D(int(point_id))
            positions[number] = point.xyz
            seen = {}
            for element in point.track.elements:
                if element.image_id in row:
                    seen[row[element.image_id]] = element.point2D_idx
            for image, feature in sorted(seen.items()):
                found.append((image, number, *features[image][feature].xy))
        table = np.array(found, float).reshape(-1, 4)
        poses = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
        table = table[np.isfinite(table).all(1) & np.isfinite(positions).all(1)[table[:, 1].astype(int)]]
        observations = cls(
            image_ids=np.array([image.image_id for image in images], int),
            world_to_camera=poses,
            camera_ids=np.array([image.camera_id for image in images], int),
            positions=positions,
            fraction=len(chosen) / max(1, len(ids)),
            image=table[:, 0].astype(int),
            point=table[:, 1].astype(int),
            pixels=table[:, 2:],
            residuals=np.zeros((len(table), 2)),
        )
        observations.residuals[:] = observations.pixels - observations.project(model)
        return observations

    def in_camera(self, image: np.ndarray | None = None) -> np.ndarray:
        """Return the observed points in the coordinates of the images' cameras, (M, 3).

        Args:
            image: Rows (M,) of images instead of those that observed the points.
        """
        poses = self.world_to_camera[self.image if image is None else image]
        return np.einsum("mij,mj->mi", poses[:, :, :3], self.positions[self.point]) + poses[:, :, 3]

    def project(self, model: pycolmap.Reconstruction, image: np.ndarray | None = None) -> np.ndarray:
        """Return where each observed point should be seen, (M, 2) pixels; NaN behind the camera.

        Args:
            model: The model, whose lenses are used.
            image: As in `in_camera`.
        """
        points = self.in_camera(image)
        points[points[:, 2] <= 0] = np.nan
        projected = np.full((len(points), 2), np.nan)
        cameras = self.camera_ids[self.image if image is None else image]
        for camera_id in np.unique(cameras):
            projected[cameras == camera_id] = model.camera(camera_id).img_from_cam(points[cameras == camera_id])
        return projected
