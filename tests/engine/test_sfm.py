from pathlib import Path

import cv2
import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.scene.colmap import load_scene
from swag_engine.sfm.reconstruct import reconstruct
from tests.scenes.panels import render, write_photos

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
    assert result["points"] > 200 and result["reprojection_error"] < 1
    # It moves sideways only, past a wall.
    assert any("focal length cannot be known" in warning for warning in result["warnings"])
    assert len(result["hypotheses"]) >= 2 and sum(each["chosen"] for each in result["hypotheses"]) == 1
    assert 1e8 < result["memory"] < 1e9
    stages = list(dict.fromkeys(stage for stage, _ in steps if stage != "Detecting features"))  # shown while it starts
    memory = next(stage for stage in stages if "GB of memory" in stage)
    assert stages == ["Preparing photos", memory, "Matching photos", "Placing cameras"]
    assert all(0 <= fraction <= 1 for _, fraction in steps)
    assert sorted(path.name for path in tmp_path.iterdir()) == [photos.name, "out"]
    assert "<h1>Cameras of out</h1>" in (out / "cameras.html").read_text(encoding="utf-8")

    scene = load_scene(out)
    assert [view.name for view in scene.views] == sorted(true)
    assert (out / "images" / "links" / "0.png").read_bytes() == (photos / "links" / "0.png").read_bytes()
    assert np.ptp(scene.points.colors.mean(0)) > 20  # colors of the photographs, not of the grey copies
    centres = np.stack([view.camera.centre for view in scene.views])
    wanted = np.stack([true[view.name] for view in scene.views])
    centres, wanted = centres - centres.mean(0), wanted - wanted.mean(0)
    centres *= np.linalg.norm(wanted) / np.linalg.norm(centres)
    u, _, vt = np.linalg.svd(wanted.T @ centres)
    assert np.abs(centres @ (u @ vt).T - wanted).max() < 0.1  # of a path 3 long; its focal length is free


def test_photos_that_do_not_connect_are_said_to_be_left_out(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "photos", np.linspace(-1.5, 0, 6))
    for index, x in enumerate(np.linspace(-1, 0, 4)):  # mirrored, they match no other photo
        (photos / f"mirrored_{index}.png").write_bytes(cv2.imencode(".png", render(x)[:, ::-1])[1].tobytes())
    result = reconstruct(photos, tmp_path / "out")
    assert result["registered"] == 6
    sentence = next(warning for warning in result["warnings"] if "groups" in warning)
    assert sentence == (
        "The photos fall into 2 groups without connection, and only the largest, of 6, is used. The others: 4 "
        "(mirrored_0.png, mirrored_1.png, mirrored_2.png ...). Photos between them would help."
    )
    assert "Only 6 of the 10 photos" in load_scene(tmp_path / "out").warnings[0]


def test_photos_from_one_place_leave_nothing_behind(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for index in range(4):  # turned about the camera's axis: no parallax
        turn = cv2.getRotationMatrix2D((160, 120), 10 * index, 1.0)
        picture = cv2.warpAffine(render(0), turn, (320, 240), borderMode=cv2.BORDER_REFLECT)
        (photos / f"{index}.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    with pytest.raises(InputError, match="cameras of these 4 photos cannot be found"):
        reconstruct(photos, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_photos_are_those_in_the_images_folder(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "dive" / "images", np.linspace(-0.5, 0.5, 4))
    write_photos(tmp_path / "dive" / "labels" / "coral", [0.0, 0.1])
    result = reconstruct(photos.parent, tmp_path / "out")
    assert result["images"] == 4 and (tmp_path / "out" / "images" / "0.png").exists()


@pytest.mark.skipif(not (shared / "data").is_dir(), reason="the shared example scenes are not here")
def test_a_real_sea_floor(tmp_path: Path) -> None:
    result = reconstruct(shared / "data" / "sparus_seabed" / "images", tmp_path / "out")
    assert result["registered"] == result["images"] == 22
    assert result["points"] > 931 and result["reprojection_error"] < 0.8  # 931: without equalised copies
