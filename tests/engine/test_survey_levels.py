"""A coarser level keeps mass, moments and labels of the splats that it stands for."""

import numpy as np
import pytest

from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.splats.splats import Splats, concatenate
from swag_engine.splats.transform import covariances
from swag_engine.survey.levels import areas, coarser, group, merged
from tests.scenes.small_surveys import random_splats


def moments(splats):
    """Mass, mean and covariance of the mixture of Gaussians."""
    masses = splats.opacities * areas(splats.scales)
    weights = masses / masses.sum()
    mean = weights @ splats.positions.astype(float)
    offsets = splats.positions - mean
    spread = covariances(splats) + offsets[:, :, None] * offsets[:, None, :]
    return masses.sum(), mean, np.tensordot(weights, spread, 1)


def test_a_group_becomes_one_of_its_mass_mean_and_covariance():
    splats = random_splats(40, size=0.4)
    groups = np.repeat(np.arange(8), 5)[np.random.default_rng(1).permutation(40)]
    result = merged(splats, groups)
    assert len(result) == 8
    masses = splats.opacities * areas(splats.scales)
    for number in range(8):
        mine = groups == number
        mass, mean, covariance = moments(splats.subset(mine))
        found = moments(result.subset(np.array([number])))
        assert found[0] == pytest.approx(mass, rel=1e-5)
        np.testing.assert_allclose(found[1], mean, atol=1e-6)
        np.testing.assert_allclose(found[2], covariance, atol=1e-6 * np.trace(covariance))
        weights = masses[mine] / masses[mine].sum()
        np.testing.assert_allclose(result.sh[number], np.tensordot(weights, splats.sh[mine], 1), atol=1e-6)
        assert result.extras["confidence"][number] == pytest.approx(
            weights @ splats.extras["confidence"][mine], rel=1e-5
        )


def test_labels_are_those_of_the_largest_weight():
    splats = random_splats(6)
    splats.scales[:] = 0.1
    splats.opacities[:] = 0.1, 0.2, 0.25, 0.5, 0.25, 0.25
    splats.extras["label"][:] = 7, 7, 2, 9, 4, 4
    result = merged(splats, np.array([0, 0, 0, 1, 1, 1]))
    assert result.extras["label"].tolist() == [7, 4] and result.extras["label"].dtype == np.int32


def test_a_level_has_a_quarter_of_the_splats_and_keeps_the_moments_of_all():
    splats = random_splats(4001)
    splats.opacities[:] *= 0.2  # so that no group needs an opacity above 1
    level = coarser(splats)
    assert len(level) == 1001
    for found, true in zip(moments(level), moments(splats), strict=True):
        np.testing.assert_allclose(found, true, rtol=1e-4, atol=1e-4)
    assert (level.opacities > 0).all() and (level.opacities < 1).all()
    np.testing.assert_allclose(np.linalg.norm(level.rotations, axis=1), 1, atol=1e-6)
    low, high = splats.positions.min(axis=0), splats.positions.max(axis=0)
    assert (level.positions >= low).all() and (level.positions <= high).all()


def test_groups_are_of_near_splats_of_like_color():
    """Pairs of red and blue splats at the same places, four of each color in a heap: heaps of one color are groups."""
    random = np.random.default_rng(2)
    heaps = np.repeat(np.column_stack([np.arange(20.0), np.zeros((20, 2))]), 4, axis=0)
    red, blue = (
        Splats(
            (heaps + random.normal(0, 0.01, heaps.shape)).astype(np.float32),
            np.tile(np.array([1, 0, 0, 0], np.float32), (80, 1)),
            np.full((80, 3), 0.05, np.float32),
            np.full(80, 0.5, np.float32),
            np.tile(np.array(color, np.float32), (80, 1))[:, None],
        )
        for color in ((1.5, -1, -1), (-1, -1, 1.5))
    )
    groups = group(concatenate([red, blue]), 40)
    expected = np.concatenate([np.repeat(np.arange(20), 4), np.repeat(np.arange(20, 40), 4)])
    pairs = np.unique(np.column_stack([groups, expected]), axis=0)
    assert len(pairs) == 40 and len(np.unique(pairs[:, 0])) == 40


@pytest.mark.parametrize("kind", ["one place", "flat", "transparent", "one", "far away"])
def test_unusual_splats(kind, tmp_path):
    splats = random_splats(1 if kind == "one" else 500)
    if kind == "one place":
        splats.positions[:], splats.sh[:] = 1, 0
    elif kind == "flat":
        splats.scales[:, 1:] = 1e-30
    elif kind == "transparent":
        splats.opacities[:] = 0
    elif kind == "far away":
        splats.positions[0] = 1e7
    level = coarser(splats)
    assert len(level) == -(-len(splats) // 4)
    write_ply(tmp_path / "level.ply", level)
    again = read_ply(tmp_path / "level.ply")
    assert len(again) == len(level)
    for name in ("positions", "scales", "opacities", "sh"):
        assert np.isfinite(getattr(level, name)).all()
    if kind == "one":
        np.testing.assert_array_equal(level.rotations, splats.rotations)


def test_a_level_is_the_same_each_time():
    first, second = (coarser(random_splats(3000)) for _ in range(2))
    for name in ("positions", "rotations", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
