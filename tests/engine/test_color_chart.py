"""Color charts: found whatever their place and light, their colors corrected, and what they say about the water."""

import json
from io import StringIO
from pathlib import Path

import cv2
import numpy as np
import pytest

from swag_engine.app.cli import main
from swag_engine.app.worker import Worker
from swag_engine.base.errors import InputError
from swag_engine.base.transfer import linear_to_srgb
from swag_engine.colorchart.chart_attenuation import chart_attenuation
from swag_engine.colorchart.chart_kinds import PATCH, chart_kinds
from swag_engine.colorchart.chart_pose import chart_ranges
from swag_engine.colorchart.color_correction import (
    ColorCorrection,
    differences,
    fit_correction,
    left_out_images,
    left_out_patches,
)
from swag_engine.colorchart.find_chart import chart_at, find_chart
from swag_engine.colorchart.scene_charts import _undistorted, parse_corners
from swag_engine.experiments.color_chart import describe, measure_chart
from swag_engine.experiments.report import write_report
from swag_engine.experiments.restore_patches import even_values
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import View, load_scene
from swag_engine.scene.lenses import Lens, source_map
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.chart_scene import (
    B_INF,
    BETA_B,
    BETA_D,
    Shot,
    patch_ranges,
    render,
    to_pixels,
    to_world,
    write_scene,
)

CLASSIC = chart_kinds()["24"]
REEF = Path(__file__).parents[1] / "scenes" / "reef_wreck" / "images"
PLACES = ((0, 0, 0), (0.3, 0.1, -1), (-0.3, -0.1, -2), (0.2, 0, 0.8), (-0.4, 0.1, -0.5), (0.4, -0.2, -1.5))
SHOTS = [Shot(place=place, tilt=15, size=(480, 360)) for place in PLACES]


def found(shot):
    pixels = render(shot)
    return find_chart(pixels, np.ones(pixels.shape[:2], bool), chart_kinds()[shot.chart or "24"])


def camera_of(shot, name="photo"):
    pose = np.eye(4)
    pose[:3, 3] = -np.array(shot.place)
    width, height = shot.size
    return Camera(name, width, height, shot.focal, shot.focal, width / 2, height / 2, pose)


@pytest.fixture(scope="module")
def observations():
    return [found(shot) for shot in SHOTS]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("chart") / "dive", SHOTS)


def test_the_known_colors_are_the_published_ones():
    """Nominal 8-bit sRGB values of the 24-patch chart, as published with it; editions differ by some steps."""
    published = [(115, 82, 68), (194, 150, 130), (98, 122, 157), (87, 108, 67), (133, 128, 177), (103, 189, 170)]
    assert linear_to_srgb(CLASSIC.light[:6]) * 255 == pytest.approx(np.array(published), abs=13)
    assert linear_to_srgb(CLASSIC.light[18:]) * 255 == pytest.approx(
        np.repeat([[243], [200], [160], [122], [85], [52]], 3, axis=1), abs=4
    )
    assert np.flatnonzero(CLASSIC.neutral).tolist() == [18, 19, 20, 21, 22, 23]


@pytest.mark.parametrize(
    ("shot", "hidden"),
    [
        pytest.param(Shot(), (), id="plain"),
        pytest.param(Shot(tilt=50), (), id="tilted"),
        pytest.param(Shot(roll=35, tilt=20), (), id="askew"),
        pytest.param(Shot(roll=180), (), id="upside down"),
        pytest.param(Shot(width=0.18), (), id="small"),
        pytest.param(Shot(exposure=0.25), (), id="dim"),
        pytest.param(Shot(beta_D=np.array([3.0, 0.3, 0.2])), (), id="without red"),
        pytest.param(Shot(covered=0.5), (0, 1, 2), id="half covered"),
        pytest.param(Shot(shadow=0.5), (0, 1, 2), id="half in shadow"),
        pytest.param(Shot(chart="140", width=1.4, roll=180), (), id="140 patches"),
    ],
)
def test_a_chart_is_found_and_what_is_hidden_is_left_out(shot, hidden):
    kind = chart_kinds()[shot.chart]
    observation = found(shot)
    true = to_pixels(shot, to_world(shot, kind.outline))
    patch = PATCH * shot.width / kind.size[0] / (shot.centre[2] - shot.place[2]) * shot.focal
    assert shot.width > 0.18 or patch < 6.5  # the small one is small
    assert np.abs(observation.corners - true).max() < 0.25 * patch
    column = np.arange(len(kind.light)) % kind.columns
    assert not observation.used[np.isin(column, hidden) & (kind.light.max(1) > 0.1)].any()
    assert observation.used[~np.isin(column, hidden)].mean() > 0.9
    assert observation.upside_down == (shot.roll == 180)


def test_nothing_is_found_where_there_is_no_chart():
    assert found(Shot(chart=None)) is None
    for path in sorted(REEF.iterdir())[:1]:
        pixels = cv2.imread(str(path))[..., ::-1]
        assert find_chart(pixels, np.ones(pixels.shape[:2], bool), CLASSIC) is None


def test_clipped_and_masked_patches_are_left_out():
    pixels = render(Shot(exposure=2.0))
    valid = np.ones(pixels.shape[:2], bool)
    observation = find_chart(pixels, valid, CLASSIC)
    assert not observation.used[18]  # white
    x, y = observation.centres[13].astype(int)
    valid[y, x] = False
    again = chart_at(pixels, valid, CLASSIC, observation.corners)
    assert observation.used[13] and not again.used[13]


@pytest.mark.parametrize("first", [0, 3])
@pytest.mark.parametrize("step", [1, -1])
def test_corners_by_hand_may_begin_anywhere_and_go_either_way(first, step):
    shot = Shot(tilt=30)
    pixels = render(shot)
    corners = np.roll(to_pixels(shot, to_world(shot, CLASSIC.patch_outline)), first, axis=0)[::step]
    moved = corners + np.random.default_rng(0).uniform(-4, 4, (4, 2))
    observation = chart_at(pixels, np.ones(pixels.shape[:2], bool), CLASSIC, moved)
    assert np.abs(observation.corners - to_pixels(shot, to_world(shot, CLASSIC.outline))).max() < 4
    assert observation.used.all()


def test_corners_in_a_distorted_photo_are_undistorted():
    lens = Lens("SIMPLE_RADIAL", 400, 300, (350.0, 200.0, 150.0, 0.15))
    pinhole = lens.pinhole
    camera = Camera("a.png", pinhole.width, pinhole.height, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, np.eye(4))
    at = np.array([[40, 30], [300, 40], [310, 200], [50, 210]])
    in_file = source_map(lens)[0][at[:, 1], at[:, 0]].astype(float)
    path = Path(REEF, "..", "lens.png")
    view = View(camera, lens, path, np.empty(0, int))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "swag_engine.colorchart.scene_charts.read_image", lambda *_: (np.zeros((300, 400, 3), np.uint8), None)
        )
        assert _undistorted(in_file, view, camera) == pytest.approx(at + 0.5, abs=1e-3)


def test_ranges_of_the_patches_follow_from_the_corners(observations):
    ranges = chart_ranges([camera_of(shot) for shot in SHOTS], observations).ranges
    assert ranges == pytest.approx(np.stack([patch_ranges(shot) for shot in SHOTS]), rel=0.02)


def test_ranges_of_a_half_covered_chart_follow_from_the_patches_that_are_seen():
    shots = [Shot(place=place, tilt=15, size=(480, 360), covered=0.5) for place in PLACES[:3]]
    covered = [found(shot) for shot in shots]
    assert all(observation.used.sum() < 15 for observation in covered)
    ranges = chart_ranges([camera_of(shot) for shot in shots], covered).ranges
    assert ranges == pytest.approx(np.stack([patch_ranges(shot) for shot in shots]), rel=0.03)


def test_holes_in_the_splats_and_hidden_patches_do_not_bend_the_water_over_a_chart():
    places = CLASSIC.centres
    even = 0.3 + places @ np.array([[0.01, 0.02, 0.0], [0.0, -0.01, 0.01]])
    values, used = even.copy(), np.ones(24, bool)
    values[[3, 8, 9, 20]] = 0  # holes
    values[12:18] *= 3  # something in front
    used[12:18] = False
    assert even_values(places, values, used) == pytest.approx(even, abs=1e-3)


def test_ranges_are_not_claimed_for_a_chart_that_moved_or_is_in_one_photo(observations):
    cameras = [camera_of(shot) for shot in SHOTS]
    carried = [camera_of(Shot(place=(x, y, z), size=(480, 360))) for x, y, z in PLACES[1:] + PLACES[:1]]
    assert "moved" in chart_ranges(carried, observations).problem
    assert "one photo" in chart_ranges(cameras[:1], observations[:1]).problem
    assert "one place" in chart_ranges([cameras[0]] * 2, [observations[0]] * 2).problem


def test_the_chart_says_the_attenuation(observations):
    light, used = (np.stack([getattr(one, name) for one in observations]) for name in ("light", "used"))
    ranges = np.stack([patch_ranges(shot) for shot in SHOTS])
    attenuation = chart_attenuation(light, used, ranges, CLASSIC)
    assert attenuation.beta_D == pytest.approx(BETA_D, abs=0.004)
    assert (attenuation.error < 0.01).all() and (attenuation.error > 0).all()
    assert "3 photos" in chart_attenuation(light[:2], used[:2], ranges[:2], CLASSIC).problem
    alike = chart_attenuation(light[:1].repeat(3, 0), used[:3], ranges[:1].repeat(3, 0), CLASSIC)
    assert "distances" in alike.problem


def test_the_correction_is_found_and_grey_stays_grey():
    mix = np.array([[0.8, 0.15, 0.05], [0.1, 0.8, 0.1], [0.02, 0.2, 0.78]])
    cast = CLASSIC.light @ (mix * [[0.6], [1.0], [0.8]]).T * 0.5
    measured, used = np.stack([cast, cast]), np.ones((2, 24), bool)
    correction = fit_correction(measured, used, CLASSIC)
    assert differences(measured, CLASSIC).mean() > 10
    assert differences(correction.apply(measured), CLASSIC).mean() < 1
    assert correction.matrix.sum(1) == pytest.approx(1)
    assert correction.white @ [0.2126, 0.7152, 0.0722] == pytest.approx(1)
    greys = correction.apply(cast)[CLASSIC.neutral]
    assert np.ptp(greys, axis=1) == pytest.approx(np.ptp(CLASSIC.light[CLASSIC.neutral], axis=1), abs=0.01)


def test_a_left_out_patch_and_a_left_out_photo_do_not_correct_themselves():
    measured, used = np.stack([CLASSIC.light] * 3), np.ones((3, 24), bool)
    measured[:, 5] *= [2, 0.5, 1]  # one patch of another color than known
    measured[1] *= [0.5, 1, 1]  # one photo with a cast
    correction = fit_correction(measured, used, CLASSIC)
    after = differences(correction.apply(measured), CLASSIC)
    assert left_out_patches(measured, used, CLASSIC)[:, 5].mean() > after[:, 5].mean()
    assert left_out_images(measured, used, CLASSIC)[1].mean() > after[1].mean() + 1
    assert fit_correction(measured, ~used, CLASSIC) is None
    assert np.isnan(left_out_images(measured[:1], used[:1], CLASSIC)).all()  # nothing is left


def test_a_correction_is_exposure_times_white_times_matrix():
    correction = ColorCorrection(1.0, np.array([1.0, 2.0, 3.0]), np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1.0]]))
    assert correction.apply(np.array([0.1, 0.2, 0.3])) == pytest.approx([0.4, 0.4, 1.8])


@pytest.mark.parametrize("text", ["0.png", "0.png:1,2,3", "0.png:1,2,3,4,5,6,7,x", ":1,2,3,4,5,6,7,8"])
def test_corners_of_another_form_are_refused(scene, text):
    with pytest.raises(InputError, match="PHOTO:x,y"):
        parse_corners([text], load_scene(scene))


def test_the_command_measures_a_scene(scene, tmp_path, capsys):
    pixels = to_pixels(SHOTS[0], to_world(SHOTS[0], CLASSIC.patch_outline))
    corners = "0.png:" + ",".join(str(round(value)) for value in pixels.ravel())
    assert main(["chart", str(scene), "--corners", corners, "--out", str(tmp_path / "c.json"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / "c.json").read_text())
    assert [photo["name"] for photo in document["photos"]] == [f"{i}.png" for i in range(6)]
    assert document["delta_e"]["corrected"] < document["delta_e"]["photos"] - 5
    assert document["beta_D"]["chart"] == pytest.approx(BETA_D, abs=0.01)
    assert not (scene / "chart.json").exists()


def test_a_chart_that_is_not_found_is_measured_between_marked_corners(tmp_path):
    shot = Shot(tilt=80, roll=30, place=(0, 0, 1.2))  # seen from the side
    assert found(shot) is None
    scene = write_scene(tmp_path / "dive", [shot, Shot(chart=None)])
    corners = to_pixels(shot, to_world(shot, CLASSIC.patch_outline)) + np.random.default_rng(0).uniform(
        -1.5, 1.5, (4, 2)
    )
    marked = "0.png:" + ",".join(f"{value:.6f}" for value in (corners / shot.size).ravel())
    read = []
    document = measure_chart(scene, progress=lambda stage, _: read.append(stage), marked=marked)
    assert read == ["Find the color chart: photo 1 of 1"] and [photo["name"] for photo in document["photos"]] == [
        "0.png"
    ]
    assert document["delta_e"]["corrected"] < document["delta_e"]["photos"] - 5


def test_the_command_says_what_to_do_without_a_chart(scene, tmp_path, capsys):
    bare = write_scene(tmp_path / "bare", [Shot(chart=None, place=place, size=(160, 120)) for place in PLACES[:2]])
    assert main(["chart", str(bare)]) == 2
    assert "--corners PHOTO:x,y" in capsys.readouterr().err
    assert main(["chart", str(scene), "--corners", "0.png:1,1,60,1,60,40,1,40"]) == 2
    assert "0.png shows no 24-patch color chart between the given corners" in capsys.readouterr().err


def test_a_run_restores_the_chart_and_its_report_compares_the_water(scene, tmp_path):
    run = tmp_path / "run"
    settings = TrainSettings(iterations=150, width=240, max_gaussians=4000, sh_degree=0)
    train(scene, run, settings)
    events = StringIO()
    request = json.dumps({"request": "chart", "run": str(run)})
    Worker(StringIO(request), events).run()  # the end of the requests cancels
    assert "nothing was written" in json.loads(events.getvalue().splitlines()[-1])["message"]
    assert not (run / "chart.json").exists()
    child = Worker(StringIO(request), events)
    child.stop.set = lambda: None  # type: ignore[method-assign]
    child.run()
    answer = json.loads(events.getvalue().splitlines()[-1])
    document = json.loads((run / "chart.json").read_text())
    assert answer["event"] == "result" and answer["delta_e"] == document["delta_e"]
    text = describe(document)
    delta_e = document["delta_e"]
    assert delta_e["corrected"] < min(delta_e["photos_corrected"], delta_e["restored"], delta_e["photos"] / 2)
    assert delta_e["left_out_patches"] >= delta_e["corrected"] * 0.98
    water = json.loads((run / "water.json").read_text())
    assert document["beta_D"]["run"] == water["beta_D"]
    assert "Attenuation of the run" in text and "each patch left out" in text
    page = write_report(run).read_text(encoding="utf-8")
    assert "<h2>Color chart</h2>" in page and "from the chart" in page
    (run / "chart.json").write_text('{"photos": 3}')
    assert "<h2>Color chart</h2>" not in write_report(run).read_text(encoding="utf-8")


def test_the_water_of_the_scene_is_what_the_photos_show():
    """The generator itself: the light of a patch is the formula's."""
    shot = Shot(size=(480, 360))
    observation, far = found(shot), patch_ranges(shot)[:, None]
    expected = 0.9 * (CLASSIC.light * np.exp(-BETA_D * far) + B_INF * (1 - np.exp(-BETA_B * far)))
    assert observation.light == pytest.approx(expected, abs=0.01)
