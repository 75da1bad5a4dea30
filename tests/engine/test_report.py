"""The page that a run leaves: whole, by itself, and harmless whatever the files around it say."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from io import StringIO

import pytest
import tyro

from swag_engine.app.cli import Train, main
from swag_engine.app.worker import Worker
from swag_engine.base.errors import InputError
from swag_engine.experiments import report as module
from swag_engine.experiments.evaluate_run import evaluate_run
from swag_engine.experiments.report import command_line, evidence_text, write_report
from swag_engine.settings.settings import TrainSettings

SETTINGS = TrainSettings(iterations=20, width=64, max_gaussians=400, sh_degree=0)
HOSTILE = '<script>alert(1)</script> $x^2$ & "'


@pytest.fixture
def run(finished_run, tmp_path):
    return shutil.copytree(finished_run, tmp_path / finished_run.name)


def change(path, **values):
    path.write_text(json.dumps((json.loads(path.read_text()) if path.exists() else {}) | values))


def page_of(run):
    """The page without its pictures, which could hold any letters."""
    path = write_report(run)
    assert path == run / "report.html"
    page = path.read_text(encoding="utf-8")
    sources = re.findall(r'src="([^"]*)"', page)
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    return re.sub(r'src="[^"]*"', 'src=""', page)


def test_the_page_says_what_was_reached_and_how_to_repeat_it(run):
    metrics = json.loads((run / "metrics.json").read_text())
    page = page_of(run)
    assert page.count('src=""') == 3 * 2 + 1  # photograph, render and error of two views, and the scale
    assert page.count("<svg") == 3  # PSNR, SSIM and Gaussians against seconds
    assert f"PSNR {metrics['test_psnr']:.2f} dB" in page and f"{metrics['control_psnr']:.2f} dB" in page
    assert all(f"{part}</td>" in page for part in metrics["ledger"])
    whole = re.search(r'<th>sum</th><th class="number">([\d.,]+)</th>', page[page.index("Time by part") :])
    per_iteration = 1000 * metrics["seconds"] / metrics["iteration"]
    assert whole and float(whole[1].replace(",", "")) == pytest.approx(per_iteration, rel=0.01)
    assert "max gaussians" in page and "--max-gaussians 400" in page
    assert "engine 0." in page and "torch 2." in page
    assert "nan" not in page.lower()


def test_the_page_needs_no_network(run):
    page = page_of(run)
    assert not re.search(r"https?:|<script|<link|<iframe|@import|@font-face", page)
    assert all(found.startswith("#") for found in re.findall(r'href="([^"]*)"', page))
    assert all(found.startswith("#") for found in re.findall(r"url\(([^)]*)\)", page))


def test_what_files_say_is_escaped(run):
    change(run / "metrics.json", notes=[HOSTILE], ledger={HOSTILE: 1.0}, water=HOSTILE)
    views = json.loads((run / "metrics.json").read_text())["views"]
    change(run / "metrics.json", views=views | {HOSTILE: {"psnr": 20.0, "ssim": 0.5}})
    effect = {"state": "on", "reason": HOSTILE, "evidence": {HOSTILE: HOSTILE}, "cost_ms": 1.0}
    change(run / "plan.json", effects={HOSTILE: effect})
    page = page_of(run)
    assert "<script" not in page and "<b>" not in page
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt; $x^2$ &amp; &quot;") >= 8
    assert "a &lt;b&gt; &amp; c" in page


def test_parts_that_the_run_has_are_shown_and_others_left_out(run):
    plain = page_of(run)
    assert "Forecast" not in plain and "Floater mass" not in plain
    expected = {"seconds": [10000, 12345, 20000], "psnr": [1, 2, 3], "memory_mb": 610}
    change(run / "forecast.json", expected=expected, outcome={"seconds": 9000, "psnr": 2.5})
    effect = {"state": "unknown", "reason": "Too alike.", "evidence": {"gain": 3.25, "gain_least": 10}, "cost_ms": 1.5}
    change(run / "plan.json", effects={"depth_prior": effect})
    evaluation = evaluate_run(run)
    page = page_of(run)
    assert "12,345" in page and "10,000 to 20,000" in page and ">no</td>" in page and "610" in page
    assert all(text in page for text in ("depth prior", "undetermined", "Too alike.", "gain 3.25 (at least 10)"))
    assert f"{100 * evaluation['floater_mass']:.1f} %" in page
    change(run / "evaluation.json", iteration=7)  # of an earlier checkpoint
    assert "Floater mass" not in page_of(run)


def test_evidence_is_read_beside_its_thresholds():
    evidence = {"bic_gain": 2055.123, "bic_gain_least": 10, "open": True, "change": [0.75, 0.5], "rms": None}
    assert evidence_text(evidence) == "bic gain 2055 (at least 10); open yes; change 0.75, 0.5; rms not known"


def test_the_command_makes_the_same_run(tmp_path):
    scene, out = tmp_path / "my scene; rm", tmp_path / "run"
    settings = TrainSettings(
        recipe="3dgs", effects="depth_prior=on,water=off", preset="draft", iterations=7, seed=3, stop_when_flat=True,
        metres_per_unit=0.5, water_type="0.3,0.1,0.06",
    )  # fmt: skip
    words = shlex.split(command_line(scene, out, settings))
    assert words[:2] == ["swag", "train"]
    parsed = tyro.cli(Train, args=words[2:])
    assert (parsed.scene, parsed.out, parsed.settings) == (scene, out, settings)
    assert command_line(scene, out, TrainSettings()).count("--") == 1


def test_a_run_that_was_killed_has_a_page_and_a_folder_without_a_run_a_sentence(run, tmp_path):
    (run / "metrics.json").unlink()
    page = page_of(run)
    assert "interrupted" in page and page.count('src=""') == 3 * 2 + 1
    for checkpoint in run.glob("checkpoint-*"):
        checkpoint.unlink()
    with pytest.raises(InputError, match="no checkpoint"):
        write_report(run)
    with pytest.raises(InputError, match="not a training run"):
        write_report(tmp_path)


def test_many_views_are_shown_from_the_worst_to_the_best():
    views = {f"view {i}": {"psnr": float(i * 7 % 20)} for i in range(20)} | {"blind": {"psnr": None}}
    shown = [views[name]["psnr"] for name in module._from_worst_to_best(views)]
    assert shown == sorted(shown) and len(shown) == module.SHOWN == len(set(shown))
    assert (shown[0], shown[-1]) == (0, 19)
    assert module._from_worst_to_best({"one": {"psnr": 3.0}}) == ["one"]


def test_every_door_leaves_a_report_and_none_is_spoiled_by_it(tiny_scene, tmp_path, monkeypatch, capsys):
    def command(name, *more):
        sizes = ["--iterations", "4", "--width", "64", "--max-gaussians", "320"]
        return ["train", str(tiny_scene), "--out", str(tmp_path / name), *sizes, *more]

    def worker(name):
        settings = replace(SETTINGS, iterations=4).to_json()
        request = {"request": "train", "scene": str(tiny_scene), "out": str(tmp_path / name), "settings": settings}
        events = StringIO()
        child = Worker(StringIO(json.dumps(request) + "\n"), events)
        child.stop.set = lambda: None  # type: ignore[method-assign] # the end of the requests comes at once here; the run is to end by itself
        child.run()
        return json.loads(events.getvalue().splitlines()[-1])

    assert main(command("a", "--json")) == 0
    assert json.loads(capsys.readouterr().out)["report"] == str(tmp_path / "a" / "report.html")
    assert (tmp_path / "a" / "report.html").exists()
    assert worker("b")["report"] == str(tmp_path / "b" / "report.html")
    capsys.readouterr()

    monkeypatch.setattr(module, "write_report", refuse)
    assert main(command("c")) == 0
    printed = capsys.readouterr()
    assert "Done" in printed.out and "Report" not in printed.out
    assert "its report could not be written: Cannot write report.html: no space." in printed.err
    assert "Traceback" not in printed.err
    assert not (tmp_path / "c" / "report.html").exists()
    result = worker("d")
    assert result["event"] == "result" and result["report"] is None
    assert "its report could not be written" in capsys.readouterr().err


def refuse(folder):
    raise InputError("Cannot write report.html: no space.")


def test_a_bug_in_the_report_is_not_hidden(run, monkeypatch):
    monkeypatch.setattr(module, "new_plots", lambda *a: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        module.try_write_report(run)


def test_report_is_a_command(run, capsys):
    assert main(["report", str(run)]) == 0
    assert capsys.readouterr().out.strip() == str(run / "report.html")
    assert main(["report", str(run / "nowhere")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
