"""Blocks become tiles: each splat of each core once, the same files whatever happened before, and bounded memory."""

import os
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.formats.ply import read_ply
from swag_engine.formats.run_folder import write_json
from swag_engine.formats.survey_tiles import Tiles
from swag_engine.splats.splats import concatenate
from swag_engine.survey import merge
from swag_engine.survey.merge import merge_survey
from tests.scenes.small_surveys import GROUND, add_seam, finish_block, make_survey, random_splats


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda _: None)  # takes most of the time
    monkeypatch.setattr(merge, "TILE_SPLATS", 400)
    monkeypatch.setattr(merge, "COARSEST", 200)


def files_of(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def level_of(tiles, level):
    return concatenate([read_ply(tiles.path(tile)) for tile in tiles.of_level(level)])


def rows_of(splats):
    """Each splat as one row of numbers, sorted."""
    count = len(splats)
    parts = [getattr(splats, name).reshape(count, -1) for name in merge.ARRAYS]
    rows = np.hstack([*parts, *(values[:, None] for values in splats.extras.values())]).astype(np.float32)
    return rows[np.lexsort(rows.T[::-1])]


def on_borders():
    """Random splats, many of them on the borders of the cores as exactly as float32 can be, or next to them."""
    splats = random_splats(3000)
    positions = splats.positions.copy()
    border = np.float32(GROUND.origin[2])  # the ground's x, which is the scene's z
    for start, value in enumerate((border, np.nextafter(border, np.float32(9)), np.nextafter(border, np.float32(-9)))):
        positions[start:900:3, 2] = value
    positions[300:600, 0] = np.float32(GROUND.origin[0])
    return replace(splats, positions=positions)


def test_each_splat_of_a_core_is_in_one_tile_once(tmp_path):
    splats = on_borders()
    survey = make_survey(tmp_path, splats)
    result = merge_survey(tmp_path)
    tiles = Tiles.read(survey.merged)
    assert result["splats"] == len(splats) and len(tiles.of_level(0)) > 4 and len(tiles.levels) > 1
    # Files hold logarithms, so that the numbers to compare with come from a file, too.
    written = concatenate([read_ply(survey.run(name).ply) for name in survey.read().blocks])
    np.testing.assert_array_equal(rows_of(level_of(tiles, 0)), np.unique(rows_of(written), axis=0))


def test_a_seam_replaces_what_its_blocks_have_in_it(tmp_path):
    splats = on_borders()
    survey = make_survey(tmp_path, splats)
    within = (np.abs(GROUND.on_ground(splats.positions)[:, 0]) < 0.25) & (GROUND.on_ground(splats.positions)[:, 1] >= 0)
    moved = replace(splats.subset(within), positions=splats.positions[within] + np.array([0.4, 0, 0.3], np.float32))
    add_seam(survey, "S-003-004", ("B-003", "B-004"), (-0.25, 0.0, 0.25, np.inf), moved)
    assert merge_survey(tmp_path)["blocks"] == [*survey.read().blocks, "S-003-004"]
    others = concatenate([read_ply(survey.run(name).ply) for name in survey.read().blocks])
    places = GROUND.on_ground(others.positions)
    outside = others.subset(~((np.abs(places[:, 0]) < 0.25) & (places[:, 1] >= 0)))
    expected = concatenate([outside, read_ply(survey.run("S-003-004").ply)])
    tiles = Tiles.read(survey.merged)
    np.testing.assert_array_equal(rows_of(level_of(tiles, 0)), np.unique(rows_of(expected), axis=0))
    survey.done("S-003-004").unlink()
    with pytest.raises(InputError, match="1 of 5 blocks and seams .* S-003-004"):
        merge_survey(tmp_path)
    assert merge_survey(tmp_path, partial=True)["splats"] == len(splats)  # the blocks are whole without it


def test_tiles_say_what_they_hold(tmp_path):
    survey = make_survey(tmp_path, random_splats(3000))
    merge_survey(tmp_path)
    tiles = Tiles.read(survey.merged)
    assert tiles.up == GROUND.axes[2]
    for tile in tiles.tiles:
        splats = read_ply(tiles.path(tile))
        edge = tiles.edge * 2**tile.level
        assert (np.floor(splats.positions.astype(float) / edge) == tile.cell).all()
        np.testing.assert_array_equal(splats.positions.min(axis=0), tile.low)
        np.testing.assert_array_equal(splats.positions.max(axis=0), tile.high)
        assert len(splats) == tile.splats and set(splats.extras) == {"confidence", "label"}
        visible = splats.opacities * np.exp(-0.5 * (tile.reach / splats.scales.max(axis=1)) ** 2)
        assert visible.max() <= 1 / 255 * 1.0001
        assert tile.reach == 0 or visible.max() >= 1 / 255 * 0.9999
    for level in tiles.levels:
        files = [tiles.path(tile) for tile in tiles.of_level(level.level)]
        assert level.bytes == sum(file.stat().st_size for file in files)
        assert level.splats == sum(tile.splats for tile in tiles.of_level(level.level))


def test_the_same_files_whatever_was_there_before(tmp_path):
    """Merging again, after a merge of fewer blocks, and in another folder with another order of blocks on the disk."""
    splats = random_splats(3000)
    survey = make_survey(tmp_path / "a", splats)
    merge_survey(survey.path)
    first = files_of(survey.merged)
    merge_survey(survey.path)
    assert files_of(survey.merged) == first
    other = make_survey(tmp_path / "b", splats)
    finished = {name: other.done(name).read_bytes() for name in other.read().blocks}
    other.done("B-002").unlink()
    result = merge_survey(other.path, partial=True)
    assert result["missing"] == ["B-002"] and "B-002" in result["notes"][0] and result["splats"] < len(splats)
    for name in reversed(list(finished)):
        other.done(name).write_bytes(finished[name])
    merge_survey(other.path)
    assert files_of(other.merged) == first


def test_an_interrupted_merge_leaves_the_earlier_one(tmp_path):
    splats = random_splats(3000)
    survey = make_survey(tmp_path, splats)
    merge_survey(tmp_path)
    first = files_of(survey.merged)
    finish_block(survey, "B-001", random_splats(500, seed=5))
    stages = []

    class Stopped(Exception):
        pass

    def stop_at(wanted):
        def progress(stage, fraction):
            stages.append(stage)
            if len(stages) == wanted:
                raise Stopped

        return progress

    merge_survey(tmp_path, lambda stage, fraction: stages.append(stage))
    finish_block(survey, "B-001", splats.subset(GROUND.on_ground(splats.positions)[:, 1] < 1))
    merge_survey(tmp_path)
    assert files_of(survey.merged) == first
    finish_block(survey, "B-001", random_splats(500, seed=5))
    for call in (1, 3, 6, len(stages) // 2, len(stages) - 1):
        stages.clear()
        with pytest.raises(Stopped):
            merge_survey(tmp_path, stop_at(call))
        assert files_of(survey.merged) == first


def test_a_disk_that_is_full_leaves_the_earlier_merge(tmp_path, monkeypatch):
    survey = make_survey(tmp_path, random_splats(2000))
    merge_survey(tmp_path)
    first = files_of(survey.merged)
    finish_block(survey, "B-001", random_splats(500, seed=5))
    monkeypatch.setattr(merge.np, "save", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(InputError, match="free some space"):
        merge_survey(tmp_path)
    assert files_of(survey.merged) == first


def test_blocks_that_are_not_done_are_named(tmp_path):
    survey = make_survey(tmp_path, random_splats(500))
    survey.done("B-003").unlink()
    with pytest.raises(InputError, match=r"1 of 4 blocks .* B-003.* --partial"):
        merge_survey(tmp_path)
    assert not survey.merged.exists()


@pytest.mark.parametrize("change", ["cut", "absent", "figures"])
def test_a_damaged_result_is_named_with_what_to_do(tmp_path, change):
    survey = make_survey(tmp_path, random_splats(500))
    result = survey.run("B-002").ply
    if change == "cut":
        os.truncate(result, result.stat().st_size - 1)
    elif change == "absent":
        result.unlink()
    else:
        write_json(survey.done("B-002"), {"version": 1})
    with pytest.raises(InputError, match=r"run the block B-002 again"):
        merge_survey(tmp_path)
    assert not survey.merged.exists()


def test_blocks_of_other_properties_get_the_same_ones(tmp_path):
    """A block without labels, and one of a lower degree: zeros stand for what they lack."""
    splats = random_splats(2000)
    survey = make_survey(tmp_path, splats)
    part = read_ply(survey.run("B-001").ply)
    finish_block(survey, "B-001", replace(part, sh=part.sh[:, :1].copy(), extras={}))
    merge_survey(tmp_path)
    tiles = Tiles.read(survey.merged)
    for tile in tiles.tiles:
        found = read_ply(tiles.path(tile))
        assert found.sh.shape[1] == 4 and {name: v.dtype for name, v in found.extras.items()} == {
            "confidence": np.float32,
            "label": np.int32,
        }
    assert 0 < (level_of(tiles, 0).extras["label"] == 0).sum() < len(splats) / 2


def test_memory_does_not_grow_with_the_survey(tmp_path, monkeypatch):
    """Three times as many blocks of the same size: the peak grows by less than a fifth."""
    monkeypatch.setattr(merge, "TILE_SPLATS", 1000)
    monkeypatch.setattr(merge, "COARSEST", 2000)
    monkeypatch.setattr(merge, "SAMPLES", 100)
    peaks = []
    for columns in (5, 15):
        size = 4.0 * columns
        splats = random_splats(1000 * columns, size=size)
        positions = splats.positions.copy()
        positions[:, 0] /= columns
        make_survey(tmp_path / str(columns), replace(splats, positions=positions), columns, 1, size)
        del splats, positions
        seen = []
        tracemalloc.start()
        merge_survey(tmp_path / str(columns), lambda *_: seen.append(tracemalloc.get_traced_memory()[1]))  # noqa: B023
        tracemalloc.stop()
        peaks.append(max(seen))
    assert peaks[1] < 1.2 * peaks[0]


def test_edges_follow_the_number_of_splats():
    """Four times the splats on a plane: half the edge. Splats at one place end the search."""
    random = np.random.default_rng(0)
    positions = np.column_stack([random.uniform(0, 64, (4000, 2)), np.full(4000, 0.5)])
    edges = [merge.tile_edge(positions, np.full(4000, weight)) for weight in (1.0, 4.0, 16.0)]
    assert edges[0] == 2 * edges[1] == 4 * edges[2]
    assert merge.tile_edge(np.zeros((10, 3)), np.full(10, 1e6)) > 0
