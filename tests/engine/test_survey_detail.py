"""Choice of tiles of mixed levels within a number of splats."""

import pytest

from swag_engine.base.errors import InputError
from swag_engine.formats.survey_detail import finest_level, refine
from swag_engine.formats.survey_tiles import Level, Tile, Tiles


@pytest.fixture
def tiles(tmp_path):
    """Three levels of cubes along x on both sides of 0: 8 tiles of 100 splats, 4 of 60, 2 of 30."""
    made = []
    for level, splats in ((0, 100), (1, 60), (2, 30)):
        count = 8 >> level
        for x in range(-count // 2, count // 2):
            low, high = (float(x << level), 0.0, 0.0), (float((x + 1) << level), 1.0, 1.0)
            made.append(Tile(level, (x, 0, 0), low, high, splats, f"{level}/{x}.ply"))
    levels = tuple(Level(n, sum(tile.splats for tile in made if tile.level == n), 0) for n in range(3))
    return Tiles(tmp_path, 1.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), levels, tuple(made))


def covered(chosen):
    return sorted(cell for tile in chosen for cell in range(int(tile.low[0]), int(tile.high[0])))


def test_the_finest_level_that_fits(tiles):
    assert {tile.level for tile in finest_level(tiles, 800)} == {0}
    assert {tile.level for tile in finest_level(tiles, 799)} == {1}
    assert {tile.level for tile in finest_level(tiles, 60)} == {2}
    with pytest.raises(InputError, match="has 60 splats, more than the 59 that may be loaded"):
        finest_level(tiles, 59)


@pytest.mark.parametrize("budget", [60, 150, 151, 300, 500, 799, 800])
def test_each_place_is_covered_once_and_the_budget_is_kept(tiles, budget):
    chosen = refine(tiles, budget, lambda tile: 1.0 + tile.level)
    assert covered(chosen) == list(range(-4, 4)) and sum(tile.splats for tile in chosen) <= budget
    assert ({tile.level for tile in chosen} == {0}) == (budget == 800)
    with pytest.raises(InputError, match="raise the number of splats"):
        refine(tiles, 59, lambda tile: 1.0)


def test_what_needs_it_most_is_refined_first_and_what_needs_nothing_never(tiles):
    chosen = refine(tiles, 300, lambda tile: tile.level + 1.0 if tile.low[0] < 0 else 0.0)
    assert [tile.file for tile in chosen if tile.low[0] >= 0] == ["2/0.ply"]
    assert {tile.level for tile in chosen if tile.low[0] < 0} == {0, 1}
    near = refine(tiles, 800, lambda tile: 1.0 if tile.low[0] <= 3 < tile.high[0] else 0.0)
    assert sorted(tile.file for tile in near) == ["0/2.ply", "0/3.ply", "1/0.ply", "2/-1.ply"]


def test_a_tile_that_does_not_fit_does_not_stop_smaller_ones(tiles):
    # The western half does not fit at 120 splats in place of 30, the eastern one was not asked for.
    large = Tile(1, (-2, 0, 0), (-4.0, 0.0, 0.0), (-2.0, 1.0, 1.0), 1000, "1/-2.ply")
    changed = Tiles(
        tiles.folder, tiles.edge, tiles.up, tiles.background, tiles.levels,
        tuple(large if tile.file == large.file else tile for tile in tiles.tiles),
    )  # fmt: skip
    chosen = refine(changed, 200, lambda tile: 2.0 if tile.low[0] < 0 else 1.0)
    assert {tile.file for tile in chosen} == {"2/-1.ply", "1/0.ply", "1/1.ply"}
