from pathlib import Path

import numpy as np
import pycolmap
import pytest

from swag_engine.sfm.mapping import _incremental_options, _map_incrementally, _triangulation_angles


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


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("points", [40, 400])  # 40: COLMAP relaxes what it requires of an initial pair
def test_mapping_is_that_of_colmap_in_one_thread(tmp_path: Path, points: int, given: bool) -> None:
    synthetic = pycolmap.SyntheticDatasetOptions()
    synthetic.num_rigs, synthetic.num_cameras_per_rig, synthetic.num_frames_per_rig = 1, 1, 5
    synthetic.num_points3D = points
    pycolmap.set_random_seed(0)
    path = tmp_path / "database.db"
    with pycolmap.Database.open(str(path)) as database:
        pycolmap.synthesize_dataset(synthetic, database)
    options = _incremental_options()
    options.init_num_trials = 3
    if given:
        options.init_image_id1, options.init_image_id2, options.multiple_models = 1, 3, False
    placed: list[int] = []
    found = _map_incrementally(path, options, lambda: placed.append(1))
    options.num_threads = 1
    wanted = list(pycolmap.incremental_mapping(str(path), str(tmp_path), str(tmp_path), options).values())
    assert [model.num_reg_images() for model in found] == [model.num_reg_images() for model in wanted]
    for model, other in zip(found, wanted, strict=True):
        assert len(placed) == model.num_reg_images() - 1
        assert model.num_points3D() == other.num_points3D()
        for key in other.reg_image_ids():
            pose, other_pose = (each.image(key).cam_from_world().matrix() for each in (model, other))
            assert np.array_equal(pose, other_pose)
