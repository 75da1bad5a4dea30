"""Surveys in Blender: opened, tiles of a view or a box in place of coarser ones, planned, watched and merged."""

import json
import shutil
import sys

import pytest

from swag_engine.formats.run_folder import read_json
from swag_engine.formats.survey_folder import SurveyFolder
from swag_engine.survey.job import run_job
from tests.scenes.hand_made_survey import BLOCKS, make_survey
from tests.scenes.survey_scenes import tiny_survey

ALL = {level: [f"{level}/{x}-{y}-0" for x in range(4 >> level) for y in range(4 >> level)] for level in range(3)}
"""Tiles of each level."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A merged survey and the folder of its photos; not to be changed."""
    folder = tmp_path_factory.mktemp("merged")
    (folder / "reef").mkdir()
    return make_survey(folder / "plot", folder / "reef").path


@pytest.fixture
def survey(made, tmp_path):
    """A copy of it."""
    shutil.copytree(made, tmp_path / "plot")
    return tmp_path / "plot"


def covers_once(files):
    """Whether tiles cover each cube of level 0 exactly once."""
    covered = []
    for file in files:
        level, cell = file.split("/")
        edge, (x, y, _) = 2 ** int(level), map(int, cell.split("-"))
        covered += [(edge * x + i, edge * y + j) for i in range(edge) for j in range(edge)]
    return sorted(covered) == [(x, y) for x in range(4) for y in range(4)]


def test_a_survey_opens_with_the_finest_level_that_fits_and_with_what_a_run_has(blender, made):
    found = blender.run("surveys.open_levels", made)
    whole, small = found["whole"], found["small"]
    assert whole["tiles"] == [ALL[0], 1024] and small["tiles"] == [ALL[1], 256] and found["objects"] == 1
    assert whole["described"] == f"1,024 splats of the survey in {made}; tiles: 16 of level 0."
    shared = {
        "water": True, "background": [0.1, 0.2, 0.3], "exposure": 0.5, "up": [0.0, 0.0, 1.0],
        "folders": ["reef", "plot"], "run": "",
    }  # fmt: skip
    assert whole.items() >= shared.items() and small.items() >= shared.items()
    assert whole["labels"] == [["sand", 512], ["coral", 512]] and small["labels"] == [["sand", 128], ["coral", 128]]
    assert (whole["degree"], small["degree"]) == (1, 0)


def test_finer_tiles_replace_the_coarse_ones_of_a_view_or_a_box(blender, made):
    found = blender.run("surveys.load_view_box_overview", made)
    assert found["opened"] == [ALL[1], 256] == found["overview"]
    for name in ("near", "far", "away", "box"):
        assert covers_once(found[name][0]) and found[name][1] == 64 * len(found[name][0]) <= 1000, name
    near = found["near"][0]
    assert "0/0-0-0" in near and "0/3-3-0" not in near
    assert found["far"] == found["away"] == [ALL[2], 64]
    # The box is about the corner (7, 7) of the square: cube 3-3 of level 0 alone, and its neighbours in its parent.
    assert found["box"][0] == [*("0/2-2-0", "0/2-3-0", "0/3-2-0", "0/3-3-0"), "1/0-0-0", "1/0-1-0", "1/1-0-0"]
    assert found["no box"].startswith("There is no box: choose a Box Object")
    assert found["box elsewhere"] == "No tiles of the survey are in the bounds of box: move it over the splats."


def test_no_more_splats_are_loaded_than_the_budget(blender, made):
    found = blender.run("surveys.budgets", made)
    for budget, whole in (("1000", False), ("1024", True), ("100000", True)):
        message, files, count = found[budget]
        assert covers_once(files) and count <= int(budget) and (files == ALL[0]) == whole
        assert ("The box has more splats than may be loaded" in message) == (not whole)
    assert found["1000"][2] == 13 * 64  # one tile more in four parts would be 1024
    *messages, count = found["too few"]
    assert count == 1024
    for message in messages:
        assert message.startswith("The coarsest level of") and "has 64 splats, more than the 10 that" in message


def test_edits_stay_where_tiles_stay_and_labels_undo_and_export_work(blender, fake_engine, made, tmp_path):
    found = blender.run("surveys.edits", made, tmp_path / "out.ply", SWAG_ENGINE_PYTHON=fake_engine)
    assert found["loaded"][1] == 7 * 64
    first, count = found["other box"]
    assert "0/3-0-0" in first and covers_once(first) and count == 7 * 64 - 1
    assert found["kept"] == {"hidden": 5, "named": 7, "of its tile": 63, "entries": [["coral", 320], ["sand", 127]]}
    assert (
        found["undone"] == [found["loaded"][0], count] and "4 of level 0, 3 of level 1" in found["undone description"]
    )
    assert found["redone"] == found["other box"]
    assert found["selected"] == 320 and found["exported"] == [320, ["label"], [2]]
    assert found["parts"] == [["plot Survey", True, 127, True], ["plot Survey coral", False, 320, True]]
    assert found["label run"].startswith(
        "The splats of plot Survey are of a survey: its blocks are labelled outside of Blender"
    )
    assert "are from no run on this machine" in found["orthomosaic"]


def test_what_cannot_be_opened_is_refused_in_a_sentence(blender, survey, tmp_path):
    found = blender.run("surveys.refusals", survey, tmp_path)
    assert found["run"].endswith("is not the folder of a survey: choose the one that has survey.json.")
    assert "has no tiles.json: merge the survey first" in found["not merged"]
    assert "0-0-0.ply" in found["missing"] and "0-0-0.ply" in found["half"]
    assert found["after"] == [ALL[1], 256]
    assert "has 64 splats and not 63: merge the survey again" in found["other"]
    assert found["empty"].endswith("lists no tiles: merge the survey again.")
    assert found["merged again"][1] == 1024 and sorted(found["merged again"][0]) == sorted(ALL[0])
    assert "survey.json" in found["damaged"]


def test_a_scene_that_is_imported_later_takes_over_the_survey(blender, made):
    same, *places = blender.run("surveys.adopt", made, made.parent / "reef")
    assert same and places == [[True, [1.0, 2.0, 3.0]]] * 2


def test_water_is_that_of_the_coarse_model(blender, made, tmp_path):
    found = blender.run("surveys.show_water", made, made.parent / "reef", tmp_path)
    assert found["below root"] and found["film"] == str(made / "coarse") and abs(found["slider"] - 0.25) < 1e-6
    dry, wet = found["0.0"], found["1.0"]
    assert abs(dry[0]) < 1e-3 and all(abs(one - other) > 0.01 for one, other in zip(dry, wet, strict=True))


def test_a_job_whose_claim_stands_still_is_not_running(blender, tmp_path):
    folder = make_survey(tmp_path / "plot", tmp_path / "reef", merged=False)
    assert blender.run("surveys.beats", folder.path) == ["running", "running", "begun", "running"]


def test_the_blocks_are_a_map_that_follows_the_files(blender, tmp_path):
    (tmp_path / "reef").mkdir()
    folder = make_survey(tmp_path / "plot", tmp_path / "reef", merged=False)
    line = json.dumps({"iteration": 450, "psnr": 21.25, "gaussians": 700, "seconds": 9.0})
    job = {name: folder.job(name) for name in BLOCKS}
    changes = {
        folder.done("coarse"): json.dumps({"version": 1, "test_psnr": 22.0, "iterations": 100, "gaussians": 10}),
        folder.done("B-001"): json.dumps({"version": 1, "test_psnr": 24.56, "iterations": 900, "gaussians": 1000}),
        job["B-002"] / "run" / "metrics.jsonl": f'{line}\n{{"iteration": 4',
        job["B-002"] / "claim.json": json.dumps({"host": "elsewhere", "pid": 7, "beat": 3}),
        job["B-003"] / "failed.json": json.dumps({"problem": "The disk is full.", "attempts": 3}),
        job["B-004"] / "run" / "config.json": "{}",
    }
    found = blender.run("surveys.watch", folder.path, {str(path): text for path, text in changes.items()})
    before, after = found["before"], found["after"]
    assert list(before) == list(BLOCKS) and {each["state"] for each in before.values()} == {0}
    assert before["B-001"]["text"] == "B-001\nWaiting" and before["B-001"]["material"] == "SWAG Block Waiting"
    # The survey is upright, its middle above the origin; B-001 is in the south-west, B-002 in the south-east.
    signs = {"B-001": (-1, -1), "B-002": (1, -1), "B-003": (-1, 1), "B-004": (1, 1)}
    for name, (x, y) in signs.items():
        assert before[name]["middle"] == [2.0 * x, 2.0 * y, 0.0] and before[name]["size"] == [3.92, 3.92, 0.0]
        assert before[name]["text is there"] and before[name]["up"] == [0.0, 0.0, 1.0]
    states = {name: (each["state"], each["psnr"], each["text"]) for name, each in after.items()}
    assert states == {
        "B-001": (4, 24.56, "B-001\nFinished\n24.6 dB"),
        "B-002": (2, 21.25, "B-002\nRunning\n21.2 dB"),
        "B-003": (3, 0.0, "B-003\nFailed"),
        "B-004": (1, 0.0, "B-004\nStopped"),
    }
    assert after["B-003"]["material"] == "SWAG Block Failed"
    assert found["jobs after"] == {
        "coarse": ["done", 22.0, 1, ""], "B-001": ["done", 24.56, 1, ""], "B-002": ["running", 21.25, 0.5, ""],
        "B-003": ["failed", 0.0, 0, "The disk is full."], "B-004": ["begun", 0.0, 0, ""],
    }  # fmt: skip
    assert found["objects"] == found["objects again"] == 6 and (found["meshes"], found["fonts"]) == (1, 4)
    assert {"1", "SWAG_UL_survey_jobs", "swag.show_blocks", "swag.merge_survey"} <= set(found["panel"])


def test_a_survey_is_planned_and_merged_from_the_panel(blender, fake_engine, tmp_path):
    photos = tmp_path / "reef with spaces"
    photos.mkdir()
    found = blender.run("surveys.plan_and_merge", photos, SWAG_ENGINE_PYTHON=fake_engine)
    assert found["refused"] == [False, False] and "swag.plan_survey" in found["no survey"]
    assert "block_images" in found["photos"]
    message, failed, jobs = found["planned"]
    assert message == "4 blocks of 12 photos, 0 finished." and not failed
    assert {name: job[0] for name, job in jobs.items()} == dict.fromkeys(("coarse", *BLOCKS), "waiting")
    request = found["request"]
    assert request["block_images"] == 40 and request["scene"] == str(photos)
    assert request["out"] == str(photos / "swag_survey") and request["settings"]["preset"] == "standard"
    shown = "".join(found["waiting"]).replace(" ", "")  # in several lines
    assert "swag.plan_survey" not in shown and found["command"].replace(" ", "") in shown
    assert found["command"] == f"swag survey run '{photos / 'swag_survey'}'"
    assert found["again"].endswith("holds a survey already: choose another folder in Survey.")
    message, failed, tiles = found["merged"]
    assert (
        message.startswith(f"1,024 splats of the survey in {photos / 'swag_survey'}")
        and not failed
        and tiles == [ALL[0], 1024]
    )
    assert message.endswith("tiles: 16 of level 0. A note of the merge.")
    assert {"swag.load_view", "swag.load_box", "swag.load_overview", "budget", "box"} <= set(
        found["drawn"]["SWAG_PT_survey_tiles"]
    )
    assert "Survey Plan: Cutting" in blender.printed or "Survey Merge: Tiles" in blender.printed


@pytest.mark.main_version
def test_the_engine_plans_trains_and_merges_a_survey(blender, tmp_path):
    """Some ten seconds: the coarse model and two blocks, each a process that imports torch."""
    tiny_survey(tmp_path / "reef")
    environment = {"SWAG_ENGINE_PYTHON": sys.executable}
    planned = blender.run("surveys.plan_with_the_engine", tmp_path / "reef", **environment)
    assert not planned["failed"] and planned["message"].startswith("2 blocks of ") and planned["faces"] == [0, 0]
    folder = SurveyFolder(tmp_path / "reef" / "swag_survey")
    merge = "surveys.merge_with_the_engine"
    assert "3 of 3 blocks and seams of" in blender.run(merge, folder.path, False, **environment)["message"]
    for name in ("coarse", "B-001"):
        assert run_job(folder.path, name)["state"] == "done"
    part = blender.run(merge, folder.path, True, **environment)
    assert part["faces"] == [4, 0] and part["message"].endswith(
        "2 of 3 blocks and seams are missing here: B-002, S-001-002."
    )
    for name in ("B-002", "S-001-002"):
        assert run_job(folder.path, name)["state"] == "done"
    whole = blender.run(merge, folder.path, False, **environment)
    assert whole["faces"] == [4, 4] and not whole["failed"] and "Traceback" not in blender.printed
    in_cores = sum(read_json(folder.done(name), "")["gaussians_in_core"] for name in ("B-001", "B-002"))
    assert 0 < part["splats"] < whole["splats"] <= in_cores and all(whole["psnr"])
