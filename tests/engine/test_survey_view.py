"""Tiles of a view: enough of them to render it as with all splats, and coarse ones only where no fine one is."""

import numpy as np
import pytest
import torch

from swag_engine.formats.ply import read_ply
from swag_engine.formats.survey_tiles import Tiles
from swag_engine.formats.survey_view import tiles_in_view
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.rendering.render import render
from swag_engine.scene.cameras import Camera
from swag_engine.splats.splats import concatenate
from swag_engine.survey import merge
from swag_engine.survey.merge import merge_survey
from swag_engine.survey.view import splats_in_view
from tests.scenes.small_surveys import GROUND, make_survey, random_splats


@pytest.fixture(scope="module")
def tiles(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(merge, "TILE_SPLATS", 150)
        patch.setattr(merge, "COARSEST", 200)
        patch.setattr(merge.os, "fsync", lambda _: None)
        splats = random_splats(6000, size=16.0)
        splats.scales[::40] *= 12  # some reach far
        return Tiles.read(make_survey_and_merge(tmp_path_factory.mktemp("survey"), splats))


def make_survey_and_merge(folder, splats):
    survey = make_survey(folder, splats, size=16.0)
    merge_survey(folder)
    return survey.merged


def camera_at(on_ground, towards, kind="perspective", focal=60.0):
    """A camera at a place on the ground (x, y, height) that looks at another."""
    axes, origin = np.array(GROUND.axes), np.array(GROUND.origin)
    place, target = (np.array(each) @ axes + origin for each in (on_ground, towards))
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, axes[2] + 1e-3 * axes[0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ place
    return Camera("view", 64, 48, focal, focal, 30.0, 25.0, pose, kind)


VIEWS = [
    camera_at((0, 0, 3), (0.5, 0, 0)),
    camera_at((-7, -7, 0.4), (8, 8, 0)),
    camera_at((3, 2, 0.1), (-8, 2, 0.3)),
    camera_at((1, 1, 2), (1, 1, 9)),
    camera_at((2, -3, 5), (2, -3.01, 0), "orthographic", 20.0),
]


def rendered(splats, camera):
    if not len(splats):
        return torch.zeros(camera.height, camera.width, 3)
    with torch.no_grad():
        return render(GaussianCloud.from_splats(splats, (0.0, 0.0, 0.0)), camera).color


@pytest.mark.parametrize("camera", VIEWS)
def test_the_splats_in_view_render_as_all_of_them(tiles, camera):
    whole = concatenate([read_ply(tiles.path(tile)) for tile in tiles.of_level(0)])
    some = splats_in_view(tiles, camera)
    assert len(some) < len(whole)
    np.testing.assert_allclose(rendered(some, camera), rendered(whole, camera), atol=2e-6)


@pytest.mark.parametrize("camera", VIEWS)
def test_tiles_in_view_are_those_whose_boxes_meet_the_frustum(tiles, camera):
    """Against points on a fine grid in each box: a tile with a point in view is chosen, and no tile far from it."""
    chosen = {tile.cell for tile in tiles_in_view(tiles, camera, 0)}
    for tile in tiles.of_level(0):
        low, high = np.array(tile.low), np.array(tile.high)
        steps = np.stack(np.meshgrid(*[np.linspace(0, 1, 9)] * 3), axis=-1).reshape(-1, 3)
        x, y, depth = camera.world_to_camera[:3, :3] @ (low + steps * (high - low)).T + camera.world_to_camera[:3, 3:]
        scale = 1 if camera.kind == "orthographic" else np.maximum(depth, 1e-9)
        beyond_x = np.maximum(np.abs(x * camera.fx / scale + camera.cx - 32) - 32, 0)
        beyond_y = np.maximum(np.abs(y * camera.fy / scale + camera.cy - 24) - 24, 0)
        if ((depth > 0) & (beyond_x == 0) & (beyond_y == 0)).any():
            assert tile.cell in chosen
        if (depth < -1).all():
            assert tile.cell not in chosen


def test_a_view_of_nothing_has_no_splats(tiles):
    assert not len(splats_in_view(tiles, camera_at((0, 0, 2), (0, 0.01, 9))))
