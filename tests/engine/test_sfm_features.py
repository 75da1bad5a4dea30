from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from swag_engine.scene.colmap_library import pycolmap
from swag_engine.sfm.features import ImageData, camera_groups, estimate_memory, extract_features
from swag_engine.sfm.photos import copy_name, write_jpeg

NOWHERE = (float("nan"), float("nan"))


def test_size_focal_length_and_position_are_read(tmp_path: Path) -> None:
    picture = Image.new("RGB", (400, 300))
    exif = picture.getexif()
    exif.get_ifd(0x8769)[0xA405] = 28  # focal length of a 35 mm camera
    exif.get_ifd(0x8825).update({1: "S", 2: (55.0, 30.0, 0.0), 3: "E", 4: (12.0, 15.0, 0.0)})
    picture.save(tmp_path / "a.jpg", exif=exif)
    data = ImageData.read(tmp_path / "a.jpg")
    assert (data.width, data.height, data.position) == (400, 300, (-55.5, 12.25))
    assert data.focal_length is not None and abs(data.focal_length - 28 / 43.27 * 500) < 1


def test_an_image_without_exif(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", np.zeros((30, 40, 3), np.uint8))[1].tobytes())
    data = ImageData.read(tmp_path / "a.png")
    assert (data.width, data.height, data.focal_length) == (40, 30, None) and np.isnan(data.position).all()


def test_photos_of_one_size_and_zoom_share_a_camera() -> None:
    sizes = [(400, 300, 500.0), (300, 400, 500.0), (400, 300, 500.0), (400, 300, None), (400, 300, 800.0)]
    images = [ImageData(width, height, focal, NOWHERE, 0.0) for width, height, focal in sizes]
    assert camera_groups(images) == [[0, 2], [1], [3], [4]]


def test_memory_grows_with_the_number_and_the_size_of_photos() -> None:
    small, large = (ImageData(width, width, None, NOWHERE, 0.0) for width in (300, 2000))
    assert estimate_memory([small] * 1000) > 5 * estimate_memory([small] * 100) > 5e8
    assert estimate_memory([large] * 2) > estimate_memory([small] * 2)


def test_ids_of_images_are_in_their_order_whichever_thread_is_faster(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    for number in range(4):
        grey = np.full((240, 320), 128, np.uint8)
        if number in (0, 2):  # takes longer than the empty ones
            grey = cv2.resize(random.integers(0, 255, (80, 107), np.uint8), (320, 240))
        write_jpeg(tmp_path / copy_name(number), grey)
    extract_features(tmp_path / "database.db", tmp_path, [ImageData(320, 240, None, NOWHERE, 0.0)] * 4)
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        assert [database.read_image(number + 1).name for number in range(4)] == [copy_name(n) for n in range(4)]
        assert database.read_keypoints(1).shape[0] > 100 and database.num_cameras() == 1
