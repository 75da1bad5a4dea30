"""Runs under a time budget: the size they choose, when they end, and how they can be continued."""

import math
import re
from dataclasses import asdict, replace

import pytest

from swag_engine.base import timing
from swag_engine.base.errors import InputError
from swag_engine.base.text import BLOCKS, sparkline, time_text
from swag_engine.formats.run_folder import RunFolder
from swag_engine.settings.presets import LADDER, PRESETS, seconds_of, size_at
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.pacing.clock import REPLAN_EVERY, Clock, is_flat, next_minute
from swag_engine.training.pacing.speed import Extent, Speed, predicted_seconds
from swag_engine.training.schedule import STANDARD, LearningRates
from swag_engine.training.trainer import train
from tests.scenes.runs import train_with

SHORT = TrainSettings(iterations=60, width=64, max_gaussians=300, sh_degree=1)
NO_CLOSING = replace(STANDARD, closing_seconds=0.1)
"""A schedule that keeps no time for a report, so that short budgets suffice."""
UNCHANGING = replace(STANDARD, learning_rates=LearningRates(**dict.fromkeys(asdict(LearningRates()), 1e-12)))
"""A schedule whose steps change next to nothing, so that the curve of validation PSNR is flat."""


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("", 0), ("90", 90), ("90s", 90), ("10m", 600), ("1h30m", 5400), ("1.5m", 90), ("2min", 120), ("1h 5s", 3605)],
)
def test_time_budgets_are_parsed(text, seconds):
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["soon", "0", "10 parsecs", "-3m", "m", "3000h", "s10"])
def test_other_time_budgets_are_refused(text):
    with pytest.raises(InputError, match="90s, 10m or 1h30m"):
        TrainSettings(time_budget=text)


def test_settings_of_the_user_replace_those_of_the_preset():
    assert TrainSettings(preset="draft").sized().iterations == PRESETS["draft"].iterations
    mixed = TrainSettings(preset="high", width=200).sized()
    assert (mixed.width, mixed.max_gaussians) == (200, PRESETS["high"].max_gaussians)
    assert TrainSettings(time_budget="5m").sized().width == 0  # the machine's speed decides
    with pytest.raises(InputError, match="not both"):
        TrainSettings(time_budget="5m", iterations=10)


def test_sizes_between_presets_increase_in_every_figure():
    sizes = [size_at(rung / 4) for rung in range(4 * len(LADDER) - 3)]
    assert sizes[::4] == list(LADDER)
    for smaller, larger in zip(sizes, sizes[1:], strict=False):
        assert smaller.iterations < larger.iterations
        assert smaller.width < larger.width
        assert smaller.max_gaussians < larger.max_gaussians


@pytest.mark.parametrize("slowness", [0.3, 1.0, 5.0])
def test_a_budget_is_kept_by_a_machine_that_is_not_as_predicted_and_changes_its_pace(slowness):
    def predicted(fraction):
        return 0.01 if fraction < 0.3 else 0.03

    clock, now, iteration, took, budget = Clock(2000), 0.0, 0, 0.0, 50.0
    fractions = []
    while not clock.done:
        step = slowness * predicted(clock.fraction) * (2 if 20 < now < 30 else 1)  # a busy machine
        now, took, iteration = now + step, took + step, iteration + 1
        clock.advance(iteration)
        if iteration % REPLAN_EVERY == 0:
            clock.replan(iteration, took, budget - now, predicted)
            took = 0.0
        fractions.append(clock.fraction)
    assert now == pytest.approx(budget, rel=0.02)
    assert fractions == sorted(fractions)
    assert max(b - a for a, b in zip(fractions, fractions[1:], strict=False)) < 0.05  # no stage is skipped
    assert clock.planned(iteration) == iteration


def test_a_time_budget_chooses_the_size_and_a_faster_machine_a_larger_one(tiny_scene, tmp_path):
    settings = TrainSettings(time_budget="6s", sh_degree=1, width=48)
    small = train_with(tiny_scene, tmp_path / "small", settings, schedule=NO_CLOSING)["metrics"]
    config = RunFolder(tmp_path / "small").read_config()[1]
    assert config.width == 48 and 0 < config.max_gaussians < LADDER[-1].max_gaussians
    assert not small["interrupted"] and small["iteration"] == small["iterations"] > REPLAN_EVERY
    extent, slow, fast = Extent(10, 2, 1000, 5, 640, 480), Speed(5, 2e-4, 4e-5, 0.1), Speed(1, 4e-5, 8e-6, 0.02)
    assert predicted_seconds(fast, extent, LADDER[1], 0.5) < predicted_seconds(slow, extent, LADDER[1], 0.5) / 4


def test_too_little_time_is_refused_with_how_much_is_needed(tiny_scene, tmp_path):
    with pytest.raises(InputError, match=r"2s is too short for this scene on this machine: it needs \d+s") as caught:
        train(tiny_scene, tmp_path / "run", TrainSettings(time_budget="2s"))
    assert int(re.search(r"needs (\d+)s", str(caught.value))[1]) >= STANDARD.closing_seconds
    assert not (tmp_path / "run").exists()


def test_a_finished_run_can_be_continued_for_longer(tiny_scene, tmp_path):
    run = tmp_path / "run"
    train(tiny_scene, run, SHORT)
    with pytest.raises(InputError, match="finished already.*more --iterations than 60"):
        train(tiny_scene, run, SHORT, resume=True)
    longer = train(tiny_scene, run, replace(SHORT, iterations=90), resume=True)["metrics"]
    assert (longer["iteration"], longer["interrupted"]) == (90, False)
    budget = TrainSettings(time_budget="5s")
    further = train_with(tiny_scene, run, budget, resume=True, schedule=NO_CLOSING)["metrics"]
    assert further["iteration"] > 90
    assert RunFolder(run).read_config()[1].width == SHORT.width


def test_a_flat_curve():
    rising = [(0.1 * step, 5 * step, 20 + 0.1 * step) for step in range(1, 9)]
    assert not is_flat(rising)
    assert not is_flat(rising[:1])
    assert is_flat([*rising, (0.9, 45, 20.8), (1.0, 50, 20.81)])


def test_gain_of_another_minute():
    curve = [(0.1, 30, 20.0), (0.2, 60, 21.0), (0.4, 120, 22.0)]  # a decibel with each doubling
    assert next_minute(curve) == pytest.approx(math.log2(180 / 120))
    assert next_minute([*curve, (0.5, 150, 21.9), (0.6, 180, 21.9)]) == 0
    assert next_minute(curve[:1]) is None


def test_figures_as_text():
    assert sparkline([20.0, 21.0, 22.0]) == f"{BLOCKS[0]}{BLOCKS[4]}{BLOCKS[-1]}"
    assert sparkline([3.0, 3.0], "_#") == "__"
    assert [time_text(seconds) for seconds in (5, 65.4, 3725)] == ["0:05", "1:05", "1:02:05"]


def test_a_run_ends_early_when_its_curve_is_flat(tiny_scene, tmp_path):
    effects = "water=off,lamp=off,exposure=off,caustics=off,moving_objects=off"
    settings = replace(SHORT, effects=effects, iterations=100, stop_when_flat=True)
    metrics = train_with(tiny_scene, tmp_path / "run", settings, schedule=UNCHANGING)["metrics"]
    # Flat at 80 %, the earliest that is examined; the frozen last tenth still follows.
    assert 88 <= metrics["iteration"] <= 92
    assert not metrics["interrupted"] and "Finished early" in metrics["notes"][-1]
    stops = iter([False] * 40 + [True])
    stopped = train_with(
        tiny_scene, tmp_path / "parts", settings, schedule=UNCHANGING, should_stop=lambda: next(stops)
    )["metrics"]
    assert stopped["interrupted"]
    resumed = train_with(tiny_scene, tmp_path / "parts", settings, schedule=UNCHANGING, resume=True)["metrics"]
    assert (resumed["iteration"], resumed["psnr"]) == (metrics["iteration"], metrics["psnr"])


def test_parts_are_counted_without_the_parts_inside_them():
    now = 0.0

    def wait(seconds):
        nonlocal now
        now += seconds

    ledger = timing.Ledger(clock=lambda: now)

    @timing.part("water")
    def water():
        wait(3)

    water()  # not counted outside of an iteration
    for _ in range(2):
        with ledger.iteration():
            wait(1)
            with timing.part("render"):
                wait(2)
                water()
                wait(4)
    assert ledger.milliseconds() == {"render": 6000, "water": 3000, "other": 1000}


def test_the_ledger_of_a_run_adds_up_to_its_iterations(tiny_scene, tmp_path):
    ledger = train(tiny_scene, tmp_path / "run", SHORT)["metrics"]["ledger"]
    assert {"rasterise", "rasterise backward", "optimiser", "loss L1 and SSIM", "other"} <= set(ledger)
    assert min(ledger.values()) >= 0
