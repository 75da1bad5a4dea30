"""Cameras estimated from generated photos, against the true ones; benchmarks/cameras.py measures more of them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.cameras import compare
from swag_engine.scene.colmap import load_scene
from swag_engine.sfm.reconstruct import reconstruct
from tests.scenes.camera_paths import SCENES, make_camera_scene


@pytest.mark.parametrize(("name", "first", "second"), [("wall", 2, 3), ("fisheye", 1, 2), ("lamp", 1, 2)])
def test_generated_photos_agree_with_their_cameras(tmp_path: Path, name: str, first: int, second: int) -> None:
    made = make_camera_scene(name, tmp_path, width=320, images=4)
    sift, matcher = cv2.SIFT.create(1000), cv2.BFMatcher()
    found = [
        sift.detectAndCompute(cv2.imread(str(tmp_path / made.names[number]), cv2.IMREAD_GRAYSCALE), None)
        for number in (first, second)
    ]
    matches = [a for a, b in matcher.knnMatch(found[0][1], found[1][1], 2) if a.distance < 0.7 * b.distance]
    assert len(matches) > 60
    pixels = [
        np.array([found[side][0][index].pt for index in indices]) + 0.5
        for side, indices in enumerate(zip(*((match.queryIdx, match.trainIdx) for match in matches), strict=True))
    ]
    rays = [made.lens.camera.cam_ray_from_img(each) for each in pixels]
    rays = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in rays]
    motion = made.world_to_camera[second] @ np.linalg.inv(made.world_to_camera[first])
    normals = np.cross(motion[:3, 3], rays[0] @ motion[:3, :3].T)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    off_plane = np.abs((normals * rays[1]).sum(1)) * made.lens.params[0]  # pixels from the epipolar line
    assert np.median(off_plane) < 0.25 and (off_plane < 2).mean() > 0.95


def test_every_scene_keeps_its_camera_above_the_floor_and_looks_at_it(tmp_path: Path) -> None:
    for name in SCENES:
        made = make_camera_scene(name, tmp_path / name, width=48, images=3)
        assert (made.centres[:, 2] > 1).all(), name
        for photo in made.names:
            assert cv2.imread(str(tmp_path / name / photo)).std() > 2, name  # not endless water, which has noise alone


def test_cameras_along_a_wall_are_exact(tmp_path: Path) -> None:
    made = make_camera_scene("wall", tmp_path / "photos", width=320, images=8)
    result = reconstruct(made.folder, tmp_path / "scene")
    assert result["registered"] == 8
    scene = load_scene(tmp_path / "scene")
    errors = compare(scene, made.names, dict(zip(made.names, made.world_to_camera, strict=True)))
    assert errors["position_error"] < 0.01 and errors["rotation_error"] < 1.5
    assert abs(scene.views[0].lens.params[0] / made.lens.params[0] - 1) < 0.05


@pytest.mark.parametrize("images", [8, 12])
def test_a_focal_length_that_forward_motion_leaves_open_is_right_or_said_to_be_unknown(
    tmp_path: Path, images: int
) -> None:
    made = make_camera_scene("forward video", tmp_path / "photos", width=320, images=images)
    result = reconstruct(made.folder, tmp_path / "scene")
    focal = load_scene(tmp_path / "scene").views[0].lens.params[0]
    said = any("focal length" in warning for warning in result["warnings"])
    assert said or abs(focal / made.lens.params[0] - 1) < 0.05
