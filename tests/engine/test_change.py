"""Profiles, alignment, and change between generated surveys of one place."""

import csv
import json
import re
import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from swag_engine.app.cli import main
from swag_engine.base.errors import InputError
from swag_engine.products import change, change_maps, dem, geotiff, preview, tiles
from swag_engine.products.alignment import align
from swag_engine.products.areas import make_areas
from swag_engine.products.change import make_change
from swag_engine.products.change_maps import Comparison, Survey
from swag_engine.products.components import Components
from swag_engine.products.grid import MapGrid, make_grid
from swag_engine.products.map_frame import load_map_scene
from swag_engine.products.profile import make_profile
from swag_engine.products.views import height_errors
from swag_engine.scene.cameras import Camera
from swag_engine.scene.georeference import Georeference, Placement
from swag_engine.splats.splats import concatenate
from swag_engine.splats.transform import C0, transformed
from tests.scenes.flat_splats import GEOREFERENCE, sheet, write_run

rasterio = pytest.importorskip("rasterio")
CORALS = ((0.7, 0.7, 0.25), (2.0, 0.9, 0.3), (3.2, 2.2, 0.2), (1.2, 2.2, 0.3), (3.1, 0.9, 0.3))
"""Middle and half width of five corals, metres."""
COLORS = ((0.8, 0.4, 0.2), (0.7, 0.3, 0.6), (0.3, 0.6, 0.3), (0.8, 0.7, 0.3), (0.3, 0.4, 0.8))
PIXEL = 0.02


def sand(x, y):
    return 0.08 * np.sin(2.3 * x + 0.5) * np.cos(1.7 * y) + 0.05 * np.sin(5.1 * y + x)


def survey(seed=0, gone=(), grown=(), growth=1.1):
    """Sand with corals, its splats jittered as another training would place them."""
    random = np.random.default_rng(seed)
    parts = [sheet(0, 0, 4, 3, 0.03, sand, label=1)]
    brightness = 0.45 + 0.1 * np.sin(3 * parts[0].positions[:, :1]) * np.sin(4 * parts[0].positions[:, 1:2])
    parts[0].sh[:, 0] = (brightness - 0.5) / C0
    for number, (x, y, half) in enumerate(CORALS):
        if number in gone:
            continue
        top = 0.3 * (growth if number in grown else 1)
        half = half * (growth if number in grown else 1)
        parts.append(sheet(x - half, y - half, x + half, y + half, 0.02, top, COLORS[number], label=2))
    splats = concatenate(parts)
    splats.positions[:] += random.normal(0, 0.002, splats.positions.shape)
    return splats


def other_light(splats):
    """The same scene with less and greener light."""
    changed = splats.sh.copy()
    changed[:, 0] = ((0.5 + C0 * changed[:, 0]) * [0.6, 0.8, 0.75] + [0, 0.02, 0.04] - 0.5) / C0
    return replace(splats, sh=changed.astype(np.float32))


def other_frame(angle=100.0, shift=(3.0, -8.0, 1.5), scale=1.0):
    matrix = np.eye(4)
    turn = np.radians(angle)
    matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    matrix[:3, :3] *= scale
    matrix[:3, 3] = shift
    return matrix


# -- profile ----------------------------------------------------------------------------------------------------------


def test_a_profile_follows_the_surface(tmp_path):
    """Up a slope of 30 degrees, 2 m long as the map has it."""
    run = write_run(tmp_path, [sheet(0, 0, 4, 3, 0.05, lambda x, y: x / np.sqrt(3))])
    found = make_profile(run, (1, 1, 3, 1), tmp_path / "line.csv", 0.05)
    assert found["length"] == pytest.approx(2) and found["surface_length"] == pytest.approx(
        2 / np.cos(np.pi / 6), rel=0.01
    )
    with open(tmp_path / "line.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 41 and float(rows[0]["x"]) == 500_001
    heights = np.array([float(row["first_surface"]) for row in rows])
    np.testing.assert_allclose(heights, (1 + np.linspace(0, 2, 41)) / np.sqrt(3) - 12, atol=0.01)
    assert (tmp_path / "line.png").stat().st_size > 1000


def test_a_profile_over_a_hole_has_no_heights_there(tmp_path, capsys):
    run = write_run(tmp_path, [sheet(0, 0, 1, 1, 0.05), sheet(2, 0, 3, 1, 0.05)])
    line = ["--line", "0.5", "0.5", "2.5", "0.5", "--pixel", "0.05"]
    assert main(["profile", str(run), *line, "--out", str(tmp_path / "line.csv"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["covered"] == pytest.approx(0.5, abs=0.06)
    with open(tmp_path / "line.csv") as file:
        assert [row["first_surface"] for row in csv.DictReader(file)][20] == ""
    with pytest.raises(InputError, match="two different points"):
        make_profile(run, (1, 1, 1, 1), tmp_path / "line.csv")
    with pytest.raises(InputError, match="ends in .csv"):
        make_profile(run, (1, 1, 2, 1), tmp_path / "line.txt")


# -- alignment --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale, free", [(1.0, False), (1.3, True)])
def test_surveys_in_other_frames_are_aligned_by_what_is_static(scale, free):
    """Three of five corals are gone, and the light is another one."""
    there = other_frame(scale=scale)
    later = transformed(other_light(survey(1, gone=(0, 1, 2))), there)
    found = align(later, survey(0), None, free)
    corners = np.array([[0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0.3]])
    moved = corners @ there[:3, :3].T + there[:3, 3]
    back = moved @ found.matrix[:3, :3].T + found.matrix[:3, 3]
    assert np.abs(back - corners).max() < 0.01  # half a pixel
    assert found.scale == pytest.approx(1 / scale, rel=0.005)
    assert found.static > 0.8 and found.residual < 0.005


def test_surveys_that_show_different_parts_are_aligned():
    """Three quarters of a place each, in frames that have nothing in common: their middles are a metre apart."""
    west, east = survey(0), survey(1)
    west, east = west.subset(west.positions[:, 0] < 3), east.subset(east.positions[:, 0] > 1)
    for angle in (75.0, 200.0):
        found = align(transformed(east, other_frame(angle)), west, None, False)
        moved = transformed(east, found.matrix @ other_frame(angle)).positions - east.positions
        assert np.linalg.norm(moved, axis=1).max() < 0.03, angle  # the spacing of the splats


def test_too_few_splats_are_refused():
    few = sheet(0, 0, 1, 1, 0.2)
    with pytest.raises(InputError, match="only 25 solid splats"):
        align(few, few, None, False)


# -- change -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Three corals removed, one grown by 10 %, other light, another frame; the fifth coral and the sand are static."""
    folder = tmp_path_factory.mktemp("pair")
    earlier = write_run(folder / "a", [survey(0)], ("sand", "coral"))
    unplaced = Georeference(**(vars(GEOREFERENCE) | {"placement": None, "axes": "up"}))
    later = transformed(other_light(survey(1, gone=(0, 1, 2), grown=(3,))), other_frame())
    later_run = write_run(folder / "b", [later], ("sand", "coral"), unplaced)
    return earlier, later_run, make_change(earlier, later_run, folder / "change", PIXEL), folder / "change"


def test_removed_and_grown_objects_are_found_and_no_others(pair):
    _, _, found, _ = pair
    lower = [item for item in found["objects"] if item["change"] == "lower"]
    assert len(lower) == 3
    for x, y, half in CORALS[:3]:
        (item,) = [i for i in lower if abs(i["x"] - 500_000 - x) < 0.05 and abs(i["y"] - 4_000_000 - y) < 0.05]
        # Half a splat at each edge counts as the surface.
        assert item["area"] == pytest.approx((2 * half + 0.02) ** 2, rel=0.12)
        assert item["height_change"] == pytest.approx(sand(x, y) - 0.3, abs=0.06)
        assert (item["label_before"], item["label_after"]) == (2, 1)
    x, y, half = CORALS[3]
    grown = [item for item in found["objects"] if item["change"] != "lower"]
    assert all(abs(i["x"] - 500_000 - x) < 1.2 * half and abs(i["y"] - 4_000_000 - y) < 1.2 * half for i in grown), (
        grown
    )
    assert any(i["change"] == "higher" and i["height_change"] == pytest.approx(0.03, abs=0.01) for i in grown)


def test_maps_table_and_page_of_a_change(pair):
    _, _, found, out = pair
    with rasterio.open(out / "change.tif") as dataset:
        assert dataset.descriptions[1] == "smallest change told at 95 %" and dataset.crs.to_epsg() == 32633
    with rasterio.open(out / "changed.tif") as dataset:
        flags = dataset.read(1)
        assert dataset.colormap(1)[2][:3] == (178, 24, 43)
    assert (flags == 2).sum() * PIXEL**2 == pytest.approx(0.25 + 0.36 + 0.16, rel=0.15)
    with open(out / "changes.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(found["objects"]) and rows[0]["label_before"] in ("sand", "coral")
    with open(out / "label_change.csv") as file:
        moved = {(row["before"], row["after"]): float(row["area"]) for row in csv.DictReader(file)}
    assert moved["coral", "sand"] == pytest.approx(0.25 + 0.36 + 0.16, rel=0.15)
    page = (out / "change.html").read_text()
    assert page.count("data:image/png;base64,") == 3 and 'type="range"' in page and "http" not in page


def test_nothing_changed(tmp_path):
    """Other splats of the same scene in other light: no object is invented."""
    earlier = write_run(tmp_path / "a", [survey(0)])
    later = write_run(tmp_path / "b", [other_light(survey(7))])
    found = make_change(earlier, later, tmp_path / "change", PIXEL)
    assert found["objects"] == [] and found["changed"] == 0
    assert found["alignment"]["static"] > 0.9


def test_color_alone_can_change(tmp_path):
    earlier, bleached = survey(0), survey(3)
    coral = bleached.extras["label"] == 2
    coral &= np.abs(bleached.positions[:, 0] - CORALS[0][0]) < 0.3
    coral &= np.abs(bleached.positions[:, 1] - CORALS[0][1]) < 0.3
    bleached.sh[coral, 0] = (0.95 - 0.5) / C0
    a, b = write_run(tmp_path / "a", [earlier]), write_run(tmp_path / "b", [other_light(bleached)])
    (item,) = make_change(a, b, tmp_path / "change", PIXEL)["objects"]
    assert item["change"] == "color" and item["area"] == pytest.approx(0.25, rel=0.3)  # a soft edge


def test_what_cannot_be_compared_is_explained(tmp_path, pair, capsys):
    earlier, _, _, _ = pair
    unknown = write_run(tmp_path / "b", [survey(1)], measured=None)
    assert main(["change", str(earlier), str(unknown), "--out", str(tmp_path / "change")]) == 2
    assert "The scale of run is not known" in (error := capsys.readouterr().err) and "--scale free" in error
    with pytest.raises(InputError, match="The scale of run and of run is not known"):
        make_change(unknown, unknown, tmp_path / "change", PIXEL)
    found = make_change(earlier, unknown, tmp_path / "free", 0.05, scale="free")
    assert found["alignment"]["scale"] == pytest.approx(0.5, rel=0.005) and found["objects"] == []
    assert not (tmp_path / "change").exists()


@pytest.mark.parametrize(
    "crs, x, y, distance",
    [("EPSG:32634", 500_000, 4_000_000, r"5\d\d\.\d km"), ("EPSG:32633", 500_000, 4_040_000, "40.0 km"),
     ("EPSG:25833", 500_001, 4_000_000, None), ("EPSG:32634", -40_077.93, 4_016_714.88, None),
     ("EPSG:32633", 500_060, 4_000_000, None)],
)  # fmt: skip
def test_coordinates_that_contradict_each_other_are_refused(tmp_path, pair, monkeypatch, crs, x, y, distance):
    earlier = pair[0]
    placed = Georeference(**(vars(GEOREFERENCE) | {"placement": Placement(crs, (x, y, -12.0))}))
    later = write_run(tmp_path / "b", [survey(1)], measured=placed)
    monkeypatch.setattr(change, "align", lambda *given: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(InputError if distance else KeyboardInterrupt) as caught:
        make_change(earlier, later, tmp_path / "change", PIXEL)
    assert not distance or re.search(
        f"{earlier} lies at 500002 4000001 in EPSG:32633 and {later} lies at {x + 2} {y + 1} in {crs}, {distance}",
        str(caught.value),
    )


def test_the_size_of_tiles_does_not_matter(pair, tmp_path, monkeypatch):
    """Not of those that are compared; heights depend a little on the layers of the tiles that are rendered."""
    earlier, later, _, _ = pair

    def compared(name):
        objects = make_change(earlier, later, tmp_path / name, PIXEL)["objects"]
        found = [(item["change"], item["pixels"]) for item in objects]
        return found, rasterio.open(tmp_path / name / "changed.tif").read(1)

    whole, whole_flags = compared("whole")
    monkeypatch.setattr(change, "EDGE", 32)
    rendered, rendered_flags = compared("rendered")
    monkeypatch.setattr(tiles.tiles_of, "__defaults__", (32, "", None))
    small, small_flags = compared("tiles")
    assert small == rendered and len(small) >= 4
    assert np.array_equal(small_flags, rendered_flags)
    assert [kind for kind, _ in small] == [kind for kind, _ in whole]
    assert [pixels for _, pixels in small] == pytest.approx([pixels for _, pixels in whole], rel=0.03)
    assert (small_flags != whole_flags).mean() < 0.002
    assert not list((tmp_path / "tiles").glob(".*"))  # no scratch is left


def test_memory_does_not_grow_with_the_map(tmp_path, monkeypatch):
    """Sixteen times as many pixels take less than twice the memory."""
    run = write_run(tmp_path, [survey(0)], ("sand", "coral"))
    monkeypatch.setattr(tiles.tiles_of, "__defaults__", (64, "", None))
    for module, name, value in (
        (change, "EDGE", 64), (change, "PREVIEW", 64), (change, "SAMPLE", 2000), (change_maps, "SAMPLE", 2000),
        (preview, "PREVIEW", 64), (dem, "EDGE", 64), (geotiff, "BLOCK", 64),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, value)
    peaks = []
    for pixel in (0.04, 0.01):
        tracemalloc.start()
        make_areas(run, tmp_path / "areas", pixel, (0, 0, 4, 3))
        peaks.append([tracemalloc.get_traced_memory()[1]])
        tracemalloc.reset_peak()
        find = make_change(run, run, tmp_path / "change", pixel, (0, 0, 4, 3))
        peaks[-1].append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert find["objects"] == []
    assert peaks[1][0] < 2 * peaks[0][0] and peaks[1][1] < 2 * peaks[0][1], peaks


def cameras_above(scene, places, height=2.0):
    """Cameras that look straight down from places, in metres; from 2 m their images are 2 m wide."""
    cameras = []
    for x, y in places:
        to_camera = np.diag([1.0, -1, -1, 1])
        to_camera[:3, 3] = -to_camera[:3, :3] @ [x, y, height]
        to_camera = to_camera @ scene.matrix
        to_camera[:3] /= np.cbrt(np.linalg.det(scene.matrix[:3, :3]))  # the camera has the scene's unit
        cameras.append(Camera("", 200, 200, 200.0, 200.0, 100.0, 100.0, to_camera))
    return cameras


def test_errors_of_heights_follow_from_the_rays(tmp_path):
    """Two cameras 2 m above the ground and 1 m apart: angles of a pixel, 1/200, leave 4 cm of height in the middle.

    91 pixels of each photo show a pixel of the map there, so a tenth of it is left.
    """
    scene = load_map_scene(write_run(tmp_path, [survey(0)]))
    grid = make_grid(scene.splats, 0.1, (0, 0, 4, 3))
    (tile,) = tiles.tiles_of(grid)
    for height, aside in ((1.0, 0.2), (2.0, 0.5)):
        pair = cameras_above(scene, [(2 - aside, 1.8), (2 + aside, 1.8)], height)
        found = height_errors(pair, scene, grid, tile, np.zeros((30, 40)))
        distance = np.hypot(height, aside)
        pixels = (0.1 * 200 / distance) ** 2 * height / distance  # seen at an angle
        wanted = distance / 200 / np.sqrt(2 * pixels) / (aside / distance)  # by the sine of its angle
        assert found[15, 20] == pytest.approx(wanted, rel=0.01)
    assert np.isinf(found[15, 2]) and np.isinf(found[15, 38]) and np.isinf(found[28, 20])
    more = height_errors(
        cameras_above(scene, [(1.5, 1.8), (2.5, 1.8)] * 4), scene, grid, tile, np.zeros((30, 40))
    )  # fmt: skip
    assert more[15, 20] == pytest.approx(found[15, 20] / 2, rel=1e-3)
    same = height_errors(cameras_above(scene, [(2.0, 1.8)] * 2), scene, grid, tile, np.zeros((30, 40)))
    assert np.isinf(same).all()  # two photos from one place


def test_places_whose_heights_photos_do_not_determine_are_not_compared(tmp_path, monkeypatch):
    """Many photos of the west from all sides, two of the east from nearly one place, and none of the rest."""
    run = write_run(tmp_path, [survey(0)])
    scene = load_map_scene(run)
    west = [(x, y) for x in (0.4, 0.8, 1.2) for y in (0.9, 1.5, 2.1)]
    cameras = cameras_above(scene, [*west, (3.2, 1.5), (3.25, 1.5)])
    photos = SimpleNamespace(cameras=cameras, alike=lambda *place: None)
    monkeypatch.setattr(change.SurveyPhotos, "of", lambda scene: photos)
    make_change(run, run, tmp_path / "change", 0.1, (0, 0, 4, 3))
    flags = rasterio.open(tmp_path / "change" / "changed.tif").read(1)
    assert (flags[8:22, 3:13] == 0).all() and (flags[:, 24:] == 255).all()


def test_heights_with_larger_expected_errors_need_larger_changes():
    """The same difference is told where the expected error is usual, and not where it is twice that."""
    grid = MapGrid(0, 40, 1, 100, 40)
    random = np.random.default_rng(0)
    errors = np.ones((40, 100), np.float32)
    errors[:, 60:], errors[:, 90:] = 2.0, 3.0
    before, after = (0.7 * errors * random.standard_normal((40, 100), np.float32) for _ in range(2))
    after[5:15, 5:15] += 3.2
    after[5:15, 70:80] += 3.2
    colors, layers = np.full((40, 100, 3), 128, np.uint8), np.zeros((40, 100), np.float32)
    comparison = Comparison(Survey(colors, before, errors, layers), Survey(colors, after, errors, layers), grid, 0.0)
    (tile,) = tiles.tiles_of(grid)
    found = comparison.differences(tile)
    told = found.told >> 1 & 1
    assert told[7:13, 7:13].mean() > 0.6 > 0.35 > told[7:13, 72:78].mean()
    assert np.isnan(found.height[:, 90:]).all() and np.isfinite(found.height[:, :90]).all()


GROUND = MapGrid(0, 200, 1, 200, 200)


def test_heights_of_splats_in_two_layers_need_larger_changes():
    """A step of 2 is told where the median height is at the first surface, not where it is 4 below it in one survey."""
    before, after = flat_surveys()
    for columns in (slice(40, 60), slice(140, 160)):
        after.heights[90:110, columns] += 2
    assert len(objects_of(before, after)) == 2
    before.layers[:, 100:] = 4
    (found,) = objects_of(before, after)
    assert found["column"] == pytest.approx(49.5, abs=1)


def flat_surveys():
    """Two surveys of flat ground with noise of 0.2."""
    random, shape = np.random.default_rng(1), (200, 200)
    colors, errors = np.full((*shape, 3), 128, np.uint8), np.ones(shape, np.float32)
    layers = np.zeros(shape, np.float32)
    return [Survey(colors, 0.2 * random.standard_normal(shape, np.float32), errors, layers.copy()) for _ in range(2)]


def objects_of(before, after, residual=0.0):
    return objects_in(Comparison(before, after, GROUND, residual))


def objects_in(comparison):
    flags, numbers = (np.zeros((200, 200), kind) for kind in (np.uint8, np.int32))
    (tile,) = tiles.tiles_of(GROUND)
    return comparison.find_objects(comparison.differences(tile).told, flags, numbers)


def test_spots_that_hardly_exceed_the_limit_are_no_change():
    """The same 144 pixels are told where they exceed the limit by much, and many pixels where they do by little."""
    before, after = flat_surveys()
    (tile,) = tiles.tiles_of(GROUND)
    limit = float(np.median(Comparison(before, after, GROUND, 0.0).differences(tile).limit))
    change = np.zeros((200, 200), np.float32)
    change[20:32, 20:32], change[20:32, 80:92], change[100:130, 20:50] = 1.5 * limit, 1.06 * limit, 1.06 * limit
    after.heights[change > 0] = (before.heights + change)[change > 0]  # without noise
    found = objects_of(before, after)
    assert sorted((item["change"], round(item["row"], -1), round(item["column"], -1)) for item in found) == [
        ("higher", 30, 30), ("higher", 110, 30),
    ]  # fmt: skip


def textured_comparison(surveys, change):
    """A comparison of the surveys with one texture, and a change (H, W) of gray values of the later one."""
    texture = np.random.default_rng(4).integers(80, 160, (200, 200, 3))
    before, after = surveys
    changed = (texture + change[..., None]).astype(np.uint8)
    before, after = replace(before, colors=texture.astype(np.uint8)), replace(after, colors=changed)
    return Comparison(before, after, GROUND, 0.0)


def test_other_light_on_slopes_is_no_change_of_color():
    """Where all colors differ more on a slope, a spot there is not told, and the same on level ground is."""
    before, after = flat_surveys()
    slope = np.maximum(0, 2 * (np.arange(200, dtype=np.float32) - 100))
    before.heights[:], after.heights[:] = before.heights + slope, after.heights + slope
    even = 6 * np.random.default_rng(3).standard_normal((200, 200))
    spots = np.zeros((200, 200), bool)
    for row, column in ((50, 40), (50, 140)):
        spots[row : row + 20, column : column + 20] = True
    change = np.where(spots, 50, np.where(slope > 0, 2, 1) * even)
    assert textured_comparison((before, after), even).color_factors[-1] < 1.1
    steep = textured_comparison((before, after), change)
    assert steep.color_factors[-1] > 1.5
    assert [(item["change"], round(item["column"])) for item in objects_in(steep)] == [("color", 50)]


def test_broad_changes_are_told_from_less():
    """What is too low to be told is told where it is 400 pixels large, not where it is 100; slopes and layers count."""
    before, after = flat_surveys()
    (tile,) = tiles.tiles_of(GROUND)
    comparison = Comparison(before, after, GROUND, 1.0)
    limit = float(np.median(comparison.differences(tile).limit))
    flat, none = np.zeros((200, 200)), np.ones((200, 200))
    broad = float(comparison._broad_limit(none, flat, flat).max())
    assert broad < 0.8 * limit
    height = (broad + limit) / 2
    after.heights[20:40, 20:40], after.heights[20:30, 100:110] = height, height
    after.heights[120:140, 20:40] = -height
    found = objects_of(before, after, 1.0)
    assert [(item["change"], round(item["row"], -1), round(item["column"], -1)) for item in found] == [
        ("higher", 30, 30), ("lower", 130, 30),
    ]  # fmt: skip
    assert all(item["height_limit"] < abs(item["height_change"]) < limit for item in found)
    before.layers[:, :60] = 4
    assert not objects_of(before, after, 1.0)


def test_limits_are_raised_where_large_differences_are_frequent():
    """Noise that neighbours share, as that of large splats, is not removed by the median filter."""
    before, after = flat_surveys()
    shared = 0.3 * np.kron(np.random.default_rng(2).standard_normal((40, 40)), np.ones((5, 5))).astype(np.float32)
    before_shared, after_shared = replace(before, heights=shared), replace(after, heights=0 * shared)
    assert Comparison(before_shared, after_shared, GROUND, 0.0).tail > 1.5 > Comparison(before, after, GROUND, 0.0).tail
    assert not objects_of(before_shared, after_shared)


def test_borders_of_labels_that_differ_by_the_error_of_places_are_no_change():
    before, after = flat_surveys()
    labels = np.ones((200, 200), np.uint8)
    labels[:, 50:], labels[100:108, 20:28] = 2, 3
    moved, other = np.roll(labels, 4, axis=1), labels.copy()
    moved[:, :4], moved[100:108], other[100:108, 20:28], other[20:28, 20:28] = 1, labels[100:108], 1, 2
    for later, residual, told in ((moved, 2.1, 0), (moved, 1.0, 2), (other, 2.1, 2)):
        found = objects_of(replace(before, labels=labels), replace(after, labels=later), residual)
        assert [item["change"] for item in found] == ["label"] * told, (residual, told)


def test_what_is_seen_through_needs_larger_changes(tmp_path):
    """The same ground, twice as transparent in the east: errors there are twice those of the west."""
    splats = sheet(0, 0, 4, 3, 0.03, sand, label=1)
    splats.opacities[splats.positions[:, 0] > 2] = 0.05
    scene = load_map_scene(write_run(tmp_path, [splats]))
    grid = make_grid(scene.splats, 0.05, (0, 0, 4, 3))
    errors = change._survey(scene, None, grid, "auto", tmp_path / "survey", "", None).errors
    assert np.median(errors[10:-10, 50:70]) > 1.3 * np.median(errors[10:-10, 10:30])


def test_components_join_across_tiles():
    random = np.random.default_rng(0)
    mask = cv2.dilate((random.random((90, 130)) < 0.04).astype(np.uint8), np.ones((3, 3)))
    grid = MapGrid(0, 90, 1, 130, 90)
    parts, numbers = Components(), np.zeros(mask.shape, np.int32)
    for tile in tiles.tiles_of(grid, 32):
        parts.add(numbers, tile, mask[tile.place], mask[tile.place])
    parts.choose(40, 0)
    found = parts.chosen(numbers)
    count, true, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= 40)[1:]
    assert np.array_equal(found > 0, np.isin(true, large)) and len(np.unique(found)) - 1 == len(large) > 5
    for part in large:
        assert len(np.unique(found[true == part])) == 1
