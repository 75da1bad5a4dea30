import numpy as np

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
