"""Orthomosaics and heights of splats on known surfaces, read back by rasterio."""

import json
import shutil
import subprocess

import cv2
import numpy as np
import pytest
import rasterio

from swag_engine.app.cli import main
from swag_engine.base.errors import InputError
from swag_engine.formats.ply import write_ply
from swag_engine.products import grid, tiles
from swag_engine.products.dem import make_dem, read_heights
from swag_engine.products.grid import make_grid
from swag_engine.products.heights import surface_factor
from swag_engine.products.ortho import make_ortho
from swag_engine.products.relief import hillshade, rugosity, slope
from swag_engine.products.tiles import TileRenderer, tiles_of
from swag_engine.scene.georeference import Georeference, Placement
from swag_engine.splats.splats import concatenate
from tests.scenes.flat_splats import GEOREFERENCE, sheet, write_run

RED, BLUE = (0.8, 0.2, 0.2), (0.1, 0.2, 0.9)


@pytest.fixture
def two_colors(tmp_path):
    """Red west of x = 2, blue east of it, 4 m by 3 m."""
    return write_run(tmp_path, [sheet(0, 0, 2, 3, 0.05, color=RED), sheet(2, 0, 4, 3, 0.05, color=BLUE)])


def measured(**changes):
    return Georeference(**(vars(GEOREFERENCE) | changes))


# -- orthomosaic ------------------------------------------------------------------------------------------------------


def test_an_orthomosaic_is_a_cloud_optimized_geotiff_at_its_place(two_colors, tmp_path):
    out = tmp_path / "map.tif"
    found = make_ortho(two_colors, out, pixel=0.004, box=(0, 0, 4, 3))
    assert (found["width"], found["height"], found["unit"], found["crs"]) == (1000, 750, "m", "EPSG:32633")
    with rasterio.open(out) as dataset:
        assert dataset.crs.to_epsg() == 32633
        assert dataset.bounds == pytest.approx((500_000, 4_000_000, 500_004, 4_000_003))
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert dataset.block_shapes[0] == (512, 512) and dataset.overviews(1)
        colors = dataset.read()
    for x, color in ((0.8, RED), (3.2, BLUE)):
        column = round(x / 0.004)
        np.testing.assert_allclose(colors[:3, 375, column], 255 * np.array(color), atol=2)
    edge = np.argmax(colors[2, 375] > colors[0, 375])
    assert abs(edge - 500) <= 4  # a third of a splat
    assert colors[3, 375, 500] > 230


def test_gdalinfo_reads_an_orthomosaic(two_colors, tmp_path, missing):
    if not shutil.which("gdalinfo"):
        missing("gdalinfo is not here: on Debian, apt-get install gdal-bin.")
    make_ortho(two_colors, tmp_path / "map.tif", pixel=0.02)
    answer = subprocess.run(["gdalinfo", "-json", tmp_path / "map.tif"], check=True, capture_output=True)
    assert json.loads(answer.stdout)["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"] == "COG"


def test_pixels_without_splats_are_transparent_and_the_preview_has_a_scale_bar(two_colors, tmp_path):
    out = tmp_path / "map.tif"
    found = make_ortho(two_colors, out, pixel=0.01, box=(-1, 0, 4, 3))
    assert found["covered"] == pytest.approx(0.8, abs=0.02)
    with rasterio.open(out) as dataset:
        assert (dataset.read(4)[:, :90] == 0).all()
    preview = cv2.imread(str(tmp_path / "map_preview.png"))
    assert preview.shape == (900, 1500, 3)  # three times as large as the map
    assert (preview[840:885, 36:180] < 10).any()  # the bar is outlined in black over the white outside


def test_tiles_join_without_a_seam(two_colors, tmp_path, monkeypatch):
    make_ortho(two_colors, tmp_path / "whole.tif", pixel=0.02)
    monkeypatch.setattr(tiles.tiles_of, "__defaults__", (64, "", None))
    make_ortho(two_colors, tmp_path / "tiles.tif", pixel=0.02)
    with rasterio.open(tmp_path / "whole.tif") as whole, rasterio.open(tmp_path / "tiles.tif") as parts:
        assert np.abs(whole.read().astype(int) - parts.read().astype(int)).max() <= 1


@pytest.mark.parametrize("pixel", [0.05, 0.4])
def test_pixels_larger_than_splats_show_the_mean(pixel):
    """Splats of a fine checkerboard, smaller than a pixel, give grey of the right transparency at any pixel size."""
    splats = sheet(0, 0, 4, 4, 0.05, color=(1, 1, 1))
    splats.sh[(np.arange(len(splats)) + np.arange(len(splats)) // 80) % 2 == 0] *= -1
    splats.scales[:] *= 0.3
    renderer = TileRenderer(splats, make_grid(splats, pixel, (0.8, 0.8, 3.2, 3.2)))
    (tile,) = tiles_of(renderer.grid)
    chosen = renderer.inside(tile)
    image, alpha = renderer.render(tile, chosen, renderer.colors()[chosen])
    fine = TileRenderer(splats, make_grid(splats, 0.002, (0.8, 0.8, 1.2, 1.2)))
    (fine_tile,) = tiles_of(fine.grid)
    _, truth = fine.render(fine_tile, fine.inside(fine_tile), fine.colors()[fine.inside(fine_tile)])
    assert alpha.mean() == pytest.approx(truth.mean(), rel=0.35)
    assert (image.mean((0, 1)) / alpha.mean()) == pytest.approx(0.5, abs=0.02)


def test_taglab_gets_rgb_and_the_pixel_size(two_colors, tmp_path):
    make_ortho(two_colors, tmp_path / "map.tif", pixel=0.02, taglab=True)
    with rasterio.open(tmp_path / "map.tif") as dataset:
        assert dataset.count == 3 and dataset.dtypes[0] == "uint8" and dataset.nodata is None
    assert (tmp_path / "map_pixel_size.txt").read_text() == "20 mm per pixel\n"
    with pytest.raises(InputError, match="32767 a side that TagLab opens: choose a pixel size of at least 0.00012"):
        make_ortho(two_colors, tmp_path / "large.tif", pixel=0.0001, taglab=True)


def test_a_scene_without_a_scale_is_mapped_in_units(tmp_path):
    run = write_run(tmp_path, [sheet(0, 0, 2, 1, 0.1)], measured=None)
    found = make_ortho(run, tmp_path / "map.tif", pixel=0.05)
    assert found["unit"] == "units" and found["width"] == pytest.approx(80, abs=8)  # two units in a metre
    assert "lengths are in units of the scene" in found["notes"][0]
    with rasterio.open(tmp_path / "map.tif") as dataset:
        assert dataset.crs is None and dataset.tags()["UNITS"] == "units of the scene"


def test_local_metres_without_a_coordinate_system(tmp_path):
    run = write_run(tmp_path, [sheet(0, 0, 2, 1, 0.1)], measured=measured(placement=None))
    assert make_ortho(run, tmp_path / "map.tif", pixel=0.05)["crs"] is None
    with rasterio.open(tmp_path / "map.tif") as dataset:
        assert 'LOCAL_CS["Local metres",UNIT["metre",1' in dataset.crs.to_wkt()


@pytest.mark.parametrize("plane", ["fit", "0,0,-1"])
def test_a_wall_is_mapped_from_its_side(plane, tmp_path, monkeypatch):
    """A wall that faces south, red in its upper half: z of the scene is north, y is down."""
    wall = concatenate([sheet(0, 0, 3, 1, 0.05, color=BLUE), sheet(0, 1, 3, 2, 0.05, color=RED)])
    wall.positions[:] = wall.positions[:, [0, 2, 1]] * [1, -1, 1]
    wall.rotations[:] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    run = write_run(tmp_path, [wall])

    class View:
        class camera:  # noqa: N801
            centre = np.array([3.0, -2.0, -10.0])

    class Scene:
        views = [View]

    monkeypatch.setattr("swag_engine.products.map_frame.load_scene", lambda folder: Scene)
    found = make_ortho(run, tmp_path / "map.tif", pixel=0.02, plane=plane)
    assert (found["width"], found["height"]) == (pytest.approx(150, abs=6), pytest.approx(100, abs=6))
    assert found["crs"] is None
    with rasterio.open(tmp_path / "map.tif") as dataset:
        colors = dataset.read()
    np.testing.assert_allclose(colors[:3, 20, 75], 255 * np.array(RED), atol=3)
    np.testing.assert_allclose(colors[:3, 80, 75], 255 * np.array(BLUE), atol=3)


def test_a_splat_file_needs_a_direction(tmp_path):
    splats = sheet(0, 0, 2, 1, 0.1)
    write_ply(tmp_path / "some.ply", splats)
    with pytest.raises(InputError, match="does not say which direction is up: give it with --plane"):
        make_ortho(tmp_path / "some.ply", tmp_path / "map.tif")
    found = make_ortho(tmp_path / "some.ply", tmp_path / "map.tif", plane="0,0,1")
    assert found["unit"] == "units" and found["covered"] > 0.7


@pytest.mark.parametrize(
    "options, message",
    [
        (["--pixel", "-1"], "pixel size is -1: it must be above 0"),
        (["--box", "1", "1", "0", "2"], "left below right"),
        (["--plane", "sideways"], "must be up, fit, or a direction"),
        (["--water", "2"], "from 0 to 1, not 2"),
        (["--pixel", "1e-6"], "more than the 200000 a side that can be mapped"),
    ],
)
def test_options_that_cannot_be_used_are_explained(options, message, two_colors, tmp_path, capsys):
    assert main(["ortho", str(two_colors), "--out", str(tmp_path / "map.tif"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("*.tif*")) and not list(tmp_path.glob(".*"))


def test_a_crs_in_degrees_a_folder_without_a_run_and_a_folder_that_cannot_be_written(two_colors, tmp_path):
    (tmp_path / "degrees").mkdir()
    degrees = measured(placement=Placement("EPSG:4326", (15.0, 36.0, 0.0)))
    run = write_run(tmp_path / "degrees", [sheet(0, 0, 2, 1, 0.1)], measured=degrees)
    with pytest.raises(InputError, match="EPSG:4326 is in degrees, and a map needs metres"):
        make_ortho(run, tmp_path / "map.tif")
    with pytest.raises(InputError, match="is not a training run"):
        make_ortho(tmp_path / "degrees", tmp_path / "map.tif")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="Cannot write"):
        make_ortho(two_colors, tmp_path / "file" / "map.tif", pixel=0.1)
    with pytest.raises(InputError, match="choose a name that ends in .tif"):
        make_ortho(two_colors, tmp_path / "map.jpg", pixel=0.1)


def test_without_the_extra_the_command_says_what_to_install(two_colors, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "rasterio", None)
    assert main(["ortho", str(two_colors), "--out", str(tmp_path / "map.tif")]) == 2
    assert "-m pip install rasterio pyproj shapely" in capsys.readouterr().err


def test_the_pixel_size_follows_the_splats():
    chosen = make_grid(sheet(0, 0, 10, 10, 0.1))
    assert chosen.pixel == pytest.approx(0.1)
    assert make_grid(sheet(0, 0, 10, 10, 0.1), box=(0, 0, 5000, 10)).width <= grid.USUAL_PIXELS


# -- heights ----------------------------------------------------------------------------------------------------------


def waves(x, y):
    return 0.3 * np.sin(2 * x) + 0.2 * y


def test_heights_of_a_known_surface(tmp_path):
    run = write_run(tmp_path, [sheet(0, 0, 4, 3, 0.04, waves)])
    found = make_dem(run, tmp_path / "dem.tif", pixel=0.02, box=(-0.5, 0, 4, 3))
    heights = read_heights(tmp_path / "dem.tif")
    x, y = np.meshgrid(-0.5 + 0.02 * (np.arange(225) + 0.5), 3 - 0.02 * (np.arange(150) + 0.5))
    inside = x > 0.1
    errors = np.abs(heights + 12 - waves(x, y))[inside]
    assert np.median(errors) < 0.004 and np.quantile(errors, 0.95) < 0.04  # a pixel is 0.02
    assert np.isnan(heights[x < -0.15]).all()
    assert found["heights"] == pytest.approx([waves(x, y)[inside].min() - 12, waves(x, y)[inside].max() - 12], abs=0.05)
    with rasterio.open(tmp_path / "dem.tif") as dataset:
        assert dataset.nodata == -9999 and dataset.descriptions == ("first surface", "median height")


def test_the_first_surface_is_above_the_median_where_something_thin_floats(tmp_path):
    haze = sheet(1, 1, 2, 2, 0.1, 1.0)
    haze.opacities[:] = 0.25
    run = write_run(tmp_path, [sheet(0, 0, 3, 3, 0.05), haze])
    make_dem(run, tmp_path / "dem.tif", pixel=0.05, box=(0, 0, 3, 3))
    first, median = (read_heights(tmp_path / "dem.tif", band) + 12 for band in (1, 2))
    np.testing.assert_allclose(first[25:35, 25:35], 1, atol=0.01)
    np.testing.assert_allclose(median[25:35, 25:35], 0, atol=0.01)
    np.testing.assert_allclose(first[5:15, 5:15], 0, atol=0.01)


def test_neighbours_decide_where_layers_leave_the_surface_uncertain_and_nowhere_else(tmp_path):
    """A pit where splats of the surface are faint over others below it, and a narrow opaque post."""
    surface, post = sheet(0, 0, 2, 2, 0.04), sheet(1.48, 1.48, 1.52, 1.52, 0.02, 0.3)
    middle = np.abs(surface.positions[:, :2] - 0.5).max(1) < 0.07
    surface.opacities[middle] = 0.01
    run = write_run(tmp_path, [sheet(0, 0, 2, 2, 0.04, -0.1), surface, post])
    make_dem(run, tmp_path / "dem.tif", pixel=0.02, box=(0, 0, 2, 2))
    heights = read_heights(tmp_path / "dem.tif") + 12
    np.testing.assert_allclose(heights[73:77, 23:27], 0, atol=0.01)
    np.testing.assert_allclose(heights[24:26, 74:76], 0.3, atol=0.02)


def test_a_step_between_two_levels(tmp_path):
    run = write_run(tmp_path, [sheet(0, 0, 4, 2, 0.05), sheet(1, 0.5, 2, 1.5, 0.05, 0.7)])
    make_dem(run, tmp_path / "dem.tif", pixel=0.02, box=(0, 0, 4, 2))
    heights = read_heights(tmp_path / "dem.tif") + 12
    x, y = np.meshgrid(0.02 * (np.arange(200) + 0.5), 2 - 0.02 * (np.arange(100) + 0.5))
    top = (np.abs(x - 1.5) < 0.5) & (np.abs(y - 1) < 0.5)
    assert np.median(np.abs(heights - 0.7 * top)) < 1e-3
    assert (heights > 0.35).sum() == pytest.approx(top.sum(), rel=0.18)  # half a splat at each edge


def test_derived_maps_of_a_slope(tmp_path):
    """30 degrees, up to the east: rugosity 1 / cos 30, light from the north-west."""
    run = write_run(tmp_path, [sheet(0, 0, 3, 3, 0.05, lambda x, y: x / np.sqrt(3))])
    found = make_dem(
        run, tmp_path / "dem.tif", pixel=0.05, box=(0, 0, 3, 3), derived=("hillshade", "slope", "rugosity"), window=0.5
    )
    assert found["rugosity"] == pytest.approx(1 / np.cos(np.radians(30)), abs=0.005)
    maps = {
        name: rasterio.open(tmp_path / f"dem_{name}.tif").read(1)[10:50, 10:50]
        for name in ("hillshade", "slope", "rugosity")
    }
    np.testing.assert_allclose(maps["slope"], 30, atol=0.5)
    np.testing.assert_allclose(maps["rugosity"], 1.1547, atol=0.01)
    light, normal = np.array([-0.5, 0.5, np.sqrt(0.5)]), np.array([-0.5, 0, np.sqrt(0.75)])
    np.testing.assert_allclose(maps["hillshade"], 1 + 254 * light @ normal, atol=3)


def test_derived_maps_beside_holes():
    heights = np.tile(np.arange(9.0), (9, 1))
    heights[4, 4] = np.nan
    for values in (slope(heights, 1), rugosity(heights, 1, 3), hillshade(heights, 1)):
        assert np.isnan(values[4, 4]) and np.isfinite(np.delete(values.ravel(), 40)).all()
    np.testing.assert_allclose(slope(heights, 1)[4, 3], 45)


def test_the_command_tells_heights(tmp_path, capsys):
    run = write_run(tmp_path, [sheet(0, 0, 2, 2, 0.1, 0.5)])
    arguments = ["dem", str(run), "--out", str(tmp_path / "dem.tif"), "--pixel", "0.1", "--derived", "slope"]
    assert main(arguments) == 0
    assert "Heights -11.5 to -11.5 m, surface over planar area 1.000" in capsys.readouterr().out
    assert main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["files"][1].endswith("dem_slope.tif")


def test_previews_are_transparent_where_nothing_was_seen_and_in_the_colors_of_the_map(tmp_path):
    run = write_run(tmp_path, [sheet(0, 0, 2, 2, 0.05), sheet(2, 0, 4, 2, 0.05, 0.5)])
    found = make_dem(run, tmp_path / "dem.tif", pixel=0.02, box=(-1, 0, 4, 2))
    image = cv2.imread(found["preview"], cv2.IMREAD_UNCHANGED)
    assert image.shape == (600, 1500, 4) and not image[300:360, 120:270, 3].any() and (image[:, 360:, 3] == 255).all()
    low, high = image[360, 540, :3].astype(int), image[360, 1200, :3].astype(int)
    assert high[1] > low[1] + 80 and low[0] > high[0]  # from blue to yellow
    to_map, extent = np.array(found["to_map"]), found["extent"]
    np.testing.assert_allclose(to_map, GEOREFERENCE.matrix)
    assert extent == pytest.approx([-1, 0, 4, 2]) and found["top"] == pytest.approx(0.5)


def test_the_volume_above_a_plane(tmp_path, capsys):
    """A block of 1 m by 1 m, 30 cm above the ground at -12 m, and a hole beside it."""
    parts = [sheet(0, 0, 4, 1, 0.03), sheet(0, 1, 4, 2, 0.03), sheet(1, 0.5, 2, 1.5, 0.02, 0.3)]
    run = write_run(tmp_path, parts)
    options = ["--pixel", "0.02", "--box", "0", "0", "4", "3", "--above", "-11.95"]
    assert main(["dem", str(run), "--out", str(tmp_path / "dem.tif"), *options, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["volume"]
    assert found["volume"] == pytest.approx(0.25 * 1.04**2, rel=0.03)  # half a splat at each edge
    assert found["area"] == pytest.approx(1.04**2, rel=0.03)
    assert main(["dem", str(run), "--out", str(tmp_path / "dem.tif"), *options]) == 0
    assert "Above -11.95 m: 0.2" in capsys.readouterr().out
    with pytest.raises(InputError, match="The height of the plane is nan: give --above a number"):
        make_dem(run, tmp_path / "dem.tif", above=float("nan"))


def test_noise_of_heights_is_little_surface():
    """Level ground with a noise of half a pixel, and a hole: 12 % of surplus surface becomes a few."""
    heights = np.random.default_rng(0).normal(0, 0.5, (200, 200))
    heights[50:60, 50:60] = np.nan
    factor = surface_factor(heights, 1.0)
    assert np.isnan(factor[50:60, 50:60]).all() and np.nanmean(factor) < 1.04
    down, right = np.gradient(heights)
    assert np.nanmean(np.sqrt(1 + down**2 + right**2)) > 1.11
    slope_only = np.tile(np.arange(50.0), (50, 1))
    np.testing.assert_allclose(surface_factor(slope_only, 1.0)[5:-5, 5:-5], np.sqrt(2), atol=1e-6)


@pytest.mark.parametrize("step", [1, 4])
def test_a_rough_surface_keeps_its_area_under_noise(step):
    """Waves of 30 steps and slopes of 45 degrees, with errors that are alike within a step."""
    x, y = np.meshgrid(np.arange(90.0 * step), np.arange(60.0 * step))
    waves = 30 * step / (2 * np.pi) * np.sin(2 * np.pi * x / (30 * step))
    truth = np.sqrt(1 + np.cos(2 * np.pi * x / (30 * step)) ** 2).mean()
    errors = np.random.default_rng(0).normal(0, 0.3 * step, (60, 90)).repeat(step, axis=0).repeat(step, axis=1)
    for noise, bound in ((0, 0.02), (1, 0.04)):
        assert surface_factor(waves + noise * errors, 1.0, step).mean() == pytest.approx(truth, rel=bound)
    assert surface_factor(waves + errors, 1.0).mean() > 1.04 * truth or step == 1


def test_the_surface_does_not_grow_with_smaller_pixels(tmp_path):
    """Level splats, a fifth of them 12 mm higher or lower: most of what their edges add is no surface at any pixel."""
    ground = sheet(0, 0, 1.5, 1, 0.025)
    random = np.random.default_rng(0)
    ground.positions[:, 2] += 0.012 * random.choice([-1, 0, 1], len(ground), p=[0.1, 0.8, 0.1])
    run = write_run(tmp_path, [ground])
    found = []
    for pixel in (0.015, 0.005, 0.0025):
        made = make_dem(run, tmp_path / "dem.tif", pixel, (0.1, 0.1, 1.4, 0.9), derived=("rugosity",))
        with rasterio.open(tmp_path / "dem_rugosity.tif") as dataset:
            assert dataset.read(1).mean() == pytest.approx(made["rugosity"], abs=0.01)
        found.append(made["rugosity"])
    heights = read_heights(tmp_path / "dem.tif")
    assert surface_factor(heights, 0.0025).mean() > 1.1 > 1.05 > max(found), found


# -- what cannot be mapped --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "case, sentence",
    [
        ("no scale", "The scale of scene was not measured: lengths are in units of the scene. Measure it with"),
        ("holes", "50.0% of the map shows nothing: holes have no data and are not filled."),
        ("nothing", "Nothing was seen in the map: it has no data."),
        ("label without splats", "No pixel shows the label seagrass."),
    ],
)
def test_what_is_missing_is_said_in_one_sentence(case, sentence, tmp_path, capsys):
    parts = [sheet(0, 0, 1, 1, 0.02, label=1)] if case == "holes" else [sheet(0, 0, 2, 1, 0.05, label=1)]
    run = write_run(tmp_path, parts, ("sand", "seagrass"), None if case == "no scale" else GEOREFERENCE)
    box = {"holes": ["0", "0", "2", "1"], "nothing": ["8", "8", "9", "9"]}.get(case, ["0", "0", "2", "1"])
    command = "areas" if case == "label without splats" else "dem"
    out = tmp_path / ("areas" if command == "areas" else "dem.tif")
    assert main([command, str(run), "--out", str(out), "--pixel", "0.02", "--box", *box]) == 0
    said = capsys.readouterr().out
    assert sum(sentence in line for line in said.splitlines()) == 1, said


@pytest.mark.parametrize("command", ["ortho", "dem", "areas", "profile", "change"])
@pytest.mark.parametrize("case", ["degrees", "folder"])
def test_what_cannot_be_written_is_refused_in_one_sentence(command, case, tmp_path, capsys):
    degrees = measured(placement=Placement("EPSG:4326", (15.0, 36.0, 0.0)))
    splats = sheet(0, 0, 2, 1, 0.05, lambda x, y: 0.1 * np.sin(5 * x), label=1)
    run = write_run(tmp_path, [splats], ("sand",), degrees if case == "degrees" else GEOREFERENCE)
    (tmp_path / "file").touch()
    name = {"profile": "line.csv", "areas": "areas", "change": "change"}.get(command, "map.tif")
    out = tmp_path / ("maps" if case == "degrees" else "file") / name
    more = {"profile": ["--line", "0", "0", "2", "1"], "change": [str(run)]}.get(command, [])
    assert main([command, str(run), *more, "--out", str(out), "--pixel", "0.1"]) == 2
    said = capsys.readouterr().err.splitlines()
    wanted = {"degrees": "EPSG:4326 is in degrees, and a map needs metres", "folder": "Cannot write "}[case]
    assert wanted in said[-1] and not (tmp_path / "maps").exists()
    assert "choose another folder" in said[-1] or case == "degrees"


@pytest.mark.parametrize("command", ["ortho", "dem"])
def test_a_wall_needs_its_plane(command, tmp_path, capsys):
    """A vertical wall seen from above has next to no area: the sentence says how to see it from its side."""
    wall = sheet(0, 0, 3, 2, 0.05)
    wall.positions[:] = wall.positions[:, [0, 2, 1]] * [1, -1, 1]
    wall.rotations[:] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    run = write_run(tmp_path, [wall])
    assert main([command, str(run), "--out", str(tmp_path / "map.tif"), "--pixel", "0.02"]) == 0
    assert "is mostly steep: for a wall, map it from its side with --plane fit" in capsys.readouterr().out
