import shutil
import struct
import subprocess
import sys
from pathlib import Path
from types import FrameType

import numpy as np
import pycolmap
import pytest

from swag_engine.base.errors import InputError
from swag_engine.scene import colmap_binary
from swag_engine.scene.colmap import Scene, load_scene, up_direction
from swag_engine.scene.inspect import describe, inspect_scene
from tests.scenes.dots import dot_positions, make_dot_scene

shared = Path(__file__).resolve().parents[2].parent / "shared"
needs_data = pytest.mark.skipif(not (shared / "data").is_dir(), reason="the shared example scenes are not here")


def reprojection_errors(scene: Scene, model: pycolmap.Reconstruction) -> np.ndarray:
    """Pixels between where COLMAP saw each point and where view and point of the scene put it (pinhole lenses)."""
    errors = []
    for view in scene.views:
        image = model.find_image_with_name(view.name)
        points = scene.points.positions[view.point_indices] @ view.camera.world_to_camera[:3, :3].T
        points = (points + view.camera.world_to_camera[:3, 3]) @ view.camera.K.T
        seen = np.array([point.xy for point in image.get_observation_points2D()])
        errors.append(np.linalg.norm(points[:, :2] / points[:, 2:] - seen, axis=1))
    return np.concatenate(errors)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("classic", [False, True])
def test_poses_points_and_tracks_are_those_of_the_model(tmp_path: Path, text: bool, classic: bool) -> None:
    folder = make_dot_scene(tmp_path, text=text)
    if classic:  # before COLMAP 4 there were no rigs and frames
        for part in ("rigs", "frames"):
            (folder / "sparse" / "0" / f"{part}.{'txt' if text else 'bin'}").unlink()
    scene = load_scene(folder)
    assert [view.name for view in scene.views] == [f"view_{i:02d}.png" for i in range(1, 5)]
    assert all(view.path == folder / "images" / view.name for view in scene.views)
    assert np.allclose(scene.points.positions, dot_positions())
    assert scene.points.colors[:, 2].tolist() == list(range(60))
    assert scene.points.track_lengths.sum() == sum(len(view.point_indices) for view in scene.views)
    errors = reprojection_errors(scene, pycolmap.Reconstruction(str(folder / "sparse" / "0")))
    assert len(errors) > 150 and errors.max() < 1e-3
    assert scene.warnings == () and scene.missing == () and scene.image_count == 4


def test_a_folder_that_was_moved_is_told_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'There is no folder .*moved.*give their new folder.*"scene" in config.json'):
        load_scene(tmp_path / "moved")


def test_a_rig_of_two_cameras(tmp_path: Path) -> None:
    scene = load_scene(make_dot_scene(tmp_path, views=3, cameras_per_rig=2))
    assert len(scene.views) == 6
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert reprojection_errors(scene, model).max() < 1e-3
    left, right = scene.views[0].camera, scene.views[1].camera
    assert np.linalg.norm(left.centre - right.centre) == pytest.approx(0.3)


@pytest.mark.parametrize("model", ["sparse/0", "sparse", "colmap/sparse/0", ".", "sparse/3"])
@pytest.mark.parametrize("images", ["images", "input", "Images", "photos/left", "."])
def test_models_and_photographs_are_found_where_people_keep_them(tmp_path: Path, model: str, images: str) -> None:
    folder = tmp_path / "Riff bei Öland, 3. Tauchgang"
    scene = load_scene(make_dot_scene(folder, views=2, model=model, images=images))
    assert scene.model_folder == folder / model and scene.image_folder == folder / images
    assert len(scene.views) == 2 and scene.warnings == ()


@pytest.mark.parametrize("given", ["sparse/0", "sparse", "."])
def test_the_model_folder_may_be_given_as_the_scene(tmp_path: Path, given: str) -> None:
    make_dot_scene(tmp_path, views=2)
    scene = load_scene(tmp_path / given)
    assert scene.folder == tmp_path and scene.image_folder == tmp_path / "images"


def test_a_model_folder_of_any_name_beside_the_photographs(tmp_path: Path) -> None:
    make_dot_scene(tmp_path, views=2, model="exported model")
    assert load_scene(tmp_path / "exported model").image_folder == tmp_path / "images"


def test_restored_copies_beside_the_photographs_are_not_taken_for_missing_ones(tmp_path: Path) -> None:
    make_dot_scene(tmp_path, views=4)
    shutil.copytree(tmp_path / "images", tmp_path / "aaa_restored")
    (tmp_path / "images" / "view_03.png").unlink()
    (tmp_path / "aaa_restored" / "view_01.png").unlink()
    scene = load_scene(tmp_path)
    assert scene.image_folder == tmp_path / "images"
    assert scene.missing == ("view_03.png",) and len(scene.views) == 3
    assert "view_03.png" in scene.warnings[0]


def test_sub_folders_case_and_basenames(tmp_path: Path) -> None:
    make_dot_scene(tmp_path / "nested", views=2, name="dive/cam0/view_{:02d}.png")
    assert load_scene(tmp_path / "nested").views[0].path.parent == tmp_path / "nested" / "images" / "dive" / "cam0"

    make_dot_scene(tmp_path / "case", views=2, name="View_{:02d}.PNG")
    for path in (tmp_path / "case" / "images").iterdir():
        path.rename(path.with_name(path.name.lower()))
    assert len(load_scene(tmp_path / "case").views) == 2

    make_dot_scene(tmp_path / "flat", views=2, name="dive/view_{:02d}.png")
    (tmp_path / "flat" / "images" / "dive").rename(tmp_path / "flat" / "photos")
    scene = load_scene(tmp_path / "flat")
    assert len(scene.views) == 2 and "matched by file name" in scene.warnings[0]


@pytest.mark.parametrize("text", [False, True])
def test_names_with_spaces_and_umlauts(tmp_path: Path, text: bool) -> None:
    scene = load_scene(make_dot_scene(tmp_path, views=2, name="Grüner Fisch {:02d}.png", text=text))
    assert [view.name for view in scene.views] == ["Grüner Fisch 01.png", "Grüner Fisch 02.png"]


def test_the_largest_of_several_models_is_taken_and_said(tmp_path: Path) -> None:
    make_dot_scene(tmp_path, views=5, model="sparse/1")
    make_dot_scene(tmp_path, views=2, model="sparse/0")
    scene = load_scene(tmp_path)
    assert scene.model_folder.name == "1" and len(scene.views) == 5
    assert "2 COLMAP models" in scene.warnings[0] and "5" in scene.warnings[0]


def test_few_registered_photographs_are_said(tmp_path: Path) -> None:
    make_dot_scene(tmp_path, views=2)
    for index in range(8):
        shutil.copy(tmp_path / "images" / "view_01.png", tmp_path / "images" / f"other_{index}.png")
    scene = load_scene(tmp_path)
    assert scene.image_count == 10 and "2 of the 10" in scene.warnings[0]


def looking(forward: np.ndarray, up: np.ndarray, centre: np.ndarray) -> np.ndarray:
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, up) / np.linalg.norm(np.cross(z, up))
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(z, x), z]
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


UP = np.array([0.6, 0.0, 0.8])  # any direction: COLMAP's axes mean nothing
EAST, NORTH = np.array([0.8, 0.0, -0.6]), np.array([0.0, 1.0, 0.0])


def angle_to_up(poses: list[np.ndarray], points: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(up_direction(np.stack(poses), points) @ UP, -1, 1))))


def test_up_over_a_flat_sea_floor_whatever_the_pitch() -> None:
    random = np.random.default_rng(1)
    floor = random.uniform(-5, 5, (500, 2)) @ np.stack([EAST, NORTH]) + random.normal(0, 0.3, (500, 1)) * UP
    for pitch in (30, 60, 90, 100):  # at 100 the pictures' tops are a little below level
        forward = np.cos(np.radians(pitch)) * NORTH - np.sin(np.radians(pitch)) * UP
        poses = [looking(forward, UP if pitch < 90 else NORTH, 4 * UP + k * NORTH) for k in range(-3, 4)]
        assert angle_to_up(poses, floor) < 3, pitch


def test_up_of_cameras_around_a_block_looking_down_on_it() -> None:
    random = np.random.default_rng(1)
    block = random.normal(0, 1, (500, 3))
    for turn in (90, 360):  # degrees of the circle: in a quarter of it the mean of the cameras' y axes leans over
        poses = []
        for angle in np.radians(np.linspace(0, turn, 12)):
            out = np.cos(angle) * EAST + np.sin(angle) * NORTH
            poses.append(looking(-out - 0.7 * UP, UP, 6 * out + 4 * UP))
        assert angle_to_up(poses, block) < 3, turn


def test_up_of_level_cameras_that_do_not_turn() -> None:
    block = np.random.default_rng(1).normal(0, 1, (500, 3))
    assert angle_to_up([looking(NORTH, UP, -6 * NORTH + k * EAST) for k in range(5)], block) < 1


def test_inspection_says_what_is_there(tmp_path: Path) -> None:
    make_dot_scene(tmp_path, views=10)
    (tmp_path / "images" / "view_04.png").unlink()
    scene = load_scene(tmp_path)
    summary = inspect_scene(scene)
    assert (summary["images"], summary["registered"], summary["views"], summary["points"]) == (9, 10, 9, 60)
    assert summary["missing"] == ["view_04.png"] and summary["split"] == {"train": 6, "validation": 1, "test": 2}
    distances = np.concatenate(
        [np.linalg.norm(scene.points.positions[v.point_indices] - v.camera.centre, axis=1) for v in scene.views]
    )
    assert summary["ranges"]["p50"] == pytest.approx(np.median(distances))
    text = describe(summary)
    assert "view_04.png" in text and "PINHOLE 200 x 150" in text and str(tmp_path) in text


def test_inspection_says_what_is_doubtful(tmp_path: Path) -> None:
    make_dot_scene(tmp_path)
    scene = load_scene(tmp_path)
    camera = inspect_scene(scene)["cameras"][0]
    assert inspect_scene(scene)["warnings"] == []
    assert camera["focal_length"] == 150 and camera["field_of_view"] == pytest.approx(67.38, abs=0.01)
    model = pycolmap.Reconstruction(str(scene.model_folder))
    for camera in model.cameras.values():
        camera.params = [2000.0, 2000.0, *camera.params[2:]]
    for point in model.points3D.values():
        point.error = 2.5
    weak = model.find_image_with_name("view_01.png")
    for index in [i for i, point in enumerate(weak.points2D) if point.has_point3D()][30:]:
        model.delete_observation(weak.image_id, index)
    model.write(str(scene.model_folder))
    summary = inspect_scene(load_scene(tmp_path))
    warnings = "\n".join(summary["warnings"])
    assert "field of view of 6°" in warnings and "EXIF" in warnings
    assert "2.5 px (threshold 2 px)" in warnings
    assert "Photos with fewer than 40 points, whose poses are doubtful: view_01.png." in warnings
    assert all(f"Warning:     {warning}" in describe(summary) for warning in summary["warnings"])


def write_large_scene(folder: Path, views: int, points: int, per_view: int) -> None:
    """A classic binary model, written directly: pycolmap takes long to make one of this size."""
    random = np.random.default_rng(0)
    model = folder / "sparse"
    model.mkdir()
    (folder / "images").mkdir()
    (model / "cameras.bin").write_bytes(
        struct.pack("<QIiQQ8d", 1, 1, 4, 1024, 768, 900, 900, 512, 384, -0.1, 0.01, 0, 0)
    )
    seen = np.zeros(per_view, [("xy", "<f8", 2), ("point", "<u8")])
    track = np.zeros(per_view, [("image", "<u4"), ("row", "<u4")])
    tracks = []
    with open(model / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", views))
        for image in range(1, views + 1):
            seen["point"] = random.permutation(points)[:per_view]
            track["image"], track["row"] = image, np.arange(per_view)
            tracks.append((seen["point"].copy(), track.copy()))
            name = f"{image:04d}.jpg"
            file.write(struct.pack("<I7dI", image, 1, 0, 0, 0, 0.1 * image, 0, 5, 1) + name.encode() + b"\0")
            file.write(struct.pack("<Q", per_view) + seen.tobytes())
            (folder / "images" / name).write_bytes(b"x")
    order = np.argsort(np.concatenate([point for point, _ in tracks]), kind="stable")
    counts = np.bincount(np.concatenate([point for point, _ in tracks]).astype(int), minlength=points)
    elements = np.concatenate([track for _, track in tracks])[order]
    at = 0
    with open(model / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", points))
        for point, count in enumerate(counts):
            file.write(struct.pack("<Q3d3Bd", point, *random.normal(size=3), 1, 2, 3, 0.5))
            file.write(struct.pack("<Q", count) + elements[at : at + count].tobytes())
            at += count


def test_reading_makes_no_call_per_observation(tmp_path: Path) -> None:
    """Models of surveys have tens of millions of observations: numpy reads them, not a loop."""
    views, per_view, calls = 100, 5000, 0

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    write_large_scene(tmp_path, views, points=20_000, per_view=per_view)
    sys.setprofile(count)
    try:
        summary = inspect_scene(load_scene(tmp_path))
    finally:
        sys.setprofile(None)
    assert summary["points"] == 20_000 and summary["views"] == views and summary["points_per_view"] == per_view
    assert 1000 < calls < 0.7 * views * per_view


def test_binary_models_are_read_as_pycolmap_reads_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Records that lie across the ends of chunks, names longer than what is read at once, features without a point."""
    folder = make_dot_scene(tmp_path, views=3, name=f"{'deep/' * 20}view_{{:02d}}.png")
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    model.delete_point3D(7)
    for point_id, point in model.points3D.items():
        point.error = 0.1 * point_id
    model.write_binary(str(folder / "sparse" / "0"))
    monkeypatch.setattr(colmap_binary, "CHUNK", 200)
    monkeypatch.setattr(colmap_binary, "HEADER", 70)
    scene = load_scene(folder)
    ids = sorted(model.point3D_ids())
    points = [model.point3D(point_id) for point_id in ids]
    assert len(ids) == 59 and 7 not in ids
    assert scene.points.positions.tolist() == [point.xyz.tolist() for point in points]
    assert scene.points.colors.tolist() == [point.color.tolist() for point in points]
    assert scene.points.errors.tolist() == [np.float32(point.error) for point in points]
    assert scene.points.track_lengths.tolist() == [point.track.length() for point in points]
    for view in scene.views:
        image = model.find_image_with_name(view.name)
        seen = {feature.point3D_id for feature in image.points2D if feature.has_point3D()}
        assert [ids[row] for row in view.point_indices] == sorted(seen) and len(seen) < image.num_points2D()


def test_points_with_the_same_id_are_damage(tmp_path: Path) -> None:
    file = make_dot_scene(tmp_path) / "sparse" / "0" / "points3D.bin"
    data = bytearray(file.read_bytes())
    (track,) = struct.unpack_from("<Q", data, 8 + 43)
    second = 8 + 51 + 8 * track
    data[second : second + 8] = data[8:16]
    file.write_bytes(data)
    with pytest.raises(InputError, match="do not fit together"):
        load_scene(tmp_path)


def test_reading_a_scene_needs_no_torch() -> None:
    code = "import swag_engine.scene.inspect, swag_engine.scene.images, sys; sys.exit('torch' in sys.modules)"
    root = Path(__file__).resolve().parents[2]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


@needs_data
@pytest.mark.parametrize(
    ("name", "views", "points", "model"),
    [
        ("aqualoc_amphorae", 40, 10427, "OPENCV"),
        ("japanese_gardens", 40, 7833, "SIMPLE_PINHOLE"),
        ("sparus_seabed", 22, 931, "SIMPLE_RADIAL"),
    ],
)
def test_real_scenes(name: str, views: int, points: int, model: str) -> None:
    scene = load_scene(shared / "data" / name)
    assert len(scene.views) == scene.image_count == views and len(scene.points.positions) == points
    assert scene.image_folder.name == "images" and scene.views[0].lens.model == model
    height = np.mean(
        [(view.camera.centre - np.median(scene.points.positions, axis=0)) @ scene.up for view in scene.views]
    )
    assert height > 0  # the cameras are above the sea floor
    if name == "sparus_seabed":  # looks straight down
        assert all(view.camera.world_to_camera[2, :3] @ scene.up < -0.9 for view in scene.views)
    if name == "japanese_gardens":  # looks ahead
        assert all(view.camera.world_to_camera[1, :3] @ scene.up < -0.9 for view in scene.views)


@pytest.mark.parametrize("nested", [False, True])
def test_images_behind_a_symbolic_link_are_found(tiny_scene, tmp_path, nested):
    scene = tmp_path / "scene"
    shutil.copytree(tiny_scene / "sparse", scene / "sparse")
    images = scene / "images"
    if nested:  # a folder of each camera, and a link in a circle
        images.mkdir()
        (images / "left").symlink_to(tiny_scene / "images", target_is_directory=True)
        (images / "again").symlink_to(scene, target_is_directory=True)
    else:
        images.symlink_to(tiny_scene / "images", target_is_directory=True)
    found = load_scene(scene)
    assert len(found.views) == found.image_count == 10
    assert all(view.path.is_relative_to(images) for view in found.views)
