"""Cutting of surveys on arrays: ground, boxes that tile the plane, and which images join them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swag_engine.formats.survey_folder import Box, inside
from swag_engine.survey.cut import (
    JOIN_POINTS,
    MARGIN,
    Cutter,
    Places,
    extended_box,
    median_distance,
    seams_of,
    sides,
    survey_bounds,
    survey_ground,
)
from swag_engine.survey.places import connected_groups, covering_images

REACH = 1.0
"""Half the side of the square that an image of `lawn` sees."""


def lawn(columns: int = 30, rows: int = 16, points: int = 30_000) -> Places:
    """Images that see a square each, half a side apart, and points everywhere below them."""
    random = np.random.default_rng(0)
    cameras = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2) * REACH
    floor = random.uniform(cameras.min(0) - REACH, cameras.max(0) + REACH, (points, 2))
    seen = [np.flatnonzero((np.abs(floor - camera) < REACH).all(1)) for camera in cameras]
    return Places(cameras, floor, seen)


def cutter(places: Places, block_images: int = 120, **changes: Any) -> Cutter:
    distance = 2 * median_distance(places.cameras, places.points, places.seen)
    fresh = Cutter(
        places, survey_bounds(places, distance), distance, block_images, lambda part: True, lambda part: True, 0
    )
    return replace(fresh, **changes)


@pytest.fixture(scope="module")
def places() -> Places:
    return lawn()


def test_cores_tile_the_plane(places):
    parts = cutter(places).cut()
    assert len(parts) >= 8
    edges = np.array([part.core for part in parts])
    xs, ys = (np.unique(edges[:, axes][np.isfinite(edges[:, axes])]) for axes in ([0, 2], [1, 3]))
    random = np.random.default_rng(1)
    anywhere = random.normal(0, 30, (20_000, 2))
    corners = np.stack(np.meshgrid(xs, ys), -1).reshape(-1, 2)
    on_borders = np.concatenate([
        corners,
        np.column_stack([random.choice(xs, 500), random.uniform(-5, 40, 500)]),
        np.column_stack([random.uniform(-5, 40, 500), random.choice(ys, 500)]),
        np.nextafter(corners, -np.inf),
        np.nextafter(corners, np.inf),
    ])  # fmt: skip
    for place in (anywhere, on_borders):
        owners = np.sum([inside(part.core, place) for part in parts], axis=0)
        assert (owners == 1).all()
    assert sum(part.core_points for part in parts) == len(places.points)


def test_parts_have_no_more_images_than_asked_and_halve_the_cameras(places):
    parts = cutter(places).cut()
    assert max(len(part.images) for part in parts) <= 120
    cameras = [np.count_nonzero(inside(part.core, places.cameras)) for part in parts]
    assert sum(cameras) == len(places.cameras) and max(cameras) <= 2 * min(cameras)
    first = min(edge for part in parts for edge in (part.core[0], part.core[2]) if abs(edge - 14.5) < 3)
    assert first == 14.5  # the whole is longer in x: cut between the middle columns of cameras


def test_extended_boxes_have_the_larger_margin_and_infinite_edges(places):
    bounds = (0.0, 0.0, 100.0, 20.0)
    assert sides((-np.inf, -np.inf, 40.0, np.inf), bounds) == (40, 20)
    left, bottom, right, top = extended_box((-np.inf, 5.0, 40.0, np.inf), bounds, 4.0)
    assert (left, top) == (-np.inf, np.inf)
    assert right == 40 + MARGIN * 40 and bottom == 5 - 4
    for part in cutter(places).cut():
        assert (np.isinf(part.core) == np.isinf(part.extended)).all()
        assert part.points == np.count_nonzero(inside(part.extended, places.points)) > part.core_points


@pytest.mark.parametrize("block_images", [60, 120])
def test_seams_lie_along_all_borders_and_do_not_overlap(places, block_images):
    cut = cutter(places, block_images)
    parts = cut.cut()
    seams = seams_of(parts, places, cut.bounds, cut.distance)
    random = np.random.default_rng(3)
    anywhere = random.uniform((-5, -5), (35, 20), (200_000, 2))
    within = np.array([inside(seam.core, anywhere) for seam in seams])
    assert within.sum(0).max() == 1
    nearest = np.min([beside(part.core, anywhere) for part in parts], axis=0)
    width = max(np.nanmin(np.subtract(seam.core[2:], seam.core[:2])) for seam in seams) / 2
    assert (nearest[within.any(0)] <= width * (1 + 1e-9)).all()
    # What lies between two strips, where four cores meet, is small.
    assert (within.any(0) | (nearest > width)).mean() > 0.98
    for seam in seams:
        owners = {k for k, part in enumerate(parts) if inside(part.core, anywhere[inside(seam.core, anywhere)]).any()}
        assert owners == set(seam.sides)
        assert set(seam.images) <= {*parts[seam.sides[0]].images, *parts[seam.sides[1]].images}
        fractions = [inside(seam.core, places.points[places.seen[image]]).mean() for image in seam.images]
        assert len(seam.images) >= 3 and min(fractions) > 0.1
        # All of its surroundings are in one of the extended boxes, so that nothing is missing there.
        around = anywhere[inside(seam.extended, anywhere)]
        assert np.any([inside(parts[side].extended, around) for side in seam.sides], axis=0).all()
        assert seam.core_points == np.count_nonzero(inside(seam.core, places.points)) < seam.points


def beside(core: Box, positions: np.ndarray) -> np.ndarray:
    """The distance (N,) of places in a core from its edges; infinite outside."""
    x, y = positions.T
    nearest = np.min([x - core[0], y - core[1], core[2] - x, core[3] - y], axis=0)
    return np.where(inside(core, positions), nearest, np.inf)


def joined(places: Places, core: Box, **changes: Any) -> list[int]:
    found = cutter(places, **changes)._joined(core, np.arange(len(places.seen)), 1)
    return found.part.images.tolist()


def test_images_join_by_their_points_alone():
    inside_box, outside = np.zeros((1000, 2)), np.full((1000, 2), 50.0)
    points = np.concatenate([inside_box, outside])
    many, few = np.arange(JOIN_POINTS), np.arange(JOIN_POINTS - 1)
    seen = [
        np.concatenate([many, 1000 + np.arange(900)]),  # enough points, though a small fraction
        np.concatenate([few, 1000 + np.arange(900)]),
        np.concatenate([np.arange(2), 1000 + np.arange(18)]),  # a tenth of few points
        np.concatenate([np.arange(2), 1000 + np.arange(19)]),
        np.arange(0),
    ]
    here = np.zeros((5, 2))  # all cameras are in the core
    assert joined(Places(here, points, seen), (-1.0, -1.0, 1.0, 1.0), distance=0.5) == [0, 2]


def test_images_that_see_mostly_elsewhere_are_chosen_by_their_fraction():
    """40 images see the block alone; of 60 others with 20 % or 40 % of their points in it there is room for 30."""
    points = np.repeat([[0.0, 0.0], [50.0, 0.0]], 1000, axis=0)
    whole = [np.arange(100)] * 40
    parts = [np.concatenate([np.arange(20 * k), 1000 + np.arange(100 - 20 * k)]) for k in (1, 2) for _ in range(30)]
    cameras = np.full((100, 2), 50.0)
    cameras[40] = 0.0  # one of those with 20 % has its camera in the core
    crowd = Places(cameras, points, [*whole, *parts])
    core, chosen = (-1.0, -1.0, 1.0, 1.0), []
    for seed in range(100):
        images = joined(crowd, core, block_images=70, distance=0.5, seed=seed)
        assert len(images) == 70 and set(range(41)) <= set(images)
        chosen.append(np.isin(np.arange(100), images))
    assert joined(crowd, core, block_images=70, distance=0.5, seed=3) == np.flatnonzero(chosen[3]).tolist()
    rates = np.mean(chosen, axis=0)
    assert rates[70:].mean() > 1.4 * rates[41:70].mean() > 0.2
    assert len(joined(crowd, core, block_images=100, distance=0.5)) == 100
    # A part that stays larger than asked takes its share of the others: 41 + 29 / 5 + 30 * 2 / 5.
    assert len(joined(crowd, core, block_images=30, distance=0.5)) == 59


def test_a_cut_that_helps_nobody_is_not_made():
    """Images that all see the same place."""
    places = lawn(columns=10, rows=6, points=300)
    same = replace(places, seen=[np.arange(300)] * len(places.seen))
    assert len(cutter(same, block_images=20).cut()) == 1


def test_parts_with_too_few_images_stay_with_their_neighbor(places):
    def enough(part):
        return np.count_nonzero(part.images % 16 == 0) >= 8

    parts = cutter(places, enough=enough).cut()
    assert 1 < len(parts) < len(cutter(places).cut()) and all(map(enough, parts))


def test_parts_are_cut_further_where_they_do_not_fit(places):
    parts = cutter(places, block_images=10_000, fits=lambda part: part.points <= 8000).cut()
    assert len(parts) > 1 and all(part.points <= 8000 for part in parts)


def test_the_same_survey_is_cut_the_same(places):
    first, second = cutter(places).cut(), cutter(places).cut()
    assert [part.core for part in first] == [part.core for part in second]
    assert all((a.images == b.images).all() for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("turn", [0, 20, 70, 90, 160])
def test_the_ground_follows_the_cameras(places, turn):
    random = np.random.default_rng(2)
    up = np.array([0.6, 0.0, 0.8])
    east, north = np.array([0.8, 0.0, -0.6]), np.array([0.0, 1.0, 0.0])
    angle = np.radians(turn)
    axes = np.stack([np.cos(angle) * east + np.sin(angle) * north, np.cos(angle) * north - np.sin(angle) * east, up])
    centres = np.column_stack([places.cameras, random.uniform(2, 3, len(places.cameras))]) @ axes + (5, 6, 7)
    positions = np.column_stack([places.points, random.normal(0, 0.1, len(places.points))]) @ axes + (5, 6, 7)
    ground = survey_ground(up, centres, positions)
    matrix = np.array(ground.axes)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)
    np.testing.assert_allclose(matrix[2], up, atol=1e-12)
    assert abs(matrix[0] @ axes[0]) > 0.9999  # along the longer side
    on_ground = ground.on_ground(centres)
    assert np.ptp(on_ground[:, 0]) == pytest.approx(29, abs=0.1) and (on_ground[:, 2] > 1.9).all()
    np.testing.assert_allclose(np.median(ground.on_ground(positions), axis=0), 0, atol=0.3)


def test_the_ground_of_cameras_in_one_line_or_place():
    line = np.outer(np.arange(5.0), [1, 1, 0])
    ground = survey_ground(np.array([0, 0, 1.0]), line, np.zeros((4, 3)))
    np.testing.assert_allclose(np.abs(ground.axes[0]), [0.5**0.5, 0.5**0.5, 0], atol=1e-6)
    assert np.isfinite(survey_ground(np.array([0, 0, 1.0]), np.ones((5, 3)), np.zeros((4, 3))).axes).all()


def test_bounds_leave_out_what_is_far_away(places):
    far = replace(places, points=np.concatenate([places.points, np.full((2000, 2), 1e6)]))
    left, bottom, right, top = survey_bounds(far, 2.0)
    assert left <= 0 and bottom <= 0 and 29 <= right <= 31 and 15 <= top <= 17


def test_groups_of_images_that_share_points():
    seen = [np.array(rows, int) for rows in ([0, 1], [5, 6, 7], [1, 2], [], [7, 8], [2, 3], [9])]
    assert [group.tolist() for group in connected_groups(seen, 10)] == [[0, 2, 5], [1, 4], [6]]


def test_chosen_images_cover_places_and_directions(places):
    centres = np.column_stack([places.cameras, np.zeros(len(places.cameras))])
    down = np.tile([0.0, 0.0, -1.0], (len(centres), 1))
    chosen = covering_images(centres, down, 1.0, 30)
    assert len(set(chosen.tolist())) == 30
    nearest = np.linalg.norm(centres[:, None] - centres[chosen], axis=2).min(1)
    in_order = centres[:: len(centres) // 30][:30]
    assert nearest.max() < np.linalg.norm(centres[:, None] - in_order, axis=2).min(1).max()
    # Two cameras in one place that look elsewhere count as two.
    one_place = np.zeros((6, 3))
    directions = np.array([[1.0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1]])
    assert len(np.unique(directions[covering_images(one_place, directions, 1.0, 3)], axis=0)) == 3
