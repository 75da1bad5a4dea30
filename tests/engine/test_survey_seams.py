"""Which pixels of a survey show a border between blocks, and their errors."""

import numpy as np
import pytest
import torch

from swag_engine.effects.scene_effects import SceneEffects
from swag_engine.formats.survey_folder import Block, Ground
from swag_engine.gaussians.cloud import GaussianCloud
from swag_engine.scene.cameras import Camera
from swag_engine.survey.report import SeamErrors
from swag_engine.survey.seams import distance_to_seams, seam_distances

INF = float("inf")


def block(*core):
    return Block("B", core, core, (), (), (), 0, 1, 1, 1, 1)


BLOCKS = [block(-INF, -INF, 0.0, INF), block(0.0, -INF, INF, 2.0), block(0.0, 2.0, INF, INF)]
"""West, south-east, north-east."""


def test_distances_to_the_nearest_border():
    places = np.array([[-3.0, 9.0], [-1.0, 2.5], [0.5, -8.0], [4.0, 1.5], [5.0, 5.0], [0.0, 2.0]])
    np.testing.assert_allclose(distance_to_seams(places, BLOCKS), [3, 1, 0.5, 0.5, 3, 0])
    assert np.isinf(distance_to_seams(places, [block(-INF, -INF, INF, INF)])).all()


def test_a_pixel_has_the_distance_of_the_surface_that_it_shows():
    """A floor at height 0 seen straight down from height 2: the columns are 1 / 10 units apart, x = 0 in the middle."""
    side = np.linspace(-3, 3, 61)
    x, y = (values.ravel() for values in np.meshgrid(side, side))
    n = len(x)
    floor = GaussianCloud(
        means=torch.tensor(np.stack([x, y, 0 * x], 1), dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        log_scales=torch.tensor([[0.1, 0.1, 0.001]]).log().repeat(n, 1),
        opacity_logits=torch.full((n,), 5.0),
        sh0=torch.zeros(n, 1, 3),
        shN=torch.zeros(n, 0, 3),
        background=torch.zeros(3),
    )
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 2
    camera = Camera("a", 40, 30, 20.0, 20.0, 20.0, 15.0, pose)
    ground = Ground((0.0, 0.0, 0.0), ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)))
    found = seam_distances(floor, SceneEffects(), camera, ground, BLOCKS[:1] + [block(0.0, -INF, INF, INF)])
    expected = np.abs((np.arange(40) + 0.5 - 20) / 10)
    np.testing.assert_allclose(found[10], expected, atol=0.05)  # half a pixel
    pose[0, 3] = -50
    assert np.isnan(seam_distances(floor, SceneEffects(), camera, ground, BLOCKS)).all()  # it sees nothing


def test_errors_at_seams_and_elsewhere_are_summed_over_all_views():
    errors = SeamErrors()
    square, seam = np.full((40, 40), 0.01), np.zeros((40, 40), bool)
    seam[:, :20] = True
    square[seam] = 0.1
    square[0] = 99.0
    counted = np.ones((40, 40), bool)
    counted[0] = False
    assert errors.add(square, seam, counted) == pytest.approx({"interior_psnr": 20.0, "seam_psnr": 10.0})
    errors.add(square / 10, np.zeros((40, 40), bool), counted)
    assert errors.psnr(True) == pytest.approx(10.0)
    expected = (780 * 0.01 + 780 * 0.01 + 780 * 0.001) / (3 * 780)
    assert errors.psnr(False) == pytest.approx(-10 * np.log10(expected))
    assert np.isnan(SeamErrors().psnr(True))
