"""Wrong or damaged scenes: each is refused in one sentence that names the file, with nothing on standard error."""

import errno
import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from swag_engine.base.errors import InputError
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.sfm import photos
from swag_engine.sfm import reconstruct as sfm
from tests.scenes.dots import make_dot_scene


def sentence(work: Callable[[], object], *names: object) -> str:
    """Assert that `work` raises InputError with one sentence that contains all of `names`; return it."""
    with pytest.raises(InputError) as caught:
        work()
    message = str(caught.value)
    assert "\n" not in message and message.endswith(".") and message[0].isupper() | message.startswith("/"), message
    assert len(re.findall(r"[.!?](?=\s|$)", message)) == 1, message
    for name in names:
        assert str(name) in message, (name, message)
    return message


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make_dot_scene(tmp_path / "Tauchgang im Öresund", views=4)


def test_folders_without_a_scene(tmp_path: Path) -> None:
    sentence(lambda: load_scene(tmp_path / "nowhere"), tmp_path / "nowhere")
    (tmp_path / "file").write_text("x")
    sentence(lambda: load_scene(tmp_path / "file"), tmp_path / "file", "not a folder")
    (tmp_path / "empty").mkdir()
    sentence(lambda: load_scene(tmp_path / "empty"), tmp_path / "empty", "sfm")


def test_a_model_that_lacks_a_file(folder: Path) -> None:
    (folder / "sparse" / "0" / "points3D.bin").unlink()
    sentence(lambda: load_scene(folder), "points3D.bin", folder / "sparse" / "0")


@pytest.mark.parametrize("part", ["cameras", "images", "points3D", "rigs", "frames"])
def test_binary_files_cut_short_anywhere(folder: Path, part: str) -> None:
    file = folder / "sparse" / "0" / f"{part}.bin"
    data = file.read_bytes()
    for length in {0, 4, 8, 9, 16, len(data) // 3, len(data) // 2, len(data) - 8, len(data) - 1}:
        file.write_bytes(data[:length])
        sentence(lambda: load_scene(folder), file)
    file.write_bytes(data)
    load_scene(folder)


def test_binary_files_of_noise(folder: Path) -> None:
    random = np.random.default_rng(0)
    for part in ("cameras", "images", "points3D"):
        file = folder / "sparse" / "0" / f"{part}.bin"
        data = file.read_bytes()
        file.write_bytes(data[:8] + random.bytes(len(data) - 8))
        sentence(lambda: load_scene(folder), folder / "sparse" / "0")
        file.write_bytes(random.bytes(len(data)))
        sentence(lambda: load_scene(folder), folder / "sparse" / "0")
        file.write_bytes(data)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_text_files_cut_short_or_with_other_text(tmp_path: Path, part: str) -> None:
    folder = make_dot_scene(tmp_path, views=4, text=True)
    file = folder / "sparse" / "0" / f"{part}.txt"
    text = file.read_text()
    lines = text.splitlines(keepends=True)
    header = sum(line.startswith("#") for line in lines)
    each = 2 if part == "images" else 1
    for cut in (text[: len(text) * 2 // 3], "".join(lines[: len(lines) - each]), "".join(lines[:header])):
        file.write_text(cut)
        sentence(lambda: load_scene(folder), folder / "sparse" / "0")
    file.write_text("Dear diary, today we dived\nand saw a wreck\n")
    sentence(lambda: load_scene(folder), file)


def test_colmap_leaves_no_log_files(tmp_path: Path) -> None:
    code = "from swag_engine.scene.colmap_library import pycolmap; pycolmap.logging.error('seen')"
    environment = os.environ | {name: str(tmp_path) for name in ("TMPDIR", "TMP", "TEMP")}
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parents[2], env=environment, capture_output=True, text=True
    )
    assert ended.returncode == 0 and "seen" in ended.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("part", "named"), [("cameras", "cameras.bin"), ("frames", "sparse"), ("rigs", "sparse")])
def test_messages_of_colmap_are_kept_off_standard_error(folder: Path, part: str, named: str) -> None:
    file = folder / "sparse" / "0" / f"{part}.bin"
    file.write_bytes(bytes([part == "cameras"]) + bytes(7))  # cut short, or whole but empty
    code = f"from swag_engine.scene.colmap import load_scene; load_scene({str(folder)!r})"
    code = f"try:\n    {code}\nexcept Exception as error:\n    print(error)"
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"PYTHONIOENCODING": "utf-8"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, env=environment, capture_output=True, encoding="utf-8", check=False
    )
    assert done.stderr == "" and named in done.stdout and done.stdout.count("\n") == 1


@pytest.mark.parametrize("what", ["image", "feature", "other point", "none"])
def test_points_and_images_of_different_models(folder: Path, what: str) -> None:
    points, images = (folder / "sparse" / "0" / f"{part}.bin" for part in ("points3D", "images"))
    data = bytearray(points.read_bytes())
    first = 8 + 51  # the track of the first point: image, feature
    if what == "image":
        struct.pack_into("<I", data, first, 99)
    elif what == "feature":
        struct.pack_into("<I", data, first + 4, 1000)
    elif what == "other point":
        (feature,) = struct.unpack_from("<I", data, first + 4)
        struct.pack_into("<I", data, first + 4, feature + 1 if feature < 5 else feature - 1)
    else:
        head = images.read_bytes()
        features = head.index(b"\0", 8 + 64) + 1 + 8
        images.write_bytes(head[: features + 16] + b"\xff" * 8 + head[features + 24 :])
    points.write_bytes(data)
    sentence(lambda: load_scene(folder), folder / "sparse" / "0", "do not fit together")


def test_a_rig_without_the_pose_of_a_camera(tmp_path: Path) -> None:
    file = make_dot_scene(tmp_path, views=2, cameras_per_rig=2) / "sparse" / "0" / "rigs.bin"
    data = bytearray(file.read_bytes())
    data[8 + 8 + 8 + 8] = 0
    file.write_bytes(data)
    sentence(lambda: load_scene(tmp_path), tmp_path / "sparse" / "0", "do not fit together")


def test_a_model_without_points(folder: Path) -> None:
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    model.delete_all_points2D_and_points3D()
    model.write_binary(str(folder / "sparse" / "0"))
    sentence(lambda: load_scene(folder), folder / "sparse" / "0", "no points")


def test_missing_images(folder: Path) -> None:
    (folder / "images" / "view_02.png").unlink()
    scene = load_scene(folder)
    assert scene.missing == ("view_02.png",) and len(load_images(scene, scene.views)) == 3

    (folder / "images" / "view_01.png").unlink()
    (folder / "images" / "view_03.png").unlink()
    sentence(lambda: load_scene(folder), "view_01.png", folder / "images")
    shutil.rmtree(folder / "images")
    sentence(lambda: load_scene(folder), "view_01.png", folder)


def test_a_model_of_one_image(tmp_path: Path) -> None:
    make_dot_scene(tmp_path, views=1)
    sentence(lambda: load_scene(tmp_path), tmp_path / "sparse" / "0", "at least two")


@pytest.mark.parametrize("name", ["view_01.png", "view_01.jpg"])
@pytest.mark.parametrize("damage", ["empty", "cut", "text"])
def test_images_that_cannot_be_read(tmp_path: Path, name: str, damage: str) -> None:
    scene = load_scene(make_dot_scene(tmp_path, views=2, name=name.replace("01", "{:02d}")))
    path = tmp_path / "images" / name
    data = path.read_bytes()
    path.write_bytes({"empty": b"", "cut": data[: len(data) // 2], "text": b"Dear diary, today we dived"}[damage])
    sentence(lambda: load_images(scene, scene.views), path)


def test_an_image_that_is_removed_after_the_scene_was_read(folder: Path) -> None:
    scene = load_scene(folder)
    (folder / "images" / "view_03.png").unlink()
    sentence(lambda: load_images(scene, scene.views), "view_03.png")


def test_an_image_of_another_size_or_data_type(folder: Path) -> None:
    scene = load_scene(folder)
    path = folder / "images" / "view_01.png"
    path.write_bytes(cv2.imencode(".png", np.zeros((150, 150, 3), np.uint8))[1].tobytes())
    sentence(lambda: load_images(scene, scene.views), path, "150 x 150", "200 x 150")
    path.write_bytes(cv2.imencode(".tiff", np.full((150, 200, 3), np.nan, np.float32))[1].tobytes())
    sentence(lambda: load_images(scene, scene.views), path, "float32")


def test_cameras_that_cannot_be_undistorted(tmp_path: Path) -> None:
    globe = pycolmap.Camera(model="EQUIRECTANGULAR", width=200, height=100, params=[200.0, 100.0])
    make_dot_scene(tmp_path / "globe", globe, views=2)
    sentence(lambda: load_scene(tmp_path / "globe"), "EQUIRECTANGULAR")
    odd = make_dot_scene(tmp_path / "odd", text=True, views=2)
    cameras = odd / "sparse" / "0" / "cameras.txt"
    cameras.write_text("1 SIMPLE_RADIAL 200 150 0 100 75 0.1\n")
    sentence(lambda: load_scene(odd), "SIMPLE_RADIAL")


def test_image_names_in_another_encoding(folder: Path) -> None:
    file = folder / "sparse" / "0" / "images.bin"
    file.write_bytes(file.read_bytes().replace(b"view_01", b"view_\xfc1"))
    sentence(lambda: load_scene(folder), folder / "sparse" / "0", "UTF-8")


def left_over(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_sfm_without_usable_images(tmp_path: Path) -> None:
    out = tmp_path / "out"
    sentence(lambda: sfm.reconstruct(tmp_path / "nowhere", out), tmp_path / "nowhere")
    (tmp_path / "none").mkdir()
    sentence(lambda: sfm.reconstruct(tmp_path / "none", out), tmp_path / "none")
    (tmp_path / "film.mp4").write_bytes(b"Dear diary, today we filmed")
    sentence(lambda: sfm.reconstruct(tmp_path / "film.mp4", out), tmp_path / "film.mp4")
    (tmp_path / "one").mkdir()
    picture = cv2.imencode(".png", np.zeros((50, 50, 3), np.uint8))[1].tobytes()
    (tmp_path / "one" / "a.png").write_bytes(picture)
    sentence(lambda: sfm.reconstruct(tmp_path / "one", out), tmp_path / "one", "only one")
    (tmp_path / "one" / "b.png").write_bytes(picture[:40])
    sentence(lambda: sfm.reconstruct(tmp_path / "one", out), "b.png")
    assert left_over(tmp_path) == ["film.mp4", "none", "one"]


def test_sfm_of_images_without_features(tmp_path: Path) -> None:
    (tmp_path / "blue").mkdir()
    for index in range(3):
        cv2.imwrite(str(tmp_path / "blue" / f"{index}.png"), np.full((100, 100, 3), 90, np.uint8))
    sentence(lambda: sfm.reconstruct(tmp_path / "blue", tmp_path / "out"), "3 photos")
    assert left_over(tmp_path) == ["blue"]


def test_sfm_refuses_a_folder_that_is_not_empty(folder: Path, tmp_path: Path) -> None:
    before = left_over(folder)
    sentence(lambda: sfm.reconstruct(folder / "images", folder), folder, "not an empty folder")
    assert left_over(folder) == before


def test_sfm_on_a_full_disk_or_stopped_leaves_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = folder.parent / "out"

    def stop(stage: str, fraction: float) -> None:
        if stage.startswith("Detecting features"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sfm.reconstruct(folder / "images", out, stop)
    assert left_over(folder.parent) == [folder.name]

    def full(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))

    monkeypatch.setattr(photos.shutil, "copy2", full)
    sentence(lambda: sfm.reconstruct(folder / "images", out), "No space left")
    assert left_over(folder.parent) == [folder.name]
