from pathlib import Path

import numpy as np
import pycolmap

from swag_engine.sfm.mapping import _triangulation_angles


def test_triangulation_angles_of_pairs_are_those_of_the_points_they_share(tmp_path: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 5
    options.num_points3D = 400
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        true = pycolmap.synthesize_dataset(options, database)
    angles = _triangulation_angles(tmp_path / "database.db")
    assert len(angles) > 3
    positions = np.array([point.xyz for point in true.points3D.values()])
    for pair, angle in angles.items():
        rays = [positions - true.image(key).projection_center() for key in pair]
        first, second = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in rays)
        between = np.degrees(np.arccos((first * second).sum(1)))
        between = np.minimum(between, 180 - between)
        assert abs(angle - np.median(between)) < 0.1 * np.median(between) + 1, pair
