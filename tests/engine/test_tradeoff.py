"""Accuracy against time: every run scored alike, the front as defined, the files whole, the work never done twice."""

import csv
import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from swag_engine.base.errors import InputError
from swag_engine.evaluation.metrics import mean_score, score_views
from swag_engine.experiments import ablate
from swag_engine.experiments import tradeoff as module
from swag_engine.experiments.evaluate_run import newest
from swag_engine.experiments.grid import Grid
from swag_engine.experiments.tradeoff import compare, describe, dominators, tradeoff
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.settings.presets import PRESETS
from swag_engine.settings.settings import TrainSettings

GRID = Grid(presets=("draft",), iterations=(4, 24), widths=(32, 64), max_gaussians=(320,), effects=("water=off",))


@pytest.fixture(scope="module")
def done(tiny_scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("a <b>") / "out"
    told = []
    document = tradeoff(tiny_scene, out, GRID, on_run=lambda name, row: told.append((name, row["psnr"])))
    assert told == [(row["name"], row["psnr"]) for row in document["rows"]]
    return out, document


def test_a_point_is_dominated_by_what_is_as_fast_and_as_good_and_better_in_one():
    random = np.random.default_rng(0)
    points = [tuple(map(float, point)) for point in random.integers(0, 6, (40, 2))]
    for (seconds, quality), by in zip(points, dominators(points), strict=True):
        dominating = [p for p in points if p[0] <= seconds and p[1] >= quality and p != (seconds, quality)]
        assert (by is None) == (not dominating)
        assert by is None or points[by] in dominating and points[by][1] == max(p[1] for p in dominating)


def test_equal_points_do_not_dominate_each_other():
    assert dominators([(1.0, 5.0), (1.0, 5.0)]) == [None, None]


def test_quality_that_should_be_low_is_low_on_its_front():
    def row(name, seconds, lpips):
        return {"name": name, "seconds": seconds, "psnr": 20.0 + seconds, "ssim": 0.5, "lpips_alex": lpips} | {
            "lpips_vgg": None
        }

    rows = [row("a", 1.0, 0.3), row("b", 2.0, 0.2), row("c", 3.0, 0.25)]
    compare(rows, control=19.0)
    assert [r["dominated"]["lpips_alex"] for r in rows] == [None, None, "b"]
    assert [r["dominated"]["psnr"] for r in rows] == [None, None, None]
    assert [r["dominated"]["ssim"] for r in rows] == [None, "a", "a"]
    assert [r["gain"] for r in rows] == pytest.approx([0.5, 0.75, 1])


def test_the_grid_holds_every_combination_once():
    runs = Grid().runs()
    assert {run.settings.preset for run in runs} == set(PRESETS)
    assert len(runs) == 2 * len(PRESETS) == len({run.folder for run in runs})
    assert runs[0].name == "draft" and runs[0].settings == TrainSettings(preset="draft").sized()
    names = [run.name for run in GRID.runs()]
    assert names == ["4 iterations, 32 px", "24 iterations, 32 px", "4 iterations, 64 px", "24 iterations, 64 px"]
    everything = replace(GRID, presets=tuple(PRESETS))
    assert [run.settings for run in everything.runs()] == [run.settings for run in GRID.runs()]
    wider = replace(GRID, widths=(16, 32, 64), effects=("default", "water=off"))
    assert {run.folder for run in GRID.runs()} < {run.folder for run in wider.runs()}
    for nothing in ("presets", "effects", "widths"):
        with pytest.raises(InputError, match="nothing to run"):
            replace(GRID, **{nothing: ()}).runs()
    with pytest.raises(InputError, match="There is no effect"):
        replace(GRID, effects=("no",)).runs()


def test_all_runs_are_scored_at_one_width(done, tiny_scene):
    out, document = done
    assert document["score_width"] == 64 and not document["interrupted"]
    scene = load_scene(tiny_scene)
    views = [view for view in scene.views if view.name in ("view_00.png", "view_08.png")]
    for row in document["rows"]:
        cloud, simulated, _ = newest(out / row["folder"])
        images = load_images(scene, views, 64)
        psnr, ssim = mean_score(score_views(cloud, images, row["settings"]["sh_degree"], simulated=simulated))
        assert (row["psnr"], row["ssim"]) == (psnr, ssim)
        own = json.loads((out / row["folder"] / "metrics.json").read_text())
        assert row["seconds"] == own["seconds"]
        assert (row["psnr"] == own["test_psnr"]) == (row["settings"]["width"] == 64)


def test_its_files_hold_every_run_and_name_the_dominated(done):
    out, document = done
    stored = json.loads((out / "tradeoff.json").read_text())
    assert [row["psnr"] for row in stored["rows"]] == [row["psnr"] for row in document["rows"]]
    with open(out / "tradeoff.csv", encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["name"] for line in lines] == [row["name"] for row in document["rows"]]
    assert [float(line["ssim"]) for line in lines] == [row["ssim"] for row in document["rows"]]
    assert [line["psnr_dominated"] or None for line in lines] == [r["dominated"]["psnr"] for r in document["rows"]]
    assert (out / "tradeoff.png").read_bytes().startswith(b"\x89PNG")
    page = (out / "tradeoff.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 2  # PSNR and SSIM; no LPIPS weights here
    assert all(row["name"] in page for row in document["rows"])
    assert not re.search(r"https?:|<script|<link|@import|src=", page)
    assert all(found.startswith("#") for found in re.findall(r'href="([^"]*)"', page))
    assert len(describe(document).splitlines()) == 2 + 4 + 1 + len(document["notes"])
    assert not list(out.glob(".*.part"))


def test_what_is_there_is_not_made_again(done, tiny_scene, monkeypatch, tmp_path):
    out, document = done
    trained = []
    train = ablate.train
    monkeypatch.setattr(ablate, "train", lambda *a, **k: trained.append(a[1].name) or train(*a, **k))
    wider = replace(GRID, max_gaussians=(320, 310))
    again = tradeoff(tiny_scene, out, wider, score_width=48)
    assert len(trained) == 4 and all("310" in name for name in trained)
    assert again["score_width"] == 48 and len(again["rows"]) == 8
    assert again["rows"][0]["psnr"] != document["rows"][0]["psnr"]
    asked = iter(range(10**9))
    stopped = tradeoff(tiny_scene, tmp_path, GRID, should_stop=lambda: next(asked) > 10)
    assert stopped["interrupted"] and len(stopped["rows"]) == 1
    assert (tmp_path / "tradeoff.png").exists()


def test_networks_add_their_figures(done, tiny_scene, monkeypatch):
    distance = {"alex": lambda image, target: float((image - target).abs().mean())}
    monkeypatch.setattr(module, "load_lpips", lambda folder: (distance, ["VGG16 <is> left out."]))
    document = tradeoff(tiny_scene, done[0], GRID)
    assert all(0 < row["lpips_alex"] < 1 and row["lpips_vgg"] is None for row in document["rows"])
    page = (done[0] / "tradeoff.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 3 and "VGG16 &lt;is&gt; left out." in page and "LPIPS, AlexNet" in page


def test_the_command_takes_a_grid_and_says_what_is_wrong(done, tiny_scene, tmp_path):
    command = [sys.executable, "-m", "swag_engine", "tradeoff"]
    words = ["--presets", "draft", "--iterations", "4", "24", "--widths", "32", "64", "--max-gaussians", "320"]
    words += ["--effects", "water=off", "--json"]
    ran = subprocess.run([*command, tiny_scene, "--out", done[0], *words], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert [row["psnr"] for row in json.loads(ran.stdout)["rows"]] == [row["psnr"] for row in done[1]["rows"]]
    wrong = subprocess.run([*command, tmp_path / "no", "--out", tmp_path / "o"], capture_output=True, text=True)
    assert wrong.returncode == 2 and "no" in wrong.stderr and "Traceback" not in wrong.stderr
