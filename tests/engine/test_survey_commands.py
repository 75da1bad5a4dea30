"""A survey from the command line, from its plan to its report."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from swag_engine.app import cli
from swag_engine.base.errors import InputError
from swag_engine.formats.ply import read_ply
from swag_engine.formats.survey_folder import SurveyFolder
from swag_engine.formats.survey_tiles import Tiles
from swag_engine.scene.colmap import load_scene
from swag_engine.semantics.labels import read_labels
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
    assert code == 0 and set(document["blocks"]) == {"B-001", "B-002", "S-001-002"}
    tiles = Tiles.read(files.merged)
    # A seam has as many as it takes from its blocks.
    in_cores = sum(document["blocks"][name]["gaussians_in_core"] for name in ("B-001", "B-002"))
    assert tiles.levels[0].splats == in_cores
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


def test_a_level_is_exported(survey, tmp_path, capsys):
    tiles = Tiles.read(SurveyFolder(survey).merged)
    code, out, _ = call(capsys, "export", survey, "--format", "ply", "--out", tmp_path / "all.ply")
    assert code == 0 and f"{tiles.levels[0].splats:,} splats" in out
    assert len(read_ply(tmp_path / "all.ply")) == tiles.levels[0].splats


def test_labels_of_blocks_become_labels_of_the_merged_survey(survey, tmp_path, capsys):
    copy = shutil.copytree(survey.parent, tmp_path / "copy") / "survey"
    files = SurveyFolder(copy)
    with pytest.raises(InputError, match="has no labels"):
        read_labels(files.merged)
    # What is painted blue in the masks is the upper half of each photo, and only in some the lower half is green.
    for number, view in enumerate(load_scene(copy.parent / "scene").views):
        for name, rows in (("far", slice(None, 24)), ("near", slice(24, None)) if number > 12 else ("far", slice(0))):
            mask = np.zeros((48, 64), np.uint8)
            mask[rows] = 255
            file = (tmp_path / "masks" / name / view.name).with_suffix(".png")
            file.parent.mkdir(parents=True, exist_ok=True)
            if mask.any():
                cv2.imwrite(str(file), mask)
    code, out, errors = call(capsys, "label", copy, "--masks", tmp_path / "masks", "--json")
    assert code == 0, errors
    assert {entry["name"] for entry in json.loads(out)["labels"]} == {"far", "near"}
    assert call(capsys, "merge", copy)[0] == 0
    table = read_labels(files.merged)
    tiles = Tiles.read(files.merged)
    numbers = np.concatenate([read_ply(tiles.path(tile)).extras["label"] for tile in tiles.of_level(0)])
    assert {entry["name"]: entry["count"] for entry in table} == {
        entry["name"]: int((numbers == entry["id"]).sum()) for entry in table
    }
    assert min(entry["count"] for entry in table) > 20
    # Each splat has the label that its own block gave it, whatever its number was there.
    for name in files.read().blocks:
        block, names = read_ply(files.run(name).ply), {entry["id"]: entry["name"] for entry in table}
        own = {entry["id"]: entry["name"] for entry in read_labels(files.run(name).path)}
        of_position = {p.tobytes(): label for p, label in zip(block.positions, block.extras["label"], strict=True)}
        for tile in tiles.of_level(0):
            splats = read_ply(tiles.path(tile))
            for position, label in zip(splats.positions, splats.extras["label"], strict=True):
                if position.tobytes() in of_position:
                    assert names.get(label) == own.get(of_position[position.tobytes()])
    # Labels are no reason to train a block again.
    assert call(capsys, "block", copy, "--block", "B-001", "--json")[1].count('"done"') == 1


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
