"""Photos that cannot be used, among good ones and alone: one sentence each, and the rest goes on."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images, read_image
from swag_engine.sfm import photos, reconstruct
from tests.scenes.panels import SIZE, render, write_photos
from tests.scenes.rotation_flag import with_rotation_flag


def write(path: Path, image: np.ndarray, *options: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, image, options)[1].tobytes())
    return path


def water(seed: int = 0, particles: int = 20) -> np.ndarray:
    """Open water: brighter above, with the noise of a camera and some particles."""
    random = np.random.default_rng(seed)
    light = np.linspace(1.2, 0.7, 480)[:, None, None] * [95.0, 80.0, 15.0] * np.ones((480, 640, 1))
    for x, y in random.integers(0, 480, (particles, 2)):
        cv2.circle(light, (int(x), int(y)), 1, (150, 150, 120), -1)
    return np.clip(light + random.normal(0, 2, light.shape), 0, 255).astype(np.uint8)


def choose(folder: Path, tmp_path: Path) -> photos.ChosenImages:
    for name in ("images", "pictures"):
        (tmp_path / name).mkdir()
    chosen = photos.copy_photos(folder, tmp_path / "images", tmp_path / "pictures", lambda stage, fraction: None)
    assert len(list((tmp_path / "pictures").iterdir())) == len(chosen.names)
    found = [path.relative_to(tmp_path / "images").as_posix() for path in (tmp_path / "images").rglob("*.*")]
    assert sorted(found) == sorted(chosen.names)
    return chosen


def left_out(result: dict[str, Any]) -> list[str]:
    return [warning for warning in result["warnings"] if warning.startswith("Left out")]


def refused(folder: Path, tmp_path: Path) -> str:
    with pytest.raises(InputError) as error:
        reconstruct.reconstruct(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".out*"))
    assert "\n" not in str(error.value) and str(folder) in str(error.value)
    return str(error.value)


def test_a_folder_of_everything(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "dive", np.linspace(-1, 1, 6))
    names = [f"{number}.png" for number in range(6)]
    whole = (folder / "0.png").read_bytes()
    (folder / "cut.png").write_bytes(whole[: len(whole) // 2])
    (folder / "empty.jpg").touch()
    (folder / "text.jpg").write_text("Dear diary")
    (folder / "gone.jpg").symlink_to(tmp_path / "nowhere.jpg")
    write(folder / "float.tif", render(0.9).astype(np.float32))
    for number in range(2):
        write(folder / f"blue_{number}.jpg", water(number))
    write(folder / "cap.jpg", np.zeros((240, 320, 3), np.uint8))
    (folder / "copy of 3.png").write_bytes((folder / "3.png").read_bytes())
    for raw in ("a.CR2", "b.heic", "3.arw"):  # of 3.png there is a photo that can be read
        (folder / raw).write_bytes(b"raw")
    result = reconstruct.reconstruct(folder, tmp_path / "out")
    assert result["images"] == result["registered"] == 6
    assert left_out(result) == [
        "Left out: 5 photos (cut.png, empty.jpg, float.tif ...) that cannot be read; copy or save again with 8 or 16 "
        "bits per channel.",
        "Left out: 3 photos (blue_0.jpg, blue_1.jpg, cap.jpg) without structure, as of open water or in darkness.",
        "Left out: 1 photo (copy of 3.png) of the same picture as another one.",
        "Left out: 2 photos (a.CR2, b.heic) of a type that cannot be read; save as JPEG or TIFF.",
    ]
    scene = load_scene(tmp_path / "out")
    assert [view.name for view in scene.views] == names and not scene.warnings
    assert all((tmp_path / "out" / "images" / name).read_bytes() == (folder / name).read_bytes() for name in names)


def test_copies_are_taken_once_and_the_largest_is_kept(tmp_path: Path) -> None:
    folder = tmp_path / "dive"
    for x in (-0.5, 0, 0.5):
        image = cv2.resize(render(x), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        write(folder / f"photo {x}.jpg", image, cv2.IMWRITE_JPEG_QUALITY, 95)
        write(folder / "Thumbnails" / f"photo {x}.jpg", cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA))
    write(folder / "mail.jpg", image, cv2.IMWRITE_JPEG_QUALITY, 60)
    chosen = choose(folder, tmp_path)
    assert chosen.names == ["photo -0.5.jpg", "photo 0.5.jpg", "photo 0.jpg"]
    (warning,) = chosen.warnings
    assert warning.startswith("Left out: 4 photos (Thumbnails/photo -0.5.jpg, Thumbnails/photo 0.5.jpg, ")


def test_photos_from_nearby_places_are_no_copies(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "dive", np.linspace(0, 0.1, 5))  # 0.4 % of the width apart
    assert choose(folder, tmp_path).warnings == []


@pytest.mark.parametrize("particles", [0, 40])
def test_faint_structure_is_structure_and_water_is_none(particles: int) -> None:
    grey = cv2.cvtColor(render(0), cv2.COLOR_BGR2GRAY)
    assert photos.has_structure((0.25 * grey.astype(float) + 60).astype(np.uint8))
    assert not photos.has_structure(cv2.cvtColor(water(particles=particles), cv2.COLOR_BGR2GRAY))


def test_ten_copies_of_one_photo(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "copies", [0] * 10)
    message = refused(folder, tmp_path)
    assert (
        "only one of the 10 photos" in message and "9 photos (1.png, 2.png, 3.png ...) of the same picture" in message
    )


def test_water_alone(tmp_path: Path) -> None:
    for number in range(5):
        write(tmp_path / "blue" / f"{number}.jpg", water(number))
    message = refused(tmp_path / "blue", tmp_path)
    assert "none of the 5 photos" in message and "without structure, as of open water" in message


@pytest.mark.parametrize(
    ("names", "finding"),
    [
        (
            ["DSC_1.NEF", "DSC_2.NEF"],
            r"2 photos (DSC_1.NEF, DSC_2.NEF) of types that cannot be read: save them as JPEG",
        ),
        (["IMG_1.HEIC", "IMG_1.MOV"], "1 photo (IMG_1.HEIC) of types that cannot be read: save them as JPEG"),
        (["GX01.MP4", "GX02.MP4"], "but videos: choose one of them, such as GX01.MP4"),
    ],
)
def test_folders_of_other_files(tmp_path: Path, names: list[str], finding: str) -> None:
    (tmp_path / "card").mkdir()
    for name in names:
        (tmp_path / "card" / name).touch()
    assert finding in refused(tmp_path / "card", tmp_path)


def test_photos_with_a_rotation_flag_are_used_as_they_are_stored(tmp_path: Path) -> None:
    """COLMAP, training and Blender's camera see the same pixels (Blender ignores the flag, too)."""
    folder = tmp_path / "dive"
    stored = {}
    for number, x in enumerate(np.linspace(-0.6, 0.6, 5)):
        path = write(folder / f"{number}{('.jpg', '.tif')[number % 2]}", render(x))
        stored[path.name] = read_image(path)[0]
        path.write_bytes(with_rotation_flag(path.read_bytes()))
        assert cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR).shape == (
            SIZE[0],
            SIZE[1],
            3,
        )  # a program that follows the flag
    result = reconstruct.reconstruct(folder, tmp_path / "out")
    assert result["registered"] == 5
    scene = load_scene(tmp_path / "out")
    for view, image in zip(scene.views, load_images(scene, scene.views), strict=True):
        assert (view.lens.width, view.lens.height) == SIZE
        # In coarse pictures, because five photos of a wall hardly determine the distortion that was removed.
        shown, kept = (
            cv2.resize(pixels, (12, 9), interpolation=cv2.INTER_AREA).astype(float)
            for pixels in (image.pixels, stored[view.name])
        )
        assert np.abs(shown - kept).mean() < 0.5 * np.abs(shown[::-1, ::-1] - kept).mean()


def test_other_formats_of_photos(tmp_path: Path) -> None:
    """WebP, which COLMAP does not read, becomes PNG; 16 bits, grey and alpha stay as they are."""
    folder = tmp_path / "dive"
    images = [render(x) for x in np.linspace(-0.8, 0.8, 6)]
    write(folder / "0.webp", images[0], cv2.IMWRITE_WEBP_QUALITY, 101)
    write(folder / "1.tif", images[1].astype(np.uint16) * 257)
    write(folder / "2.png", np.dstack([images[2], np.full(images[2].shape[:2], 255, np.uint8)]))
    write(folder / "3.png", cv2.cvtColor(images[3], cv2.COLOR_BGR2GRAY))
    write(folder / "4.bmp", images[4])
    write(folder / "5.jpeg", images[5])
    result = reconstruct.reconstruct(folder, tmp_path / "out")
    assert result["registered"] == 6 and left_out(result) == []
    assert (read_image(tmp_path / "out" / "images" / "0.webp.png")[0] == images[0][..., ::-1]).all()


def test_landscape_portrait_and_a_second_zoom(tmp_path: Path) -> None:
    folder = tmp_path / "dive"
    for number, x in enumerate(np.linspace(-0.6, 0.6, 4)):
        write(folder / f"wide_{number}.png", render(x))
    for number, x in enumerate(np.linspace(-0.6, 0.6, 3)):
        write(folder / f"upright_{number}.png", cv2.rotate(render(x), cv2.ROTATE_90_CLOCKWISE))
    for number, x in enumerate(np.linspace(-0.6, 0.6, 3)):  # another lens, told apart by the size of its photos
        write(folder / f"tele_{number}.png", cv2.resize(render(x, zoom=1.4), (400, 300), interpolation=cv2.INTER_CUBIC))
    result = reconstruct.reconstruct(folder, tmp_path / "out")
    assert result["registered"] == 10 and left_out(result) == []
    focal = {(view.lens.width, view.lens.height): view.lens.params[0] for view in load_scene(tmp_path / "out").views}
    assert set(focal) == {(320, 240), (240, 320), (400, 300)}
    zoom = focal[400, 300] / 400 / (focal[320, 240] / 320)
    assert 1.25 < zoom < 1.55 or any("focal length cannot be known" in warning for warning in result["warnings"])


def test_stopped_while_photos_are_prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_photos(tmp_path / "dive", [0, 0.2, 0.4])
    monkeypatch.setattr(reconstruct, "find_matches", lambda *arguments: pytest.fail("photos come first"))

    def stop(stage: str, fraction: float) -> None:
        if fraction > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct.reconstruct(folder, tmp_path / "out", stop)
    assert [path.name for path in tmp_path.iterdir()] == ["dive"]
