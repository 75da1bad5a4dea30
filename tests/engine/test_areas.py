"""Areas by label of known patches, their errors, polygons, and labels that go back to the splats."""

import csv
import json

import cv2
import numpy as np
import pytest
import rasterio
import torch

from swag_engine.app.cli import main
from swag_engine.base.errors import InputError
from swag_engine.formats.ply import read_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.products.areas import make_areas
from swag_engine.products.dem import read_heights
from swag_engine.products.grid import MapGrid
from swag_engine.products.label_errors import area_errors, held_out_confusion
from swag_engine.products.label_map import label_colors
from swag_engine.products.map_frame import load_map_scene
from swag_engine.products.patches import find_patches, to_coco
from swag_engine.products.views import camera_centre, project, visible
from swag_engine.scene.colmap import load_scene
from swag_engine.semantics.assign import render_labels
from swag_engine.settings.settings import TrainSettings
from swag_engine.splats.splats import concatenate
from tests.scenes.flat_splats import sheet, write_run
from tests.scenes.tiny import make_tiny_scene

LABELS = ("sand", "coral", "sponge", "seagrass")
PIXEL = 0.02


def reef(folder):
    """Sand 4 m by 3 m; 20 cm above it two corals (0.5 m2 and 0.16 m2) and a sponge on a slope of 45 degrees."""
    parts = [
        sheet(0, 0, 4, 3, 0.04, label=1),
        sheet(0.5, 0.5, 1.5, 1.0, 0.01, 0.2, label=2),
        sheet(0.5, 2.0, 0.9, 2.4, 0.01, 0.2, label=2),
        sheet(2.5, 1.0, 3.5, 2.0, 0.01, lambda x, y: x - 2.3, label=3),
    ]
    return write_run(folder, parts, LABELS)


@pytest.fixture
def made(tmp_path):
    run = reef(tmp_path)
    return run, tmp_path / "areas", make_areas(run, tmp_path / "areas", PIXEL, (0, 0, 4, 3))


def test_areas_of_known_patches(made):
    _, out, found = made
    rows = {row["name"]: row for row in found["labels"]}
    assert rows["coral"]["planar_area"] == pytest.approx(0.66, rel=0.05)
    assert rows["sponge"]["planar_area"] == pytest.approx(1.0, rel=0.05)
    assert rows["sponge"]["surface_area"] == pytest.approx(np.sqrt(2), rel=0.06)
    assert rows["sand"]["planar_area"] == pytest.approx(12 - 1.66, rel=0.05)
    assert rows["coral"]["cover_percent"] == pytest.approx(100 * 0.66 / 12, rel=0.05)
    assert rows["coral"]["patches"] == 2 and rows["coral"]["patch_mean"] == pytest.approx(0.33, rel=0.05)
    assert rows["coral"]["patch_p10"] == pytest.approx(0.16 + 0.1 * 0.34, rel=0.05)
    assert rows["seagrass"]["planar_area"] == 0 and "No pixel shows the label seagrass." in found["notes"]
    with open(out / "areas.csv") as file:
        table = {row["name"]: row for row in csv.DictReader(file)}
    assert float(table["coral"]["planar_area"]) == pytest.approx(rows["coral"]["planar_area"], rel=1e-5)


def test_without_held_out_masks_the_interval_is_that_of_the_scale(made):
    _, _, found = made
    (row,) = [row for row in found["labels"] if row["name"] == "sponge"]
    width = (row["planar_high"] - row["planar_low"]) / row["planar_area"]
    assert width == pytest.approx(4 * 1.96 * 0.01, rel=0.1)  # twice the relative error of the length, 1 %
    assert found["held_out"] == 0 and any("Intervals do not hold wrong labels" in note for note in found["notes"])
    assert row["cover_low"] == row["cover_high"]


def test_the_label_map_is_a_palette_with_names(made):
    _, out, _ = made
    with rasterio.open(out / "labels.tif") as dataset:
        assert dataset.nodata == 255 and dataset.tags()["LABEL_2"] == "coral"
        assert dataset.colormap(1)[2][:3] == label_colors([2])[2]
        labels = dataset.read(1)
    assert labels[150 - 37, 50] == 2 and labels[75, 150] == 3 and labels[10, 190] == 1


def test_polygons_are_in_degrees_and_in_pixels(made):
    _, out, _ = made
    document = json.loads((out / "patches.geojson").read_text())
    corals = [f for f in document["features"] if f["properties"]["name"] == "coral"]
    assert sorted(round(f["properties"]["planar_area"], 1) for f in corals) == [0.2, 0.5]
    longitude, latitude = corals[0]["geometry"]["coordinates"][0][0]
    assert longitude == pytest.approx(15, abs=1e-3) and latitude == pytest.approx(36.14, abs=0.01)
    coco = json.loads((out / "patches_coco.json").read_text())
    assert [c["name"] for c in coco["categories"]] == list(LABELS)
    boxes = [a["bbox"] for a in coco["annotations"] if a["category_id"] == 3]
    np.testing.assert_allclose(boxes, [[125, 50, 50, 50]], atol=2)


def test_patches_with_holes_become_polygons_without(tmp_path):
    labels = np.ones((20, 30), np.uint8)
    labels[5:10, 5:10] = labels[12:15, 20:25] = 0
    labels[0, 29] = 2
    with rasterio.open(tmp_path / "labels.tif", "w", "GTiff", 30, 20, 1, dtype="uint8") as dataset:
        dataset.write(labels, 1)
    patches = find_patches(tmp_path / "labels.tif", 2)
    assert [(p.label, p.pixels) for p in patches] == [(1, 600 - 25 - 15 - 1)]
    (annotation,) = to_coco(patches, "a.tif", 30, 20, {0: "unlabelled", 1: "sand", 2: "coral"})["annotations"]
    drawn = np.zeros((20, 30), np.uint8)
    for ring in annotation["segmentation"]:
        corners = np.array(ring).reshape(-1, 2)
        x, y = np.meshgrid(np.arange(30) + 0.5, np.arange(20) + 0.5)
        inside = [
            cv2.pointPolygonTest(corners.astype(np.float32), point, False) > 0
            for point in zip(x.flat, y.flat, strict=True)
        ]
        drawn += np.reshape(inside, (20, 30)).astype(np.uint8)
    assert np.array_equal(drawn, labels == 1)


def test_corrected_labels_go_back_to_the_splats(made, tmp_path):
    """The lower half of the sponge is painted as coral in a palette PNG; only its splats change."""
    run, out, _ = made
    with rasterio.open(out / "labels.tif") as dataset:
        labels = dataset.read(1)
    before = read_ply(RunFolder(run).ply).extras["label"]
    labels[75:, 125:175][labels[75:, 125:175] == 3] = 2
    cv2.imwrite(str(tmp_path / "corrected.png"), labels)
    found = make_areas(run, out, corrected=tmp_path / "corrected.png")
    after = read_ply(RunFolder(run).ply).extras["label"]
    moved = before != after
    assert (before[moved] == 3).all() and (after[moved] == 2).all()
    assert moved.sum() == pytest.approx((before == 3).sum() / 2, rel=0.05) and found["changed_splats"] == moved.sum()
    rows = {row["name"]: row for row in found["labels"]}
    assert rows["sponge"]["planar_area"] == pytest.approx(0.5, rel=0.07)  # to a splat at each edge
    assert rows["coral"]["planar_area"] == pytest.approx(1.16, rel=0.05)
    counts = {e["name"]: e["count"] for e in json.loads((run / "labels.json").read_text())["labels"]}
    assert counts["coral"] == (after == 2).sum()


def test_corrections_in_the_colors_of_the_labels_are_read_too(made, tmp_path):
    run, out, _ = made
    with rasterio.open(out / "labels.tif") as dataset:
        labels = dataset.read(1)
    colors = label_colors([0, 1, 2, 3, 4])
    image = np.zeros((*labels.shape, 4), np.uint8)
    for label, color in colors.items():
        image[labels == label] = (*color[::-1], 255)
    cv2.imwrite(str(tmp_path / "same.png"), image)
    assert make_areas(run, out, corrected=tmp_path / "same.png")["changed_splats"] == 0
    image[3, 4] = (1, 2, 3, 255)
    cv2.imwrite(str(tmp_path / "other.png"), image)
    with pytest.raises(InputError, match=r"color \(3, 2, 1\) at column 4, row 3, which is that of no label"):
        make_areas(run, out, corrected=tmp_path / "other.png")
    cv2.imwrite(str(tmp_path / "small.png"), image[:-1])
    with pytest.raises(InputError, match="200 x 149 pixels and the label map 200 x 150"):
        make_areas(run, out, corrected=tmp_path / "small.png")


def confusion_of(mapped, found):
    """Tables of views in which label 1 has `mapped` pixels in the map and `found` in the mask, the others 2."""
    confusion = np.zeros((len(mapped), 3, 3))
    confusion[:, 1, 1] = np.minimum(mapped, found)
    confusion[:, 1, 2] = mapped - confusion[:, 1, 1]
    confusion[:, 2, 1] = found - confusion[:, 1, 1]
    return confusion


def test_confusion_moves_areas_and_widens_intervals():
    """A fifth of what is mapped as 1 is 2 in truth, in half of the views a tenth and in the others three tenths."""
    confusion = confusion_of(np.full(8, 100), np.tile([90.0, 70.0], 4))
    errors = area_errors(np.array([0, 1000, 0]), confusion, 0.0)
    assert errors.corrected[1] == pytest.approx(1000 * (1 - 0.2 * (1 - 0.05 / 8 / 0.2**2)))
    half = 2.306 * 1000 * np.sqrt(0.05 / 8)  # Student's t of 8
    assert errors.low[1] == pytest.approx(errors.corrected[1] - half, abs=0.1)
    assert errors.high[1] == pytest.approx(errors.corrected[1] + half, abs=0.1)
    np.testing.assert_allclose(errors.cover_low, errors.low / 1000)


def test_views_that_disagree_correct_nothing():
    errors = area_errors(np.array([0, 1000, 0]), confusion_of(np.full(2, 100), np.array([130.0, 80.0])), 0.0)
    assert errors.corrected[1] == 1000 and errors.high[1] > 1700 and errors.low[1] < 300
    alone = area_errors(np.array([0, 1000, 0]), confusion_of(np.full(1, 100), np.array([104.0])), 0.0)
    assert alone.corrected[1] == 1000 and alone.high[1] == pytest.approx(1000 * (1 + 12.7 * 0.04), rel=0.01)


@pytest.mark.parametrize("views", [1, 2, 5])
@pytest.mark.parametrize("error", [0.0, 0.02, 0.1])
def test_intervals_hold_the_truth_as_often_as_they_say(views, error):
    """Views of unequal size see a map that is wrong by `error`, each with a random error of 3 %."""
    random = np.random.default_rng(0)
    inside, off = 0, []
    for _ in range(1000):
        mapped = random.uniform(20, 200, views)
        confusion = confusion_of(mapped, mapped * (1 + error + 0.03 * random.standard_normal(views)))
        errors = area_errors(np.array([0, 1000, 0]), confusion, 0.0)
        inside += errors.low[1] <= 1000 * (1 + error) <= errors.high[1]
        off.append(errors.corrected[1] / 1000 - 1 - error)
    assert inside >= 930
    assert np.sqrt(np.mean(np.square(off))) < max(error, 0.03) + 0.005


def test_confusion_of_held_out_images(tmp_path):
    """Splats west of x = 0 are `left`; masks of test images call the upper rows of it `right`, and none shows `far`."""
    photos = make_tiny_scene(tmp_path / "scene")
    parts = [(-2, -2, 0, 2), (0, -2, 2, 2), (40, 0, 41, 1)]
    splats = concatenate([sheet(*part, 0.1, label=label) for label, part in enumerate(parts, start=1)])
    run = write_run(tmp_path / "made", [splats], ("left", "right", "far"), None)
    folder = RunFolder(run)
    folder.write_config(photos, TrainSettings(), [0.0, -1.0, 0.0])
    folder.write_result(splats, [0.0, -1.0, 0.0])
    out = tmp_path / "areas"
    made = make_areas(run, out, 0.05, plane="0,0,-1")
    assert made["held_out"] == 0
    cloud = GaussianCloud.from_splats(splats, (0.5, 0.5, 0.5))
    numbers = torch.from_numpy(splats.extras["label"]).long()
    changed, seen_left = 0, 0
    for view in load_scene(photos).views:
        seen = render_labels(cloud, numbers, 3, view.camera)
        left, right = seen == 1, seen == 2
        if view.name in ("view_00.png", "view_08.png"):  # every eighth
            seen_left += left.sum()
            right[:20] |= left[:20]
            changed += left[:20].sum()
            left[:20] = False
        for name, mask in (("left", left), ("right", right)):
            path = photos / "labels" / name / view.name
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), 255 * mask.astype(np.uint8))
    scene, grid = load_map_scene(run, "0,0,-1"), MapGrid(**made["grid"])
    confusion = held_out_confusion(scene, None, out / "labels.tif", out / "heights.tif", grid)
    assert confusion.shape == (2, 4, 4)
    heights = read_heights(out / "heights.tif")
    places = grid.places(heights)[np.isfinite(heights)]
    test = [view.camera for view in load_scene(photos).views if view.name in ("view_00.png", "view_08.png")]
    for camera, table in zip(test, confusion, strict=True):
        rays = places[np.isfinite(project(camera, scene, places)[:, 0])] - camera_centre(camera, scene)
        cosines = rays[:, 2] / np.linalg.norm(rays, axis=1)
        assert table.sum() == pytest.approx((cosines**2).sum(), rel=0.02) and cosines.max() < -0.5
    assert confusion[:, 1, 2].sum() / confusion[:, 1, 1:].sum() == pytest.approx(changed / seen_left, abs=0.02)
    assert confusion[:, 2, 1].sum() < 0.02 * confusion[:, 2, 2].sum()
    made = make_areas(run, out, 0.05, plane="0,0,-1")
    assert made["held_out"] == 2
    assert "No held-out image shows far: its interval does not hold wrong labels." in made["notes"]


def test_what_the_surface_hides_from_a_photo_is_not_compared():
    """A wall 2 m high between x = 1 and 1.2 hides the ground behind it from a camera 4 m above x = -1."""
    grid = MapGrid(0, 1, 0.05, 80, 20)
    heights = np.zeros((20, 80))
    heights[:, 20:24], heights[5, 3] = 2.0, np.nan
    seen = visible(np.array([-1.0, 0.5, 4.0]), grid, heights)
    assert seen[10, :24].all() and not seen[5, 3]
    assert not seen[10, 26:68].any() and seen[10, 72:].all()  # the shadow ends at x = 3.4


def test_the_gain_of_a_label_moves_its_border(tmp_path):
    """A coral of 1 m2 with soft edges over transparent ground seems too large; labels.json has its gain."""
    ground = sheet(0, 0, 2, 2, 0.04, label=1)
    ground.opacities[:] = 0.3
    coral = sheet(0.5, 0.5, 1.5, 1.5, 0.05, 0.3, label=2)
    run = write_run(tmp_path, [ground, coral], ("sand", "coral"))
    RunFolder(run).write_metrics({"background": [0.5, 0.5, 0.5]})  # else transparent pixels have no label
    areas = []
    for gain in (1, 0.25):
        table = json.loads((run / "labels.json").read_text())
        table["labels"][1]["gain"] = gain
        (run / "labels.json").write_text(json.dumps(table))
        found = make_areas(run, tmp_path / "areas", PIXEL, (0, 0, 2, 2))
        areas.append(found["labels"][1]["planar_area"])
    assert areas[0] > 1.06 and areas[1] == pytest.approx(1, abs=0.03), areas


def test_the_command_prints_the_table_and_refuses_splats_without_labels(tmp_path, capsys):
    run = reef(tmp_path / "a")
    assert main(["areas", str(run), "--out", str(tmp_path / "areas"), "--pixel", "0.05"]) == 0
    assert "coral" in (text := capsys.readouterr().out) and "planar m²" in text
    plain = write_run(tmp_path / "b", [sheet(0, 0, 1, 1, 0.1)])
    assert main(["areas", str(plain), "--out", str(tmp_path / "none")]) == 2
    assert "The splats have no labels: make them with the command label" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
