from pathlib import Path

import cv2
import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.scene import sfm
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.sfm import reconstruct
from tests.scenes.panels import SIZE, render, write_photos

shared = Path(__file__).resolve().parents[2].parent / "shared"


def test_poses_of_dim_photographs_are_found(tmp_path: Path) -> None:
    photos = tmp_path / "Fotos vom Öresund"
    true = {}
    for index, x in enumerate(np.linspace(-1.5, 1.5, 9)):
        name = f"{'links' if index < 4 else 'rechts'}/{index}.png"
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        (photos / name).write_bytes(cv2.imencode(".png", render(x))[1].tobytes())
        true[name] = np.array([x, 0.1 * np.sin(2 * x), 0])
    steps: list[tuple[str, float]] = []
    out = tmp_path / "out"
    result = reconstruct(photos, out, lambda stage, fraction: steps.append((stage, fraction)))

    assert (result["images"], result["registered"], result["registered_share"]) == (9, 9, 1.0)
    assert result["points"] > 200 and result["reprojection_error"] < 1 and result["warnings"] == []
    stages = list(dict.fromkeys(stage for stage, _ in steps))
    assert stages == ["Copying photos", "Preparing photos", "Detecting features", "Matching photos", "Placing cameras"]
    assert all(0 <= fraction <= 1 for _, fraction in steps)
    assert sorted(path.name for path in tmp_path.iterdir()) == [photos.name, "out"]

    scene = load_scene(out)
    assert [view.name for view in scene.views] == sorted(true)
    assert (out / "images" / "links" / "0.png").read_bytes() == (photos / "links" / "0.png").read_bytes()
    assert np.ptp(scene.points.colors.mean(0)) > 20  # colours of the photographs, not of the grey copies
    centres = np.stack([view.camera.centre for view in scene.views])
    wanted = np.stack([true[view.name] for view in scene.views])
    centres, wanted = centres - centres.mean(0), wanted - wanted.mean(0)
    centres *= np.linalg.norm(wanted) / np.linalg.norm(centres)
    u, _, vt = np.linalg.svd(wanted.T @ centres)
    assert np.abs(centres @ (u @ vt).T - wanted).max() < 0.1  # of a path 3 long; its focal length is free


@pytest.mark.parametrize(("codec", "suffix"), [("mp4v", ".mp4"), ("MJPG", ".avi")])
def test_video_frames_are_the_sharp_ones_evenly_spaced_in_motion(tmp_path: Path, codec: str, suffix: str) -> None:
    film = tmp_path / f"Film ü{suffix}"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*codec), 25, SIZE)
    places = np.concatenate([np.linspace(-1, 0, 60), np.zeros(60), np.linspace(0, 1, 60)])  # the camera rests midway
    for number, x in enumerate(places):
        frame = render(x)
        writer.write(frame if number % 3 == 0 else cv2.GaussianBlur(frame, (0, 0), 1.5))
    writer.release()
    (tmp_path / "images").mkdir()
    names = sfm._pick_frames(film, tmp_path, lambda stage, fraction: None)
    numbers = np.array([int(name[6:12]) for name in names])
    assert sorted(path.name for path in (tmp_path / "images").iterdir()) == names
    assert 25 <= len(numbers) <= 60
    assert ((numbers > 60) & (numbers < 120)).sum() <= 1
    assert (numbers % 3 == 0).mean() > 0.6
    assert np.diff(places[numbers]).max() < 0.15


def test_a_video_becomes_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sfm, "_FEWEST_FRAMES", 10)
    monkeypatch.setattr(sfm, "_MOST_FRAMES", 12)
    film = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 25, SIZE)
    for x in np.linspace(-1.5, 1.5, 40):
        writer.write(render(x))
    writer.release()
    result = reconstruct(film, tmp_path / "out")
    scene = load_scene(tmp_path / "out")
    assert 9 <= result["images"] <= 13 and len(scene.views) == result["registered"] >= 0.9 * result["images"]


def test_photos_that_do_not_connect_are_said_to_be_left_out(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "photos", np.linspace(-1.5, 0, 6))
    for index, x in enumerate(np.linspace(-1, 0, 4)):  # mirrored, they match no other photo
        (photos / f"mirrored_{index}.png").write_bytes(cv2.imencode(".png", render(x)[:, ::-1])[1].tobytes())
    result = reconstruct(photos, tmp_path / "out")
    assert result["registered"] == 6
    assert result["warnings"] == [
        "The photos fall into 2 groups without connection, of 6 and 4 photos, and only the largest is used: photos "
        "between them would help."
    ]
    assert "Only 6 of the 10 photos" in load_scene(tmp_path / "out").warnings[0]


def test_photos_are_those_in_the_images_folder(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "dive" / "images", np.linspace(-0.5, 0.5, 4))
    write_photos(tmp_path / "dive" / "labels" / "coral", [0.0, 0.1])
    result = reconstruct(photos.parent, tmp_path / "out")
    assert result["images"] == 4 and (tmp_path / "out" / "images" / "0.png").exists()


def test_a_video_in_which_nothing_moves_is_refused(tmp_path: Path) -> None:
    film = tmp_path / "still.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 25, SIZE)
    for _ in range(10):
        writer.write(render(0))
    writer.release()
    with pytest.raises(InputError, match="hardly moves"):
        reconstruct(film, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["still.avi"]


@pytest.mark.skipif(not (shared / "data").is_dir(), reason="the shared example scenes are not here")
def test_a_real_sea_floor(tmp_path: Path) -> None:
    result = reconstruct(shared / "data" / "sparus_seabed" / "images", tmp_path / "out")
    assert result["registered"] == result["images"] == 22
    assert result["points"] > 931 and result["reprojection_error"] < 0.8  # 931: without equalised copies
