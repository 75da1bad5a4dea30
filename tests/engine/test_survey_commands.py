"""A survey from the command line, from its plan to its report."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from swag_engine.app import cli
from swag_engine.formats.survey_folder import SurveyFolder
from swag_engine.formats.survey_tiles import Tiles
from tests.scenes.survey_scenes import tiny_survey

SIZES = ["--iterations", "60", "--width", "64", "--max-gaussians", "20000", "--effects", "water=on", "--backend", "cpu"]


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    """A merged survey of two blocks."""
    folder = tmp_path_factory.mktemp("surveys")
    tiny_survey(folder / "scene")
    path = folder / "survey"
    assert cli.main(["survey", "plan", str(folder / "scene"), "--out", str(path), "--block-images", "12", *SIZES]) == 0
    assert cli.main(["survey", "run", str(path)]) == 0
    assert cli.main(["survey", "merge", str(path)]) == 0
    return path


def call(capsys, *words):
    capsys.readouterr()
    code = cli.main(["survey", *map(str, words)])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_a_merged_survey_has_each_block_and_is_scored(survey, capsys):
    code, out, _ = call(capsys, "report", survey, "--json")
    document, files = json.loads(out), SurveyFolder(survey)
    assert code == 0 and set(document["blocks"]) == {"B-001", "B-002"}
    tiles = Tiles.read(files.merged)
    assert tiles.levels[0].splats == sum(block["gaussians_in_core"] for block in document["blocks"].values())
    assert document["levels"][0]["test_psnr"] == pytest.approx(document["test_psnr"], abs=1e-6)
    assert tiles.levels[0].psnr == pytest.approx(document["test_psnr"], abs=1e-6)
    # The blocks were scored with their margins and the coarse model around them: the merged model is as good.
    own = np.mean([block["test_psnr"] for block in document["blocks"].values()])
    assert document["test_psnr"] == pytest.approx(own, abs=0.7)
    assert document["processor_seconds"] > sum(block["processor_seconds"] for block in document["blocks"].values())
    page = files.report.read_text(encoding="utf-8")
    assert "B-001" in page and f"{document['test_psnr']:.2f} dB" in page and "http" not in page


def test_views_of_a_survey_with_and_without_water(survey, tmp_path, capsys):
    names = SurveyFolder(survey).read().test
    pictures = {}
    for water in ("0", "1"):
        code, out, _ = call(capsys, "render", survey, "--out", tmp_path / water, "--water", water, "--develop", "none")
        files = [Path(line) for line in out.split()]
        assert code == 0 and [file.stem for file in files] == [Path(name).stem for name in names]
        pictures[water] = cv2.imread(str(files[0])).astype(int)
    assert np.abs(pictures["0"] - pictures["1"]).mean() > 5


def test_what_cannot_be_done_is_one_sentence(survey, tmp_path, capsys):
    for words, sentence in (
        (("render", survey, "--out", tmp_path, "--camera", "none.jpg"), "no photo named none.jpg"),
        (("render", survey, "--out", tmp_path, "--level", 9), "has the levels 0 to"),
        (("render", survey, "--out", tmp_path, "--water", 2), "from 0 to 1"),
        (("report", tmp_path), "is not a survey"),
        (("block", survey, "--block", "B-9"), "has no block B-9"),
    ):
        code, _, errors = call(capsys, *words)
        assert code == 2 and sentence in errors.splitlines()[-1] and "Traceback" not in errors
