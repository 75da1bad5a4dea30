import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.colmap_library import pycolmap
from swag_engine.scene.image_files import find_masks, image_files_below
from swag_engine.scene.images import read_mask
from swag_engine.scene.inspect import describe, inspect_scene
from swag_engine.settings.settings import TrainSettings
from swag_engine.sfm.features import ImageData, extract_features
from swag_engine.sfm.photos import copy_name, copy_photos
from swag_engine.training.inputs import load_inputs
from swag_engine.training.schedule import STANDARD
from tests.scenes.dots import make_dot_scene
from tests.scenes.rotation_flag import with_rotation_flag

RIGHT = np.repeat([[0] * 80 + [255] * 80], 120, 0).astype(np.uint8)
"""Mask (120, 160) of the left half."""


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix.lower(), image)[1].tobytes())


@pytest.mark.parametrize(
    ("photos", "mask", "masked"),
    [
        ("a.JPG b.jpg", "masks/a.PNG", "a.JPG"),
        ("a.jpg b.jpg", "Masks/a.jpg.tif", "a.jpg"),
        ("a.jpg b.jpg", "mask/A_Mask.jpeg", "a.jpg"),
        ("a.jpg b.jpg", "images/masks/a.mask.png", "a.jpg"),
        ("a.jpg b.jpg", "images/a_mask.png", "a.jpg"),
        ("c/a.jpg d/a.jpg", "image_masks/c/a.png", "c/a.jpg"),
        ("c/a.jpg d/a.jpg", "images/c/masks/a.png", "c/a.jpg"),
        ("c/a.jpg d/b.jpg", "masks/a.png", "c/a.jpg"),
        ("c/a.jpg d/a.jpg", "masks/a.png", None),
        ("a.jpg c/a.jpg", "masks/a.png", "a.jpg"),
        ("a.jpg a.png", "masks/a.png", None),
        ("a.jpg a.png", "masks/a.png.png", "a.png"),
        ("b_mask.jpg c.jpg", "masks/b_mask.png", "b_mask.jpg"),
        ("a.jpg b.jpg", "masks/old_a.png", None),
    ],
)
def test_a_mask_belongs_to_the_photo_that_its_name_fits(
    photos: str, mask: str, masked: str | None, tmp_path: Path
) -> None:
    root, path = tmp_path / "images", tmp_path / mask
    for file in (*(root / photo for photo in photos.split()), path):
        write(file, RIGHT)
    files = image_files_below(root)
    found = find_masks(files, root)
    assert len(files) == 2 and found.of == ({root / masked: path} if masked else {})
    assert found.unused == (() if masked else (path,)) and bool(found.warnings()) is (masked is None)


def rgba(color: int) -> np.ndarray:
    return np.dstack([np.full((120, 160, 3), color, np.uint8), RIGHT])


@pytest.mark.parametrize(
    "values",
    [RIGHT // 255, RIGHT[::2, ::2], RIGHT // 255 * np.uint16(1), RIGHT * np.uint16(257), rgba(0), rgba(255),
     np.maximum(RIGHT, 6), np.dstack([RIGHT, RIGHT // 2, 0 * RIGHT]), np.dstack([RIGHT] * 3 + [0 * RIGHT + 255])],
)  # fmt: skip
def test_masks_of_any_type(values: np.ndarray, tmp_path: Path) -> None:
    write(tmp_path / "mask.png", values)
    assert np.array_equal(read_mask(tmp_path / "mask.png", tmp_path / "a.jpg", (160, 120)), RIGHT > 0)
    write(tmp_path / "mask.png", 0 * rgba(0) + np.array([0, 0, 0, 255], np.uint8))
    assert not read_mask(tmp_path / "mask.png", tmp_path / "a.jpg", (160, 120)).any()


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_a_mask_is_turned_with_its_photo(orientation: int, tmp_path: Path) -> None:
    drawn = np.zeros((120, 160), np.uint8)
    drawn[:32, :96] = 255
    photo, stored, shown = tmp_path / "a.jpg", tmp_path / "stored.png", tmp_path / "shown.png"
    photo.write_bytes(with_rotation_flag(cv2.imencode(".jpg", drawn)[1].tobytes(), orientation))
    turned = cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE)
    write(stored, drawn)
    write(shown, turned)
    for path in (stored, shown):
        assert np.array_equal(read_mask(path, photo, (160, 120)), drawn > 128)
        assert np.array_equal(read_mask(path, photo, (120, 160)), turned > 128)
    write(photo, drawn)
    with pytest.raises(InputError, match="shown.png is 120 x 160 pixels, .* 160 x 120"):
        read_mask(shown, photo, (160, 120))


def test_masks_are_counted_and_photos_without_a_valid_pixel_left_out(tmp_path: Path) -> None:
    scene = load_scene(make_dot_scene(tmp_path, views=8))
    black, masks = np.zeros((150, 200), np.uint8), tmp_path / "masks"
    empty = [names[0] for names in (scene.split.train, scene.split.validation, scene.split.test)]
    for name in (*empty, "old.png"):
        write(masks / name, black)
    write(masks / scene.split.train[1], black + 255)
    summary = inspect_scene(load_scene(tmp_path))
    assert "Masks:       for 4 of 8 photos" in describe(summary)
    assert any("fit no photo, not used (1): masks/old.png." in warning for warning in summary["warnings"])
    settings = replace(TrainSettings(), width=100, backend="cpu")
    inputs = load_inputs(load_scene(tmp_path), settings, STANDARD, lambda event: None)
    assert (len(inputs.training), len(inputs.validation), len(inputs.test)) == (5, 0, 0)
    assert inputs.notes[0] == "Masks for 4 of 8 photos." and "masks/old.png" in inputs.notes[1]
    assert "3 of 8 photos are left out" in inputs.notes[2] and all(name in inputs.notes[2] for name in empty)
    for view in scene.views:
        write(masks / view.name, black)
    with pytest.raises(InputError, match="No photo is left to train on. 8 of 8 photos are left out.* black"):
        load_inputs(load_scene(tmp_path), settings, STANDARD, lambda event: None)


def test_structure_from_motion_copies_masks_and_looks_for_features_outside_them(tmp_path: Path) -> None:
    dive, random = tmp_path / "dive", np.random.default_rng(0)
    for name in "abc":
        write(dive / "images" / f"{name}.png", cv2.resize(random.integers(0, 255, (40, 53), np.uint8), (160, 120)))
    for name, mask in (("a", RIGHT), ("c", 0 * RIGHT), ("old", RIGHT)):
        write(dive / "masks" / f"{name}.png", mask)
    images, pictures = tmp_path / "scene" / "images", tmp_path / "pictures"
    images.mkdir(parents=True)
    pictures.mkdir()
    chosen = copy_photos(dive / "images", images, pictures, lambda stage, fraction: None)
    assert chosen.names == ["a.png", "b.png"] and "masks/old.png" in chosen.warnings[0]
    assert "1 photo (c.png) whose mask leaves no valid pixel" in chosen.warnings[1]
    assert list(find_masks(image_files_below(images), images).of) == [images / "a.png"]
    extract_features(tmp_path / "database.db", pictures, [ImageData(160, 120, None, (np.nan, np.nan), 0.0)] * 2)
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        left = {image.name: database.read_keypoints(image.image_id)[:, 0].min() for image in database.read_all_images()}
    assert left[copy_name(0)] >= 80 and left[copy_name(1)] < 20
    (dive / "masks" / "a.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="a.png cannot be read as an image"):
        copy_photos(dive, images, pictures, lambda stage, fraction: None)


def test_masks_that_are_not_used_are_said(tiny_scene: Path, tmp_path: Path) -> None:
    """Two masks of one photo, and masks as GIF and numpy files."""
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    for path in ("masks/view_00.png", "mask/view_00.png", "masks/view_01.gif", "masks/view_02.npy"):
        (scene / path).parent.mkdir(exist_ok=True)
        write(scene / "white.png", np.full((48, 64), 255, np.uint8))
        (scene / "white.png").replace(scene / path)
    first, second = load_scene(scene).masks.warnings()
    assert first.startswith("Photos with more than one mask; not used (1): mask")
    assert "(2): masks/view_01.gif, masks/view_02.npy" in second
