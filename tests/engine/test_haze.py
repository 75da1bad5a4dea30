"""Splats that stand for open water: found from the photos, hidden without water, as trained with all of it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from swag_engine.base.errors import InputError
from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.kernels.reference.harmonics import C0
from swag_engine.kernels.reference.transfer import to_display
from swag_engine.rendering.haze import describe_haze, haze_score, with_haze, without_haze
from swag_engine.rendering.model import SceneModel
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.scene.images import TrainingImage
from swag_engine.splats import haze as splat_haze
from swag_engine.splats.haze import HAZE, MOST_HAZE, haze_amount
from swag_engine.water.medium import Medium, without_water

WATER = Medium.starting(
    5.0, "linear", *(torch.tensor(v) for v in ([0.3, 0.09, 0.06], [0.3, 0.1, 0.08], [0.02, 0.2, 0.3]))
)
CAMERAS = [Camera(f"{x}.jpg", 160, 128, 128.0, 128.0, 80.0, 64.0, np.eye(4)) for x in range(2)]
CAMERAS[1].world_to_camera[0, 3] = -0.3
FOG = 4


def gaussians(means, display, scales, opacity):
    count = len(means)
    return GaussianCloud(
        means=torch.tensor(means).float(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.tensor(scales).float().expand(count, 3).log().contiguous(),
        opacity_logits=torch.full((count,), float(np.log(opacity / (1 - opacity)))),
        sh0=((torch.as_tensor(display).float() - 0.5) / C0)[:, None],
        shN=torch.zeros(count, 15, 3),
        features=torch.zeros(count, 0),
        background=torch.zeros(3),
    )


def reef(fog_range=8.0, water_behind=True):
    """Fog of open water's look above a wall of all colors; photos of the wall, and its sparse points."""
    random = np.random.default_rng(0)
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-3, 3, 40), np.linspace(0.1, 2.2, 16)))
    wall = gaussians(np.stack([x, y, np.full_like(x, 4)], 1), random.random((len(x), 3)), 0.08, 0.97)
    background = to_display(WATER.background_light(torch.tensor([[0.0, 0.0, 1.0]])))
    ranges = torch.full((FOG,), fog_range)
    look = without_water(background.expand(FOG, 3), ranges, WATER)
    places = [[(n - 1.5) * 0.3 * fog_range, -0.3 * fog_range, fog_range] for n in range(FOG)]
    cloud = gaussians(places, look, 0.1 * fog_range, 0.7).followed_by(wall)
    shown = wall if water_behind else cloud
    images = [
        TrainingImage(camera, pixels_of(render(shown, camera, 0, WATER).color), np.ones((128, 160), bool))
        for camera in CAMERAS
    ]
    points = wall.means.numpy()[::3].astype(np.float64)
    views = [SimpleNamespace(name=camera.name, point_indices=np.arange(len(points))) for camera in CAMERAS]
    scene = SimpleNamespace(views=views, points=SimpleNamespace(positions=points))
    return SceneModel(cloud, SceneEffects({"medium": WATER})), images, scene


def pixels_of(color):
    return (color.clamp(0, 1) * 255).round().byte().numpy()


def test_gaussians_in_open_water_are_found_and_surfaces_are_not():
    model, images, scene = reef()
    score = haze_score(model, images, scene)
    assert score[:FOG].min() > 0.95 and score[FOG:].max() < 0.01
    assert f": {FOG}." in describe_haze(score) and describe_haze(0 * score) == ""


def test_far_surfaces_that_no_light_reaches_the_camera_from_are_not_taken_for_open_water():
    assert haze_score(*reef(fog_range=60.0)).max() == 0


def test_places_with_sparse_points_are_surfaces():
    model, images, scene = reef()
    around = model.cloud.means[0].numpy() + np.random.default_rng(0).normal(size=(200, 3)) * (0.8, 0.8, 0)
    scene.points.positions = np.concatenate([scene.points.positions, around])
    for view in scene.views:
        view.point_indices = np.arange(len(scene.points.positions))
    score = haze_score(model, images, scene)
    assert score[0] < 0.1 and score[FOG - 1] > 0.9


def test_photos_of_ground_alone_have_no_haze():
    model, images, scene = reef()
    textured = np.random.default_rng(0).integers(0, 255, (128, 160, 3), np.uint8)
    filled = [replace(image, pixels=textured) for image in images]
    assert haze_score(model, filled, scene).max() == 0
    above = np.arange(128)[:, None, None] < 60
    grey = [replace(image, pixels=np.where(above, np.uint8(200), image.pixels)) for image in images]
    assert haze_score(model, grey, scene).max() == 0, "flat, and of another color than open water"
    assert haze_score(model, images, scene).max() > 0.9
    steps = above * np.repeat(np.array([-20, 20, 0, 10], np.int16), 40)[None, :, None]
    uneven = [replace(image, pixels=(image.pixels + steps).clip(0, 255).astype(np.uint8)) for image in images]
    assert haze_score(model, uneven, scene).max() == 0, "flat parts of different colors, as of the ground"


def test_haze_follows_its_amount_and_all_of_the_water_shows_the_gaussians_as_trained():
    cloud = reef()[0].cloud
    score = torch.zeros(len(cloud))
    score[:FOG] = torch.tensor([MOST_HAZE, 0.5, 0.1, 0.0])
    hidden = without_haze(cloud, score)
    torch.testing.assert_close(hidden.opacities[:FOG], cloud.opacities[:FOG] * (1 - score[:FOG]))
    assert torch.equal(hidden.opacity_logits[FOG:], cloud.opacity_logits[FOG:])
    assert without_haze(cloud, score, 1) is cloud and without_haze(cloud, None) is cloud
    torch.testing.assert_close(with_haze(hidden, score, 1).opacities, cloud.opacities)
    half = 0.5 * (hidden.opacities + cloud.opacities)
    torch.testing.assert_close(with_haze(hidden, score, 0.5).opacities, half)
    torch.testing.assert_close(without_haze(cloud, score, 0.5).opacities, half)
    assert haze_amount(0.3, 0.1) == 0.3 and haze_amount(0.3, 0.6) == 0.6


def test_splats_of_files_show_haze_as_gaussians_do():
    cloud = reef()[0].cloud
    score = torch.zeros(len(cloud))
    score[:FOG] = MOST_HAZE
    splats = without_haze(cloud, score).to_splats()
    splats.extras |= {HAZE: score.numpy(), "label": np.zeros(len(cloud), np.int32)}
    assert splat_haze.with_haze(splats, 0) is splats
    shown = splat_haze.with_haze(splats, 1)
    np.testing.assert_allclose(shown.opacities, cloud.opacities, rtol=1e-4)
    assert set(shown.extras) == {"label"}, "opacities are those of files no more"
    without = replace(splats, extras={})
    assert splat_haze.with_haze(without, 1) is without
    with pytest.raises(InputError, match="haze must be from 0 to 1, not 1.5"):
        splat_haze.check_haze(1.5)
