"""Accuracy against time: runs scored at one width, the Pareto front, the files, and runs that are kept."""

import csv
import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from swag_engine.app.cli import main
from swag_engine.base.errors import InputError
from swag_engine.evaluation.metrics import mean_score, score_views
from swag_engine.experiments.evaluate_run import load_newest
from swag_engine.experiments.grid import Grid
from swag_engine.experiments.tradeoff import describe, find_dominating, mark_dominated, tradeoff
from swag_engine.formats.run_folder import RunFolder
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.settings.presets import FEWEST, PRESETS
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.runs import training_times

GRID = Grid(presets=("draft",), iterations=(4, 24), widths=(32, 64), max_gaussians=(320,), effects=("water=off",))


@pytest.fixture(scope="module")
def done(tiny_scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("a <b>") / "out"
    reported = []
    document = tradeoff(tiny_scene, out, GRID, on_run=lambda name, row: reported.append((name, row["psnr"])))
    assert reported == [(row["name"], row["psnr"]) for row in document["rows"]]
    return out, document


def test_a_point_is_dominated_by_one_that_is_as_fast_and_as_good_and_better_in_one():
    random = np.random.default_rng(0)
    points = [(float(seconds), float(quality)) for seconds, quality in random.integers(0, 6, (40, 2))]
    for (seconds, quality), by in zip(points, find_dominating(points), strict=True):
        dominating = [p for p in points if p[0] <= seconds and p[1] >= quality and p != (seconds, quality)]
        assert (by is None) == (not dominating)
        assert by is None or points[by] in dominating and points[by][1] == max(p[1] for p in dominating)


def test_equal_points_do_not_dominate_each_other():
    assert find_dominating([(1.0, 5.0), (1.0, 5.0)]) == [None, None]


def test_lower_lpips_is_better():
    def row(name, seconds, lpips):
        return {"name": name, "seconds": seconds, "psnr": 20.0 + seconds, "ssim": 0.5, "lpips_alex": lpips} | {
            "lpips_vgg": None
        }

    rows = [row("a", 1.0, 0.3), row("b", 2.0, 0.2), row("c", 3.0, 0.25)]
    mark_dominated(rows, control=19.0)
    assert [r["dominated"]["lpips_alex"] for r in rows] == [None, None, "b"]
    assert [r["dominated"]["psnr"] for r in rows] == [None, None, None]
    assert [r["dominated"]["ssim"] for r in rows] == [None, "a", "a"]
    assert [r["gain"] for r in rows] == pytest.approx([0.5, 0.75, 1])


def test_the_grid_holds_every_combination_once():
    runs = Grid().runs()
    assert {run.settings.preset for run in runs} == set(PRESETS)
    assert len(runs) == 2 * len(PRESETS) == len({run.folder for run in runs})
    assert runs[0].name == "draft" and runs[0].settings == TrainSettings(preset="draft")
    names = [run.name for run in GRID.runs()]
    assert names == ["4 iterations, 32 px", "24 iterations, 32 px", "4 iterations, 64 px", "24 iterations, 64 px"]
    everything = replace(GRID, presets=tuple(PRESETS))  # which leaves nothing to them
    assert [run.folder for run in everything.runs()] == [run.folder for run in GRID.runs()]
    wider = replace(GRID, widths=(16, 32, 64), effects=("default", "water=off"))
    assert {run.folder for run in GRID.runs()} < {run.folder for run in wider.runs()}
    for nothing in ("presets", "effects", "widths"):
        change: dict[str, Any] = {nothing: ()}
        with pytest.raises(InputError, match="nothing to run"):
            replace(GRID, **change).runs()
    with pytest.raises(InputError, match="There is no effect"):
        replace(GRID, effects=("no",)).runs()


def test_runs_have_the_sizes_that_train_gives_them(tiny_scene, tmp_path):
    asked = Grid(presets=("draft",), iterations=(4,), effects=("water=off",))
    (row,) = tradeoff(tiny_scene, tmp_path, asked)["rows"]
    made = row["settings"]
    train(tiny_scene, tmp_path / "alone", TrainSettings(preset="draft", iterations=4, effects="water=off"))
    assert made == RunFolder(tmp_path / "alone").read_config()[1].to_json()
    assert made["width"] == 64 and made["max_gaussians"] == FEWEST < PRESETS["draft"].max_gaussians


def test_all_runs_are_scored_at_one_width(done, tiny_scene):
    out, document = done
    assert document["score_width"] == 64 and not document["interrupted"]
    scene = load_scene(tiny_scene)
    views = [view for view in scene.views if view.name in ("view_00.png", "view_08.png")]
    for row in document["rows"]:
        cloud, effects, _ = load_newest(out / row["folder"])
        images = load_images(scene, views, 64)
        psnr, ssim = mean_score(score_views(cloud, images, row["settings"]["sh_degree"], effects=effects))
        assert (row["psnr"], row["ssim"]) == (psnr, ssim)
        own = json.loads((out / row["folder"] / "metrics.json").read_text())
        assert row["seconds"] == own["seconds"]
        assert (row["psnr"] == own["test_psnr"]) == (row["settings"]["width"] == 64)


def test_files_hold_every_run_and_name_the_dominated(done):
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
    assert not list(out.glob(".swag-*"))


def test_runs_that_are_finished_are_kept(done, tiny_scene, tmp_path):
    out, document = done
    before = training_times(out)
    wider = replace(GRID, iterations=(4,), widths=(32,), max_gaussians=(320, 310))
    again = tradeoff(tiny_scene, out, wider, score_width=48)
    after = training_times(out)
    (trained,) = [name for name in after if after[name] != before.get(name)]
    assert "310" in trained
    assert again["score_width"] == 48 and len(again["rows"]) == 2
    assert again["rows"][0]["psnr"] != document["rows"][0]["psnr"]
    asked = iter(range(10**9))
    stopped = tradeoff(tiny_scene, tmp_path, GRID, should_stop=lambda: next(asked) > 10)
    assert stopped["interrupted"] and len(stopped["rows"]) == 1
    assert (tmp_path / "tradeoff.png").exists()


def test_lpips_weights_add_their_figures(done, tiny_scene, tmp_path):
    """Random weights of AlexNet's shapes, and none of VGG16."""
    weights: dict[str, torch.Tensor] = {}
    random = torch.Generator().manual_seed(0)
    layers = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}
    for index, (layer, (outputs, inputs, side)) in enumerate(layers.items()):
        deviation = (inputs * side**2) ** -0.5
        kernel = deviation * torch.randn(outputs, inputs, side, side, generator=random)
        weights |= {f"features.{layer}.weight": kernel, f"features.{layer}.bias": torch.zeros(outputs)}
        weights[f"lin{index}.model.1.weight"] = torch.full((1, outputs, 1, 1), 0.1)
    folder = tmp_path / "weights <b>"
    folder.mkdir()
    save_file(weights, folder / "lpips-alex.safetensors")
    out, finished = done
    document = tradeoff(tiny_scene, out, replace(GRID, widths=(64,)), weights_dir=folder)
    assert [row["psnr"] for row in document["rows"]] == [row["psnr"] for row in finished["rows"][2:]]
    assert all(0 < row["lpips_alex"] < 1 and row["lpips_vgg"] is None for row in document["rows"])
    page = (out / "tradeoff.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 3 and "LPIPS, AlexNet" in page
    assert "LPIPS with VGG16 is left out" in page and "weights &lt;b&gt;" in page and "weights <b>" not in page


def test_the_command_takes_a_grid_and_refuses_a_scene_that_is_not_there(done, tiny_scene, tmp_path, capsys):
    words = ["--presets", "draft", "--iterations", "4", "24", "--widths", "32", "64", "--max-gaussians", "320"]
    words += ["--effects", "water=off", "--json"]
    assert main(["tradeoff", str(tiny_scene), "--out", str(done[0]), *words]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [row["psnr"] for row in printed["rows"]] == [row["psnr"] for row in done[1]["rows"]]
    assert main(["tradeoff", str(tmp_path / "no"), "--out", str(tmp_path / "o")]) == 2
    assert str(tmp_path / "no") in capsys.readouterr().err
