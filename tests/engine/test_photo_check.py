"""Heights that the photos of a run agree with, and those that they do not."""

import shutil

import cv2
import numpy as np
import pytest

from swag_engine.formats.run_folder import RunFolder
from swag_engine.products.change_maps import Comparison, Survey
from swag_engine.products.grid import MapGrid
from swag_engine.products.map_frame import MapScene
from swag_engine.products.photo_check import SurveyPhotos
from swag_engine.products.tiles import tiles_of
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.development import NO_DEVELOPMENT
from tests.scenes.flat_splats import sheet
from tests.scenes.make_scene import write_model

GRID = MapGrid(-0.5, 0.5, 0.01, 100, 100)
BOX = (slice(40, 60), slice(50, 70))
"""Rows and columns of a box that stands on the ground, BOX_HEIGHT high, in one of the two surveys."""
BOX_HEIGHT, WRONG = 0.06, 0.06
"""Metres, which are six pixels."""
FOCAL, WIDTH, HEIGHT = 200.0, 240, 180


def survey(folder, with_box, texture=1.0):
    """Photos of level ground from 2 m above, and a run of them; returns the photos in the frame of the map."""
    random = np.random.default_rng(3)
    ground = cv2.GaussianBlur(random.standard_normal((400, 400)), (0, 0), 1.5)
    ground = np.clip(120 + 200 * texture * ground, 0, 255).astype(np.float32)
    names, poses, photos, ranges = [], [], [], []
    # Every eighth photo is a test view.
    for number, (x, y) in enumerate(np.array([(i, j) for i in (-0.5, 0, 0.5) for j in (-0.5, 0, 0.5)])):
        pose = np.diag([1.0, -1, -1, 1])
        pose[:3, 3] = -pose[:3, :3] @ (x, y, 2)
        u, v = np.meshgrid((np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL, (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL)
        photo, height = seen_at(ground, x + 2 * u, y - 2 * v), np.zeros_like(u)
        if with_box:
            near = 2 - BOX_HEIGHT
            column, row = (x + near * u - GRID.left) / GRID.pixel, (GRID.top - y + near * v) / GRID.pixel
            top = (row >= BOX[0].start) & (row < BOX[0].stop) & (column >= BOX[1].start) & (column < BOX[1].stop)
            photo = np.where(top, seen_at(ground, x + near * u, y - near * v), photo)
            height = np.where(top, BOX_HEIGHT, 0)
        noisy = (photo + random.normal(0, 3, photo.shape)).clip(0, 255).astype(np.uint8)
        names.append(f"{number}.png")
        poses.append(pose)
        photos.append(np.repeat(noisy[..., None], 3, axis=2))
        ranges.append((2 - height) * np.sqrt(1 + u**2 + v**2))
    images = folder / "scene" / "images"
    images.mkdir(parents=True)
    for name, photo in zip(names, photos, strict=True):
        cv2.imwrite(str(images / name), photo)
    write_model(folder / "scene" / "sparse" / "0", names, poses, FOCAL, photos, ranges, 300, random)
    run = RunFolder(folder / "run")
    run.path.mkdir()
    run.write_config(folder / "scene", TrainSettings(width=WIDTH), [0, 0, 1])
    splats = sheet(-0.5, -0.5, 0.5, 0.5, 0.1)
    return MapScene(splats, "m", None, None, False, NO_DEVELOPMENT, np.eye(4), run=run.path)


def seen_at(ground, x, y):
    """Grey values of the ground, 2 m wide, at places in metres."""
    column, row = ((x + 2) * 100 - 0.5).astype(np.float32), ((2 - y) * 100 - 0.5).astype(np.float32)
    return cv2.remap(ground, column, row, cv2.INTER_CUBIC)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    return {
        "ground": survey(folder / "ground", False),
        "box": survey(folder / "box", True),
        "plain": survey(folder / "plain", False, texture=0.0),
    }


def changes(scenes, before_height, after_height, layers=0.0, labelled=0):
    """Compare two surveys with photos, with these heights in the box and level ground elsewhere.

    Their splats lie in layers so far apart. A square of the box with so many pixels a side has another label later.
    """
    random = np.random.default_rng(0)
    surveys = []
    for height, label in ((before_height, 1), (after_height, 2)):
        heights = 0.001 * random.standard_normal((100, 100)).astype(np.float32)
        heights[BOX] += height
        errors, apart = np.ones_like(heights), np.full_like(heights, layers)
        labels = np.ones_like(heights, np.uint8)
        labels[42 : 42 + labelled, 52 : 52 + labelled] = label
        surveys.append(Survey(np.full((100, 100, 3), 128, np.uint8), heights, errors, apart, labels))
    comparison = Comparison(
        surveys[0], surveys[1], GRID, 0.001, tuple(scene and SurveyPhotos.of(scene) for scene in scenes)
    )
    flags, numbers = np.zeros((100, 100), np.uint8), np.zeros((100, 100), np.int32)
    (tile,) = tiles_of(GRID)
    found = comparison.find_objects(comparison.told(tile, comparison.differences(tile)), flags, numbers)
    assert sum(item["pixels"] for item in found) == np.count_nonzero(flags)
    return [item["change"] for item in found], comparison.errors_found, np.count_nonzero(flags)


def test_a_height_that_no_photo_shows_is_no_change(scenes):
    """The photos of both surveys show level ground; one of the surveys is wrong."""
    ground = scenes["ground"]
    assert changes((ground, ground), 0.0, WRONG)[:2] == ([], 1)
    assert changes((ground, ground), -WRONG, 0.0)[:2] == ([], 1)
    assert changes((None, ground), 0.0, WRONG)[:2] == ([], 1)
    assert changes((None, None), 0.0, WRONG)[:2] == (["higher"], 0)


def test_a_height_that_the_photos_show_is_a_change(scenes):
    assert changes((scenes["ground"], scenes["box"]), 0.0, BOX_HEIGHT)[:2] == (["higher"], 0)
    assert changes((scenes["box"], scenes["ground"]), BOX_HEIGHT, 0.0)[:2] == (["lower"], 0)


def test_small_changes_are_told_where_photos_confirm_them(scenes):
    """Splats in layers 10 cm apart leave heights uncertain by more than the box is high."""
    ground, box, plain = (scenes[name] for name in ("ground", "box", "plain"))
    assert changes((ground, box), 0.0, BOX_HEIGHT, layers=0.1)[:2] == (["higher"], 0)
    for unsure in ((None, None), (ground, None), (None, box), (plain, plain), (ground, plain)):
        assert changes(unsure, 0.0, BOX_HEIGHT, layers=0.1)[:2] == ([], 0)


def test_what_photos_cannot_check_is_told_as_without_photos(scenes):
    """A step with a slope beside it, of which more is told where photos confirm it."""
    ramp = np.tile(np.linspace(0, 0.2, 20), (20, 1))
    counts = [
        changes(photos, 0.0, ramp, layers=0.05)[2]
        for photos in ((None, None), (scenes["plain"], scenes["plain"]), (scenes["ground"], scenes["plain"]))
    ]
    assert counts[0] == counts[1] == counts[2] > 20


def test_small_changes_of_labels_need_surfaces_that_photos_show(scenes):
    """At heights that are wrong alike in both surveys, labels may be those of what lies behind."""
    ground = scenes["ground"]
    for height, side, told in ((0.0, 6, True), (-WRONG, 6, False), (-WRONG, 12, True)):
        assert changes((ground, ground), height, height, labelled=side)[0] == ["label"] * told, (height, side)
    assert changes((None, None), -WRONG, -WRONG, labelled=6)[0] == ["label"]


def test_photos_that_cannot_tell_leave_changes_as_they_are(scenes, tmp_path):
    """Photos without a pattern, and photos that are gone."""
    assert changes((scenes["plain"], scenes["plain"]), 0.0, WRONG)[:2] == (["higher"], 0)
    gone = survey(tmp_path, False)
    shutil.rmtree(tmp_path / "scene" / "images")
    assert changes((None, gone), 0.0, WRONG)[:2] == (["higher"], 0)
    shutil.rmtree(tmp_path / "scene")
    assert SurveyPhotos.of(gone) is None


@pytest.mark.parametrize("finer", [0.25, 4.0])
def test_the_map_may_be_finer_or_coarser_than_the_photos(scenes, finer):
    """Photo pixels are a centimetre on the ground."""
    photos, pixel = SurveyPhotos.of(scenes["ground"]), GRID.pixel / finer
    size = round(100 * finer)
    grid = MapGrid(GRID.left, GRID.top, pixel, size, size)
    mask = np.ones((size, size), bool)
    flat, wrong = np.zeros((size, size)), np.full((size, size), 6 * max(pixel, GRID.pixel))
    (tile,) = tiles_of(grid)
    at_own, at_other = photos.alike(grid, tile, mask, flat, wrong)
    assert at_own > 0.7 and at_own - at_other > 0.4
    assert photos.alike(grid, tile, mask, wrong, flat) == pytest.approx((at_other, at_own), abs=0.1)
