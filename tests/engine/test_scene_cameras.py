from dataclasses import replace

import numpy as np
import pytest

from swag_engine.scene.cameras import Camera


def camera() -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    pose[:3, 3] = [1, 2, 3]
    return Camera("a", 1280, 845, 1000.0, 990.0, 640.0, 420.0, pose)


def test_centre_maps_to_the_camera_origin() -> None:
    view = camera()
    assert np.allclose(view.world_to_camera @ [*view.centre, 1], [0, 0, 0, 1])


def test_resized_keeps_the_true_ratio_of_each_axis() -> None:
    full, small = camera(), camera().resized(480)
    assert (small.width, small.height) == (480, 317)
    point = np.array([0.3, -0.2, 1.0])
    where, smaller = (full.K @ point)[:2], (small.K @ point)[:2]
    assert np.allclose(smaller / [480, 317], where / [1280, 845])


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_view_planes_bound_what_the_image_and_pixels_beside_it_show(kind) -> None:
    view = camera() if kind == "perspective" else replace(camera(), kind=kind, fx=200.0, fy=190.0)
    points = np.random.default_rng(0).normal(view.centre, 4.0, (4000, 3))
    planes = view.view_planes((100.0, 50.0))
    inside = points @ planes[:, :3].T + planes[:, 3]
    x, y, z = view.world_to_camera[:3, :3] @ points.T + view.world_to_camera[:3, 3:]
    depth = z if kind == "perspective" else 1.0
    column, row = view.fx * x / depth + view.cx, view.fy * y / depth + view.cy
    shown = (z > 0) & (column > -100) & (column < 1380) & (row > -50) & (row < 895)
    assert 100 < shown.sum() < 2000
    assert np.array_equal((inside > 0).all(axis=1), shown)
    for index, plane in enumerate(planes):  # distances: the foot of each perpendicular is on the plane
        feet = points - inside[:, index, None] * plane[:3]
        assert np.allclose(feet @ plane[:3] + plane[3], 0, atol=1e-9)
