import ast
import os
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from swag_engine.evidence.noise import YCC_TO_RGB
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.compression import change_by_compression, compression_variance, small_jpeg_note
from swag_engine.scene.images import _drop_stale, load_images, read_image
from swag_engine.scene.lenses import Lens
from tests.scenes.dots import draw_dots, make_dot_scene
from tests.scenes.rotation_flag import with_rotation_flag

# Every camera model of pycolmap that a pinhole picture can be made of, with distortion worth the name.
LENSES: dict[str, list[float]] = {
    "SIMPLE_PINHOLE": [300, 200, 150],
    "PINHOLE": [300, 310, 205, 148],
    "SIMPLE_RADIAL": [300, 200, 150, -0.25],
    "RADIAL": [300, 204, 151, 0.12, -0.03],
    "OPENCV": [300, 305, 198, 152, -0.2, 0.05, 0.002, -0.001],
    "FULL_OPENCV": [300, 300, 200, 150, -0.2, 0.05, 0.001, 0.001, 0.01, 0.02, 0.01, 0.0],
    "FOV": [300, 300, 200, 150, 0.9],
    "SIMPLE_FISHEYE": [180, 200, 150],
    "FISHEYE": [180, 182, 200, 150],
    "OPENCV_FISHEYE": [180, 180, 200, 150, 0.02, -0.01, 0.002, 0.0],
    "SIMPLE_RADIAL_FISHEYE": [180, 200, 150, 0.02],
    "RADIAL_FISHEYE": [180, 200, 150, 0.02, -0.005],
    "THIN_PRISM_FISHEYE": [180, 180, 200, 150, 0.02, -0.01, 0.001, 0.001, 0.0, 0.0, 0.001, -0.001],
    "RAD_TAN_THIN_PRISM_FISHEYE": [180, 180, 200, 150, 0.02, -0.01, 0, 0, 0, 0, 0.001, 0.001, 0.001, 0, 0.001, 0],
    "SIMPLE_DIVISION": [300, 200, 150, -0.15],
    "DIVISION": [300, 302, 200, 150, -0.15],
    "EUCM": [250, 250, 200, 150, 0.6, 1.1],
}


def lens_camera(model: str) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=400, height=300, params=[float(value) for value in LENSES[model]])


def test_every_camera_model_is_covered() -> None:
    known = {name for name in pycolmap.CameraModelId.__members__ if name not in ("INVALID", "EQUIRECTANGULAR")}
    assert known == set(LENSES)


@pytest.mark.parametrize("model", LENSES)
def test_dots_land_where_the_pinhole_camera_says(model: str, tmp_path: Path) -> None:
    scene = load_scene(make_dot_scene(tmp_path, lens_camera(model), views=2))
    view = scene.views[0]
    image = load_images(scene, [view])[0]
    assert image.pixels.shape == (image.camera.height, image.camera.width, 3)
    assert image.valid.mean() > 0.99

    points = scene.points.positions @ view.camera.world_to_camera[:3, :3].T + view.camera.world_to_camera[:3, 3]
    expected = points @ image.camera.K.T
    expected = expected[:, :2] / expected[:, 2:]
    reach = 6
    checked = 0
    light = image.pixels[..., 0].astype(float)
    light = np.where(light > 60, light, 0)
    for x, y in expected:
        column, row = int(x), int(y)
        if not (reach <= column < image.camera.width - reach and reach <= row < image.camera.height - reach):
            continue
        window = light[row - reach : row + reach + 1, column - reach : column + reach + 1]
        weights = window.sum()
        assert weights > 200, (model, x, y)
        centre_x = (window.sum(0) * (np.arange(2 * reach + 1) + column - reach + 0.5)).sum() / weights
        centre_y = (window.sum(1) * (np.arange(2 * reach + 1) + row - reach + 0.5)).sum() / weights
        assert np.hypot(centre_x - x, centre_y - y) < 0.5, (model, x, y)
        checked += 1
    assert checked > 25


def test_a_strong_fisheye_keeps_its_resolution_and_stays_within_sixty_degrees() -> None:
    lens = Lens("OPENCV_FISHEYE", 1000, 1000, (310.0, 310.0, 500.0, 500.0, 0.0, 0.0, 0.0, 0.0))
    pinhole = lens.pinhole  # the lens sees 92 degrees off its axis at the border
    assert pinhole.fx == pytest.approx(310, rel=1e-3)
    assert np.degrees(np.arctan(pinhole.cx / pinhole.fx)) == pytest.approx(60, abs=0.5)


def test_distortion_that_folds_over_within_the_picture_is_cut_or_masked(tmp_path: Path) -> None:
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=400, height=300, params=[220.0, 200.0, 150.0, -0.35])
    scene = load_scene(make_dot_scene(tmp_path, camera, views=2))
    image = load_images(scene, scene.views[:1])[0]
    u, v = np.meshgrid(np.arange(image.camera.width) + 0.5, np.arange(image.camera.height) + 0.5)
    radius = np.hypot(u - image.camera.cx, v - image.camera.cy) / image.camera.fx
    assert not image.valid[radius > 1 / np.sqrt(3 * 0.35) + 0.02].any()
    assert image.valid[radius < 0.6].all()


def test_images_are_reduced_but_never_enlarged(tmp_path: Path) -> None:
    scene = load_scene(make_dot_scene(tmp_path, views=2))
    small, full, more = (load_images(scene, scene.views[:1], width)[0] for width in (100, None, 4000))
    assert small.pixels.shape == (75, 100, 3) and small.camera.fx == pytest.approx(75)
    assert full.pixels.shape == more.pixels.shape == (150, 200, 3)
    area = full.pixels.astype(float).reshape(75, 2, 100, 2, 3).mean((1, 3))
    assert np.abs(small.pixels - area).max() <= 0.5


def rewrite(path: Path, picture: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())


def test_grey_sixteen_bit_and_alpha_pictures(tmp_path: Path) -> None:
    scene = load_scene(make_dot_scene(tmp_path, views=3))
    before = load_images(scene, scene.views)
    grey = before[0].pixels[..., 0]
    rewrite(scene.views[0].path, grey)
    rewrite(scene.views[1].path, before[1].pixels.astype(np.uint16) * 257)
    transparent = np.dstack([before[2].pixels, np.full(grey.shape, 255, np.uint8)])
    transparent[:50, :, 3] = 0
    rewrite(scene.views[2].path, transparent)
    after = load_images(scene, scene.views)
    for old, new in zip(before, after, strict=True):
        assert np.array_equal(old.pixels, new.pixels)
    assert after[0].valid.all() and after[1].valid.all()
    assert not after[2].valid[:50].any() and after[2].valid[50:].all()


@pytest.mark.parametrize("name", ["view_01.png.png", "view_01.png"])
def test_a_mask_makes_pixels_invalid(name: str, tmp_path: Path) -> None:
    scene = load_scene(make_dot_scene(tmp_path, lens_camera("SIMPLE_RADIAL"), views=2))
    mask = np.full((300, 400), 255, np.uint8)
    mask[:, :200] = 0
    (tmp_path / "masks").mkdir()
    rewrite(tmp_path / "masks" / name, mask)
    masked, whole = load_images(scene, scene.views, 200)
    middle = round(masked.camera.cx)
    assert not masked.valid[:, : middle - 2].any() and masked.valid[:, middle + 2 :].all() and whole.valid.all()
    assert load_scene(tmp_path).image_count == 2


@pytest.mark.parametrize("suffix", [".jpg", ".tif"])
def test_orientation_is_ignored_as_colmap_does_unless_only_the_turned_picture_fits(tmp_path: Path, suffix: str) -> None:
    stored = draw_dots(120, 80, np.array([[20.0, 10.0]]), sigma=5)
    path = tmp_path / f"turned{suffix}"
    path.write_bytes(with_rotation_flag(cv2.imencode(suffix, stored)[1].tobytes()))
    as_colmap = pycolmap.Bitmap.read(str(path), True).to_array()
    pixels, _ = read_image(path, (120, 80))
    assert pixels.shape == as_colmap.shape == (80, 120, 3) and pixels[10, 20, 0] > 200 and as_colmap[10, 20, 0] > 200
    turned, _ = read_image(path, (80, 120))
    assert turned.shape == (120, 80, 3) and turned[20, 69, 0] > 200  # 6: the top is at the right


def test_photographs_at_another_resolution_than_their_camera(tmp_path: Path) -> None:
    scene = load_scene(make_dot_scene(tmp_path, lens_camera("SIMPLE_RADIAL"), views=2))
    before = load_images(scene, scene.views, 100)[0]
    path = scene.views[0].path
    rewrite(path, cv2.resize(cv2.imread(str(path)), (200, 150), interpolation=cv2.INTER_AREA))
    after = load_images(scene, scene.views, 100)[0]
    full = load_images(scene, scene.views)[0]
    assert np.abs(after.pixels.astype(int) - before.pixels).mean() < 1
    assert full.camera.width == round(scene.views[0].camera.width / 2)  # no more than the file has


def test_the_cache_is_used_renewed_and_repaired(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SWAG_CACHE_DIR", str(tmp_path / "cache"))
    scene = load_scene(make_dot_scene(tmp_path / "scene", lens_camera("OPENCV"), views=2))
    steps: list[tuple[int, int]] = []
    first = load_images(scene, scene.views, 100, lambda done, total: steps.append((done, total)))
    assert steps == [(1, 2), (2, 2)]
    files = sorted((tmp_path / "cache").rglob("*.npz"))
    assert len(files) == 2

    written = [file.stat().st_ino for file in files]
    load_images(scene, scene.views, 100)
    assert [file.stat().st_ino for file in files] == written  # read, not made again

    for file in files:
        data = bytearray(file.read_bytes())
        data[len(data) // 2] ^= 255
        file.write_bytes(data[:-100] if file is files[0] else data)
    again = load_images(scene, scene.views, 100)
    for old, new in zip(first, again, strict=True):
        assert np.array_equal(old.pixels, new.pixels) and np.array_equal(old.valid, new.valid)

    black = np.zeros((300, 400, 3), np.uint8)
    rewrite(scene.views[0].path, black)
    assert load_images(scene, scene.views, 100)[0].pixels.max() == 0

    long_ago = scene.views[0].path.stat().st_mtime - 60 * 86400
    os.utime(files[0], (long_ago, long_ago))
    os.utime(files[1], (long_ago, long_ago))
    load_images(scene, scene.views, 50)
    assert files[0].exists(), "this process has looked at the cache"
    _drop_stale.cache_clear()
    load_images(scene, scene.views, 50)
    assert not files[0].exists() and not files[1].exists()


def test_cached_images_are_read_by_one_thread_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python 3.11 raises a SystemError when NumPy parses the headers of two arrays at once."""
    scene = load_scene(make_dot_scene(tmp_path, views=6))
    load_images(scene, scene.views, 100)
    parse = ast.literal_eval
    inside: list[Any] = []
    most: list[int] = []

    def slow_parse(text: Any) -> Any:
        inside.append(text)
        most.append(len(inside))
        time.sleep(0.01)
        inside.pop()
        return parse(text)

    monkeypatch.setattr(ast, "literal_eval", slow_parse)
    load_images(scene, scene.views, 100)
    assert len(most) == 12 and max(most) == 1


def test_an_unwritable_cache_only_costs_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("SWAG_CACHE_DIR", str(tmp_path / "file"))
    scene = load_scene(make_dot_scene(tmp_path / "scene", views=2))
    assert len(load_images(scene, scene.views)) == 2


@pytest.mark.parametrize(
    "written, width, said",
    [
        ({"subsampling": "4:2:0"}, 200, True),
        ({"subsampling": "4:2:2"}, 160, True),
        ({"subsampling": "4:4:4"}, 200, False),  # color at full size
        ({"subsampling": "4:2:0"}, 100, False),  # no more than the photo has of color
        ({"format": "PNG"}, 200, False),
    ],
)
def test_small_jpeg_photos_are_told_where_their_color_is_coarser_than_what_is_trained(
    written: dict[str, Any], width: int, said: bool, tmp_path: Path
) -> None:
    scene = load_scene(make_dot_scene(tmp_path, name="view_{:02d}.jpg"))
    for view in scene.views:
        Image.fromarray(read_image(view.path)[0]).save(view.path, **({"format": "JPEG"} | written))
    note = small_jpeg_note(scene, [view.camera.resized(width) for view in scene.views])
    assert (f"trained at {width} pixels" in note) == bool(note) == said


def detailed_photo() -> np.ndarray:
    """A photo (480, 640, 3) uint8 with details of all sizes, less contrast in smaller ones and in colors."""
    random = np.random.default_rng(0)
    waves = np.hypot(*np.meshgrid(np.fft.fftfreq(640), np.fft.fftfreq(480)))
    spectra = np.fft.fft2(random.normal(size=(3, 480, 640))) / (waves + 0.01)
    brightness, blue, red = np.fft.ifft2(spectra).real
    display = 128 + np.stack([brightness + red, brightness - red - blue, brightness + blue], -1)
    return display.round().clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("subsampling", ["4:2:0", "4:4:4"])
@pytest.mark.parametrize("quality", [85, 90, 95])
@pytest.mark.parametrize("width", [640, 320, 160])
def test_what_compression_changes_is_estimated_from_the_file(
    subsampling: str, quality: int, width: int, tmp_path: Path
) -> None:
    photo = detailed_photo()
    Image.fromarray(photo).save(tmp_path / "a.jpg", quality=quality, subsampling=subsampling)
    size = (width, width * 3 // 4)
    exact, stored = (
        cv2.resize(pixels / 255, size, interpolation=cv2.INTER_AREA)
        for pixels in (photo.astype(float), np.asarray(Image.open(tmp_path / "a.jpg"), float))
    )
    change = np.square((stored - exact) @ np.linalg.inv(YCC_TO_RGB).T).mean((0, 1))
    estimate = compression_variance(tmp_path / "a.jpg", width)
    assert (estimate > 0.1 * change).all() and (estimate < 10 * change).all()


@pytest.mark.parametrize("written", [{"subsampling": "4:2:0"}, {"subsampling": "4:4:4"}, {"mode": "L"}])
def test_an_image_that_is_compressed_as_a_photo_was_changes_as_the_photo_did(
    written: dict[str, str], tmp_path: Path
) -> None:
    photo, path = Image.fromarray(detailed_photo()), tmp_path / "a.jpg"
    photo = photo.convert(written.pop("mode", "RGB"))
    photo.save(path, quality=85, **written)
    exact, stored = (np.asarray(image.convert("RGB")) / np.float32(255) for image in (photo, Image.open(path)))
    assert np.abs(stored - exact).max() > 0.03
    np.testing.assert_allclose(change_by_compression(path, exact), stored - exact, atol=1e-6)
    half = cv2.resize(exact, (400, 300), interpolation=cv2.INTER_AREA)
    assert change_by_compression(path, half).any()
    assert not change_by_compression(path, half[::2, ::2]).any()


def test_an_image_changes_by_no_compression_where_the_photo_was_not_compressed(tmp_path: Path) -> None:
    photo = detailed_photo()
    Image.fromarray(photo).save(tmp_path / "a.png")
    (tmp_path / "damaged.jpg").write_bytes(b"\xff\xd8\xff\xe0 not a photo")
    for name in ("a.png", "damaged.jpg", "missing.jpg"):
        assert not change_by_compression(tmp_path / name, photo / np.float32(255)).any(), name


def test_files_without_rounded_details_have_no_noise_of_compression(tmp_path: Path) -> None:
    photo = Image.fromarray(detailed_photo())
    photo.save(tmp_path / "a.png")
    (tmp_path / "damaged.jpg").write_bytes(b"\xff\xd8\xff\xe0 not a photo")
    for name in ("a.png", "damaged.jpg", "missing.jpg"):
        assert not compression_variance(tmp_path / name, 320).any(), name
    photo.convert("L").save(tmp_path / "grey.jpg", quality=90)
    photo.save(tmp_path / "color.jpg", quality=90)
    grey, color = (compression_variance(tmp_path / name, 320) for name in ("grey.jpg", "color.jpg"))
    assert grey[0] == color[0] > 0 and not grey[1:].any() and color[1] > color[0]
