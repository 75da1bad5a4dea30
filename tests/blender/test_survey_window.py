"""The real Blender with a window: a survey is watched while its files change, opened, and refined for the view."""

import json

from swag_engine.formats.run_folder import write_json
from swag_engine.formats.survey_folder import SurveyFolder
from tests.blender.real_blender import in_window, new_folder
from tests.scenes.hand_made_survey import WATER, finish, make_survey, write_tiles


def test_a_survey_is_watched_and_refined_in_the_window(real_blender, extension_zip):
    folder = new_folder(real_blender, extension_zip, "survey")
    make_survey(folder / "plot", folder / "reef", merged=False)
    later = SurveyFolder(folder / "later")
    for name, psnr in (("coarse", 21.3), ("B-001", 24.56), ("B-002", 23.1)):
        finish(later, name, psnr)
    write_json(later.failed("B-003"), {"problem": "B-003 needs 9 GB of memory, and 4 GB are free: train it elsewhere."})
    write_json(later.claim("B-004"), {"host": "reef-2", "pid": 9, "beat": 4})
    later.run("B-004").path.mkdir()
    later.run("B-004").metrics_log.write_text('{"iteration": 450, "psnr": 21.25, "gaussians": 700, "seconds": 9}\n')
    write_json(later.coarse.water, WATER)
    write_tiles(later)
    report = in_window(
        "survey_window.py", real_blender, folder,
        size=(1200, 900), SWAG_SURVEY="/gui/survey/plot", SWAG_FINISH="/gui/survey/later",
    )  # fmt: skip
    assert set(report["at first"].values()) == {"waiting"}
    assert report["followed"] == {
        "coarse": "done", "B-001": "done", "B-002": "done", "B-003": "failed", "B-004": "running"
    }  # fmt: skip
    assert report["faces"] == [4, 4, 3, 2]
    assert report["map is hidden"] and report["opened"] == 256 and report["load view"] == ["FINISHED"]
    count, levels = report["near"]
    assert 256 < count <= 1000 and json.loads(levels)["0"] >= 4
    assert report["undone"] == [256, json.dumps({"1": 4})]
    assert report["timer after another file"] is False
