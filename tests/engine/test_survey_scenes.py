"""The generated surveys are what they say: benchmarks and other tests rely on it."""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from swag_engine.scene.colmap import View, load_scene
from tests.scenes.make_scene import Water, srgb, through_water
from tests.scenes.survey_scenes import (
    FOCAL,
    REEF_WATER,
    TINY,
    exposure_gains,
    large_model,
    reef_poses,
    street,
    street_poses,
    tiny_survey,
)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_survey(tmp_path_factory.mktemp("survey") / "tiny")


def reprojections(model: Path) -> np.ndarray:
    """Distances (O,) in pixels of all observations of a model from their points' projections."""
    read = pycolmap.Reconstruction(str(model))
    errors = []
    for image in read.images.values():
        camera, points = read.camera(image.camera_id), [point for point in image.points2D if point.has_point3D()]
        places = np.array([read.point3D(point.point3D_id).xyz for point in points])
        local = places @ image.cam_from_world().rotation.matrix().T + image.cam_from_world().translation
        assert (local[:, 2] > 0).all()
        shown = np.array([point.xy for point in points])
        assert (shown > -2).all() and (shown < [camera.width + 2, camera.height + 2]).all()
        errors.append(np.linalg.norm(camera.img_from_cam(local) - shown, axis=1))
    return np.concatenate(errors)


def test_cameras_and_points_are_those_of_the_place(tiny: Path) -> None:
    assert np.median(reprojections(tiny / "sparse" / "0")) < 0.6
    scene = load_scene(tiny)
    assert scene.up @ [0, 0, 1] > 0.99
    for view, pose in zip(scene.views, reef_poses(20, TINY), strict=True):
        np.testing.assert_allclose(view.camera.world_to_camera, pose, atol=1e-9)
        assert view.camera.fx == FOCAL * view.camera.width
    for name in ("reef_0000", "reef_0008", "reef_0016"):
        (view,) = (view for view in scene.views if view.name.startswith(name))
        ranges = cv2.imread(str(tiny / "range" / f"{name}.png"), cv2.IMREAD_UNCHANGED) / 1000
        points = scene.points.positions[view.point_indices]
        columns, rows, inside = pixels_of(view, points)
        distances = np.linalg.norm(points - view.camera.centre, axis=1)[inside]
        assert np.median(np.abs(distances / ranges[rows, columns] - 1)) < 0.01


def pixels_of(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows of the points in the frame of a view, and which these are."""
    local = points @ view.camera.world_to_camera[:3, :3].T + view.camera.world_to_camera[:3, 3]
    pixels = local[:, :2] / local[:, 2:] * [view.camera.fx, view.camera.fy] + [view.camera.cx, view.camera.cy]
    inside = ((pixels >= 0) & (pixels < [view.camera.width, view.camera.height])).all(1)
    columns, rows = pixels[inside].astype(int).T
    return columns, rows, inside


def test_points_have_the_colors_that_photos_show_there(tiny: Path) -> None:
    scene = load_scene(tiny)
    differences, of_others = [], []
    random = np.random.default_rng(0)
    for view in scene.views:
        image = cv2.imread(str(tiny / "images" / view.name))[..., ::-1]
        columns, rows, inside = pixels_of(view, scene.points.positions[view.point_indices])
        colors = scene.points.colors[view.point_indices][inside].astype(float)
        differences.append(np.abs(image[rows, columns] - colors).mean(1))
        of_others.append(np.abs(image[rows, columns] - random.permutation(colors)).mean(1))
    assert np.median(np.concatenate(differences)) < 0.5 * np.median(np.concatenate(of_others))


def test_the_same_seed_gives_the_same_files(tiny: Path, tmp_path: Path) -> None:
    again, other = tiny_survey(tmp_path / "again"), tiny_survey(tmp_path / "other", images=16, seed=1)
    files = sorted(path.relative_to(tiny) for path in tiny.rglob("*") if path.is_file())
    assert len(files) > 25
    assert files == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    assert all((tiny / file).read_bytes() == (again / file).read_bytes() for file in files)
    assert (other / "images" / "reef_0000.jpg").read_bytes() != (tiny / "images" / "reef_0000.jpg").read_bytes()


def as_photographed(scene: Path, name: str, water: Water, gain: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Photo (H, W, 3) 0..1, what the image formation model makes of its clean image, and where there is a surface."""
    photo = cv2.imread(str(scene / "images" / name))[..., ::-1] / 255
    shown = cv2.imread(str((scene / "clean" / name).with_suffix(".webp")))[..., ::-1] / 255
    clean = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    ranges = cv2.imread(str((scene / "range" / name).with_suffix(".png")), cv2.IMREAD_UNCHANGED) / 1000
    seen = ranges > 0
    formed = through_water(clean, seen.astype(float), np.where(seen, ranges, np.inf), water)
    return photo, srgb(formed * gain).clip(0, 1), seen


def test_water_and_gains_are_those_that_are_stated(tiny: Path) -> None:
    truth = json.loads((tiny / "truth.json").read_text())
    assert truth["held_out"] == ["reef_0000.jpg", "reef_0008.jpg", "reef_0016.jpg"]
    for name in ("beta_D", "beta_B", "B_inf"):
        assert truth["water"][name] == list(getattr(REEF_WATER, name))
    for name in truth["held_out"]:
        photo, formed, _ = as_photographed(tiny, name, REEF_WATER, truth["gains"][name])
        assert np.abs(photo - formed).mean() < 0.02
        _, in_air, _ = as_photographed(tiny, name, Water((0, 0, 0), (0, 0, 0), (0, 0, 0)), 1.0)
        assert np.abs(photo - in_air).mean() > 0.05


def test_a_street_has_no_effects(tmp_path: Path) -> None:
    scene = street(tmp_path / "street", images=16, width=48)
    truth = json.loads((scene / "truth.json").read_text())
    assert truth["water"] is None and set(truth["gains"].values()) == {1.0}
    assert np.median(reprojections(scene / "sparse" / "0")) < 0.6
    for name in truth["held_out"]:
        photo, clean, seen = as_photographed(scene, name, Water((0, 0, 0), (0, 0, 0), (0, 0, 0)), 1.0)
        assert seen.mean() > 0.5 and np.abs(photo - clean)[seen].mean() < 0.03


def test_exposure_changes_slowly_and_much() -> None:
    for images in (150, 300, 600):
        gains = exposure_gains(images)
        assert np.abs(np.diff(np.log(gains))).max() < 0.02
        assert gains.max() / gains.min() > 1.4


@pytest.mark.parametrize("images", [150, 300, 600])
def test_each_place_of_a_reef_is_seen_by_as_many(images: int) -> None:
    poses = np.array(reef_poses(images))
    centres = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    length = np.ptp(centres[:, 0])
    assert length == pytest.approx(0.2 * images, rel=0.04)
    places = np.stack(np.meshgrid(np.linspace(-0.47, 0.47, 40) * length, np.linspace(-2.4, 2.4, 9), 0), -1)
    counts = seen_by(poses, places.reshape(-1, 3), 9.0)
    assert counts.min() >= 5 and 8 <= np.median(counts) <= 16


def test_each_facade_of_a_street_is_seen_by_several() -> None:
    poses = np.array(street_poses(300))
    places = np.stack(np.meshgrid(np.linspace(-100, 100, 100), [-5, 5], [0.5, 2.5]), -1)
    counts = seen_by(poses, places.reshape(-1, 3), 15.0)
    assert counts.min() >= 2 and np.median(counts) >= 4


def seen_by(poses: np.ndarray, places: np.ndarray, farthest: float) -> np.ndarray:
    """Number of cameras (P,) that have a place in view, at most `farthest` away."""
    local = np.einsum("vij,pj->vpi", poses[:, :3, :3], places) + poses[:, None, :3, 3]
    ahead = (local[..., 2] > 0.3) & (np.linalg.norm(local, axis=-1) < farthest)
    shown = np.abs(local[..., :2]) * FOCAL < np.maximum(local[..., 2:], 0.1) * [0.5, 0.375]
    return (ahead & shown.all(-1)).sum(0)


def test_a_large_model_is_one_that_colmap_could_have_written(tmp_path: Path) -> None:
    folder = large_model(tmp_path / "large", images=230, points=9000)
    errors = reprojections(folder / "sparse" / "0")
    assert 0.3 < np.median(errors) < 0.6 and errors.max() < 4
    scene = load_scene(folder)
    assert len(scene.views) == 230 and len(scene.points.positions) == 9000 and not scene.warnings
    assert scene.points.track_lengths.mean() == pytest.approx(4.5, abs=0.1)
    assert len(list((folder / "images").iterdir())) == 230
