"""Films: camera paths, image sequences, videos, alpha and depth."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from swag_engine.base.errors import InputError
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.experiments.evaluate_run import load_newest
from swag_engine.experiments.film import (
    EMPTY_DEPTH,
    FilmModel,
    FilmOptions,
    describe,
    film_model,
    film_run,
    render_film,
)
from swag_engine.formats.camera_path import PathFrame, read_camera_path, write_camera_path
from swag_engine.formats.exr import write_exr
from swag_engine.formats.ply import write_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.scene_part import without_points, write_part
from swag_engine.splats.splats import Splats
from swag_engine.water.medium import Medium
from tests.engine.exr_files import read_exr
from tests.scenes.small_surveys import make_survey, random_splats


def wall(depth=4.0, side=200):
    """A model of one opaque wall of splats at z = depth, one red half and one green half, over a blue background."""
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    count = x.size
    color = np.where(x.reshape(-1, 1) < 0, (0.8, 0.1, 0.1), (0.1, 0.8, 0.1))
    splats = Splats(
        positions=np.stack([x.ravel(), y.ravel(), np.full(count, depth)], axis=1).astype("f4"),
        rotations=np.tile(np.array([1, 0, 0, 0], "f4"), (count, 1)),
        scales=np.full((count, 3), (0.02, 0.02, 0.001), "f4"),
        opacities=np.full(count, 0.99, "f4"),
        sh=((color - 0.5) / 0.28209479177387814)[:, None].astype("f4"),
    )
    return FilmModel(GaussianCloud.from_splats(splats, (0.1, 0.2, 0.6)), SceneEffects()), splats


def front(name="0001", width=64, height=48):
    """A camera at the origin with a focal length that shows the wall and its surroundings."""
    return Camera(name, width, height, 80.0, 80.0, width / 2, height / 2, np.eye(4))


def frames(count):
    path = [front(f"{number:04d}") for number in range(1, count + 1)]
    for number, camera in enumerate(path):
        camera.world_to_camera[0, 3] = 0.1 * number
    return [PathFrame(camera) for camera in path]


def read_image(path):
    return cv2.cvtColor(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGR2RGB)


def test_a_path_is_read_as_it_was_written(tmp_path):
    turn = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, -2], [0, 0, 1, 3], [0, 0, 0, 1]])
    camera = Camera("0007", 640, 360, 500.5, 510.25, 300.0, 190.0, turn)
    write_camera_path(tmp_path / "path.json", [PathFrame(camera, 0.25), PathFrame(replace(camera, name="0008"))])
    first, second = read_camera_path(tmp_path / "path.json")
    assert (first.water, second.water, second.camera.name) == (0.25, None, "0008")
    np.testing.assert_allclose(first.camera.world_to_camera, turn, atol=1e-12)
    np.testing.assert_array_equal(first.camera.K, camera.K)


def test_intrinsics_of_the_whole_file_hold_for_every_frame(tmp_path):
    pose = np.diag([1.0, -1, -1, 1]).tolist()
    document = {"w": 32, "h": 24, "fl_x": 40.0, "frames": [{"file_path": "images/a.jpg", "transform_matrix": pose}]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    (frame,) = read_camera_path(tmp_path / "transforms.json")
    assert frame.camera.name == "a"
    np.testing.assert_array_equal(frame.camera.K, [[40, 0, 16], [0, 40, 12], [0, 0, 1]])
    np.testing.assert_array_equal(frame.camera.world_to_camera, np.eye(4))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"w": 0}, "an image of 0 x 24 pixels"),
        ({"w": 10**6}, "an image of 1000000 x 24 pixels"),
        ({"fl_x": -1}, "focal length"),
        ({"transform_matrix": [[1]]}, "4 x 4"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "rotation"),
        ({"water": 2}, "from 0 to 1"),
        ({"h": None}, "cannot be read"),
    ],
)
def test_a_damaged_frame_is_named(tmp_path, change, sentence):
    whole = {"w": 32, "h": 24, "fl_x": 40.0, "transform_matrix": np.eye(4).tolist()}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": [whole, whole | change]}))
    with pytest.raises(InputError, match=sentence) as caught:
        read_camera_path(path)
    assert str(caught.value).startswith(f"Frame 2 of {path} ")


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"frames": []}', '{"frames": [1]}', '{"frames": 7}'])
def test_what_is_no_camera_path_is_refused(tmp_path, text):
    (tmp_path / "path.json").write_text(text)
    with pytest.raises(InputError):
        read_camera_path(tmp_path / "path.json")


def test_two_frames_of_one_name_are_refused(tmp_path):
    write_camera_path(tmp_path / "path.json", [PathFrame(front("a")), PathFrame(front("A"))])
    with pytest.raises(InputError, match="two frames called A"):
        read_camera_path(tmp_path / "path.json")


def test_an_image_of_floats_is_read_back(tmp_path):
    # More than one block of 16 lines, and noise, which does not compress.
    values = np.random.default_rng(0).normal(size=(37, 23)).astype("f4")
    values[20:] = 5.0
    write_exr(tmp_path / "depth.exr", values)
    read = read_exr(tmp_path / "depth.exr")
    np.testing.assert_array_equal(read if read.ndim == 2 else read[..., 0], values)


def test_alpha_over_the_background_is_the_image_with_background(tmp_path):
    model, _ = wall()
    path = [PathFrame(front())]
    render_film(model, tmp_path / "with", path, FilmOptions())
    render_film(model, tmp_path / "without", path, FilmOptions(alpha=True))
    whole = read_image(tmp_path / "with" / "0001.png").astype(float)
    rgba = cv2.imread(str(tmp_path / "without" / "0001.png"), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]].astype(float)
    alpha = rgba[..., 3:] / 255
    assert alpha[24, 32] > 0.99 and alpha[0, 0] == 0
    over = rgba[..., :3] * alpha + np.array([0.1, 0.2, 0.6]) * 255 * (1 - alpha)
    assert np.abs(over - whole).max() <= 1.5


@pytest.mark.parametrize("amount", [0.0, 0.6, 1.0])
def test_alpha_leaves_out_the_background_light(amount):
    model, _ = wall()
    medium = Medium.starting(4.0, B=torch.tensor([0.1, 0.3, 0.5]))
    camera = front()
    picture = render(model.cloud, camera, medium=medium, amount=amount)
    premultiplied = render(model.cloud, camera, medium=medium, amount=amount, with_background=False)
    assert premultiplied.color[0, 0].abs().max() == 0
    # The background light alone, behind no Gaussians.
    empty = Splats(
        np.full((1, 3), -9, "f4"),
        np.eye(1, 4, dtype="f4"),
        np.ones((1, 3), "f4"),
        np.ones(1, "f4"),
        np.zeros((1, 1, 3), "f4"),
    )
    behind = render(GaussianCloud.from_splats(empty, (0.1, 0.2, 0.6)), camera, medium=medium, amount=amount)
    over = premultiplied.color + (1 - premultiplied.alpha[..., None]) * behind.color
    assert (over - picture.color).abs().max() < 1e-5


def test_depth_is_along_the_axis_of_the_camera_and_far_where_nothing_is(tmp_path):
    model, _ = wall(depth=4.0)
    render_film(model, tmp_path, [PathFrame(front())], FilmOptions(depth=True, unit=0.5))
    depth = read_exr(tmp_path / "depth" / "0001.exr")
    depth = depth if depth.ndim == 2 else depth[..., 0]
    alpha = render(model.cloud, front()).alpha.numpy()
    # In the middle and near the corners of the wall: the range differs by 6 %, the depth does not.
    assert np.abs(depth[alpha > 0.99] - 2.0).max() < 0.02
    assert (depth[0, 0], depth[24, 0]) == (np.float32(EMPTY_DEPTH),) * 2


def test_existing_frames_are_kept_unless_overwritten(tmp_path):
    model, _ = wall()
    (tmp_path / "0002.png").write_bytes(b"mine")
    result = render_film(model, tmp_path, frames(3), FilmOptions())
    assert (result["rendered"], result["kept"]) == (2, 1)
    assert (tmp_path / "0002.png").read_bytes() == b"mine"
    assert "1 of them existed" in describe(result)
    assert render_film(model, tmp_path, frames(3), FilmOptions(overwrite=True))["rendered"] == 3
    assert read_image(tmp_path / "0002.png").shape == (48, 64, 3)


def test_a_stopped_sequence_keeps_its_frames_and_goes_on(tmp_path):
    model, _ = wall()
    done = []
    stopped = render_film(
        model, tmp_path, frames(4), FilmOptions(),
        progress=lambda *figures: done.append(figures), should_stop=lambda: len(done) == 2,
    )  # fmt: skip
    assert stopped["interrupted"] and done == [(1, 4), (2, 4)]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0001.png", "0002.png"]
    assert describe(stopped).startswith("Stopped after 2 of 4 frames")
    assert render_film(model, tmp_path, frames(4), FilmOptions())["kept"] == 2


def test_a_video_shows_the_frames_and_alpha_is_a_second_one(tmp_path):
    model, _ = wall()
    out = tmp_path / "film.mp4"
    render_film(model, out, frames(5), FilmOptions(alpha=True, depth=True, fps=12))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["film.mp4", "film_alpha.mp4", "film_depth"]
    assert len(list((tmp_path / "film_depth").iterdir())) == 5
    video, matte = cv2.VideoCapture(str(out)), cv2.VideoCapture(str(tmp_path / "film_alpha.mp4"))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (5, 12)
    for frame in frames(5):
        seen, alpha = video.read()[1], matte.read()[1]
        expected = render(model.cloud, frame.camera, with_background=False)
        assert np.abs(alpha[..., 0] / 255.0 - expected.alpha.numpy()).mean() < 0.03
        solid = expected.alpha.numpy() > 0.99
        assert np.abs(seen[..., ::-1] / 255.0 - expected.color.numpy())[solid].mean() < 0.06


def test_a_stopped_video_is_not_written_and_an_existing_one_stays(tmp_path):
    model, _ = wall()
    out = tmp_path / "film.mp4"
    done = []
    stopped = render_film(
        model, out, frames(3), FilmOptions(alpha=True),
        progress=lambda *figures: done.append(figures), should_stop=lambda: bool(done),
    )  # fmt: skip
    assert stopped["interrupted"] and not list(tmp_path.iterdir()) and "not written" in describe(stopped)
    out.write_bytes(b"mine")
    with pytest.raises(InputError, match="exists already"):
        render_film(model, out, frames(3), FilmOptions())
    assert out.read_bytes() == b"mine"


def test_a_video_of_different_sizes_is_refused(tmp_path):
    model, _ = wall()
    path = [PathFrame(front("a")), PathFrame(front("b", width=32))]
    with pytest.raises(InputError, match="a has 64 x 48 pixels and b 32 x 48"):
        render_film(model, tmp_path / "film.mp4", path, FilmOptions())
    assert not list(tmp_path.iterdir())


def test_a_frame_has_its_own_amount_of_water(tmp_path):
    model, _ = wall()
    model.effects.models["medium"] = Medium.starting(4.0, B=torch.tensor([0.1, 0.3, 0.5]))
    path = [PathFrame(front("none"), 0.0), PathFrame(front("all"), 1.0), PathFrame(front("default"))]
    render_film(model, tmp_path, path, FilmOptions(), water=1.0)
    none, whole, default = (read_image(tmp_path / f"{name}.png") for name in ("none", "all", "default"))
    assert np.abs(none.astype(int) - whole).max() > 20
    np.testing.assert_array_equal(whole, default)


def test_splats_of_a_file_with_the_effects_of_their_run_are_the_run(finished_run, tiny_scene, tmp_path):
    """The way of Blender, by a PLY of the splats, gives the image of the checkpoint."""
    cloud, effects, _ = load_newest(finished_run)
    _, settings, _ = RunFolder(finished_run).read_config()
    write_ply(tmp_path / "splats.ply", cloud.to_splats(settings.sh_degree))
    model = film_model(tmp_path / "splats.ply", finished_run)
    for view in load_scene(tiny_scene).views[:3]:
        expected = render(cloud, view.camera, settings.sh_degree, effects.medium, lamp=effects.lamp).color
        seen = render(model.cloud, view.camera, 3, model.effects.medium, lamp=model.effects.lamp).color
        assert (seen - expected).square().mean() < 1e-9, "less than 90 dB"


def test_splats_without_a_run_take_water_and_background_from_files(tmp_path):
    model, splats = wall()
    medium = Medium.starting(4.0, "srgb", B=torch.tensor([0.1, 0.3, 0.5]))
    write_ply(tmp_path / "splats.ply", splats)
    (tmp_path / "water.json").write_text(json.dumps(medium.to_json()))
    loaded = film_model(tmp_path / "splats.ply", None, tmp_path / "water.json", (0.1, 0.2, 0.6))
    seen = render(loaded.cloud, front(), medium=loaded.effects.medium).color
    assert (seen - render(model.cloud, front(), medium=medium).color).abs().max() < 1e-3
    # Water that only attenuates has the background color behind it, at any amount.
    medium.background_sh = medium.backscatter = None
    (tmp_path / "water.json").write_text(json.dumps(medium.to_json()))
    loaded = film_model(tmp_path / "splats.ply", None, tmp_path / "water.json", (0.1, 0.2, 0.6))
    for amount in (0.0, 0.3, 1.0):
        seen = render(loaded.cloud, front(), medium=loaded.effects.medium, amount=amount).color
        wanted = render(model.cloud, front(), medium=medium, amount=amount).color
        assert (seen - wanted).abs().max() < 1e-3 and (seen[0, 0] - torch.tensor([0.1, 0.2, 0.6])).abs().max() < 1e-3
    (tmp_path / "water.json").write_text(json.dumps({"beta_D": [1]}))
    with pytest.raises(InputError, match="coefficients"):
        film_model(tmp_path / "splats.ply", None, tmp_path / "water.json")


def test_a_run_is_rendered_along_a_path(finished_run, tiny_scene, tmp_path):
    scene = load_scene(tiny_scene)
    view = next(view for view in scene.views if view.name in scene.split.train)
    result = film_run(finished_run, tmp_path / "film", [PathFrame(replace(view.camera, name="0001"))], FilmOptions())
    cloud, effects, _ = load_newest(finished_run)
    _, settings, _ = RunFolder(finished_run).read_config()
    expected = render(cloud, view.camera, settings.sh_degree, effects.medium, lamp=effects.lamp).color
    seen = read_image(tmp_path / "film" / "0001.png")
    np.testing.assert_array_equal(seen, (expected.clamp(0, 1) * 255).round().byte().numpy())
    assert result["rendered"] == 1
    with pytest.raises(InputError, match="from 0 to 1"):
        film_run(finished_run, tmp_path, [PathFrame(view.camera)], FilmOptions(), water=2)


def test_a_film_wider_than_the_training_images_keeps_their_detail(finished_run, tiny_scene, tmp_path):
    scene, (_, settings, _) = load_scene(tiny_scene), RunFolder(finished_run).read_config()
    camera = replace(next(view.camera for view in scene.views if view.name in scene.split.train), name="0001")
    film_run(finished_run, tmp_path, [PathFrame(camera.resized(4 * settings.width))], FilmOptions())
    film_run(finished_run, tmp_path / "small", [PathFrame(camera.resized(settings.width))], FilmOptions())
    wide, small = read_image(tmp_path / "0001.png"), read_image(tmp_path / "small" / "0001.png")
    enlarged = cv2.resize(small, wide.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    cloud, effects, _ = load_newest(finished_run)
    thin = render(cloud, camera.resized(4 * settings.width), 3, effects.medium, lamp=effects.lamp).color
    apart = [np.square(image / 255.0 - enlarged / 255.0).mean() for image in (wide, thin.clamp(0, 1).numpy() * 255)]
    assert apart[0] < 0.2 * apart[1]


def test_splats_of_a_survey_have_the_detail_of_its_blocks(finished_run, tiny_scene, tmp_path):
    """The run that Blender names for them is that of the coarse model, whose images are smaller."""
    folder, scene = make_survey(tmp_path / "survey", random_splats(10)), load_scene(tiny_scene)
    shutil.copytree(finished_run, folder.coarse.path, dirs_exist_ok=True)
    survey, (_, settings, _) = folder.read(), folder.coarse.read_config()
    folder.write(replace(survey, scene=tiny_scene, settings=replace(settings, width=settings.width // 2)))
    write_part(folder.all_views, without_points(scene))
    write_ply(tmp_path / "splats.ply", load_newest(finished_run)[0].to_splats())
    blocks = film_model(tmp_path / "splats.ply", folder.coarse.path).detail
    coarse = film_model(None, folder.coarse.path).detail
    assert coarse.focal == film_model(tmp_path / "splats.ply", finished_run).detail.focal
    assert blocks.focal == pytest.approx(coarse.focal / 2)


def test_a_run_whose_scene_is_gone_is_rendered_all_the_same(finished_run, tmp_path, caplog):
    shutil.copytree(finished_run, tmp_path / "run")
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    (tmp_path / "run" / "config.json").write_text(json.dumps(config | {"scene": str(tmp_path / "gone")}))
    model = film_model(None, tmp_path / "run")
    assert model.detail is None
    assert render_film(model, tmp_path / "film", frames(1), FilmOptions())["rendered"] == 1
    assert "lose detail" in caplog.text and str(tmp_path / "gone") in caplog.text


def test_a_film_without_splats_or_run_and_impossible_rates_are_refused():
    with pytest.raises(InputError, match="needs splats or a run"):
        film_model(None, None)
    with pytest.raises(InputError, match="frames per second"):
        FilmOptions(fps=0)
