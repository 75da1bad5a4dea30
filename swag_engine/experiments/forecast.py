"""What a run will take and reach, before it begins: from a first look of some seconds, and from earlier runs here.

forecast = forecast_scene(Path("SCENE"))       time, memory and quality of each preset, with ranges
expectation(Path("SCENE"), settings)           the same for one run, from the last forecast of its scene
record(Path("RUN"), expected, seconds)         the outcome beside it, kept for the next forecast
"""

import math
import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path
from ..base.strict_json import from_json, to_json
from ..formats.run_folder import RunFolder, read_json, write_json
from ..kernels.backends import device_for
from ..scene.colmap import Scene, load_scene
from ..scene.images import cache_folder, cache_root
from ..settings.presets import PRESETS, Size
from ..settings.recipes import recipe_of
from ..settings.settings import TrainSettings
from ..training.pacing.memory import needed
from ..training.pacing.speed import Extent, Speed, measure_speed, predicted_seconds
from ..training.trainer import train

Progress = Callable[[str, float], None]
FIRST_LOOK, SECOND_LOOK = Size(60, 240, 5_000), Size(170, 340, 12_000)
"""Two small runs: what the second gains over the first says how much there is to gain."""
GAIN, GAIN_EXPONENT = 1.5, 0.25
"""PSNR after T iterations = second + GAIN * slope * ln(T / 170)^GAIN_EXPONENT, with the slope in dB per ln of
iterations between the two looks: fitted to 500 to 9000 iterations of three scenes at 480 pixels (train_scenes.json and
tradeoff_*.json in benchmarks/results), where it is off by .4 dB at the median and by 1.2 dB at most."""
SPREAD_DB, SPREAD_OF_GAIN = 0.3, 0.2
LEAST, MOST = 0.75, 1.5
"""Of the time that a first look promises, where no run on this machine has told more."""
ENOUGH = 3
"""Runs that tell how far time strays."""
REMEMBERED = 200
"""Outcomes that are kept."""
BASE_MB = 500


def forecast_scene(
    scene_folder: Path, settings: TrainSettings | None = None, progress: Progress = lambda stage, fraction: None
) -> dict[str, Any]:
    """Time, memory and quality of each preset, with the settings' own numbers where they have some.

    Returns {"presets": {name: {"iterations", "width", "max_gaussians", "seconds": [least, likely, most], "psnr": the
    same in dB on validation views or None, "memory_mb"}}, ...} and remembers it for `expectation`. progress gets
    (stage, fraction 0..1). Raises InputError for anything wrong with the scene.
    """
    settings = settings or TrainSettings()
    scene = load_scene(scene_folder)
    progress("Speed", 0.0)
    speed, extent = measure_speed(scene, settings), Extent.of(scene)
    looks = []
    for number, size in enumerate((FIRST_LOOK, SECOND_LOOK)):
        progress("First looks", number / 2)
        sized = replace(settings, preset="draft", time_budget="", **size.numbers())
        psnr, training, seconds = _look(scene_folder, sized)
        looks.append(psnr)
    speed, beside = corrected_speed(speed, _predicted(speed, extent, sized), training, seconds)
    document: dict[str, Any] = {
        "machine": machine(settings),
        "recipe": settings.recipe,
        "effects": settings.effects,
        "speed": asdict(speed),
        "seconds_beside": beside,  # what each run takes whatever its size: planning, above all
        "looks": looks if None not in looks else None,
    }
    with atomic_path(_remembered(scene)) as temporary:
        temporary.write_text(to_json(document))
    past = [entry for entry in history() if entry["machine"] == document["machine"]]
    presets = {}
    for name in PRESETS:
        sized = replace(settings, preset=name, time_budget="").sized()
        presets[name] = _expected(document, extent, sized, past, scene_folder)
    progress("First looks", 1.0)
    return document | {"presets": presets}


def corrected_speed(speed: Speed, predicted: float, training: float, whole: float) -> tuple[Speed, float]:
    """Reduce the times of a speed that was measured beside other work to those of a run, which has more iterations.

    All in seconds: predicted and real time of the run's training, and of the whole run. Returns the speed, and what
    the run took beside its training.
    """
    factor = min(1.0, training / predicted)
    return speed.times(factor), max(0.0, whole - factor * predicted)


def expectation(scene_folder: Path, settings: TrainSettings) -> dict[str, Any] | None:
    """What a run with these settings should take and reach; None where the scene has no forecast with this machine and
    method, or time is what limits the run."""
    try:
        scene = load_scene(scene_folder)
        document = from_json(_remembered(scene).read_text())
        same = all(document[name] == getattr(settings, name) for name in ("recipe", "effects"))
        if settings.budget or not same or document["machine"] != machine(settings):
            return None
        past = [entry for entry in history() if entry["machine"] == document["machine"]]
        return _expected(document, Extent.of(scene), settings.sized(), past, scene_folder)
    except (OSError, ValueError, LookupError, TypeError, InputError):  # none was made, or one that cannot be read
        return None


def record(run_folder: Path, expected: dict[str, Any] | None, seconds: float) -> None:
    """Keep what a finished run took, and write RUN/forecast.json: what was expected beside it.

    seconds: of the whole run, with reading photographs and writing results.
    """
    run = RunFolder(run_folder)
    scene, settings, _ = run.read_config()
    metrics = read_json(run.metrics, f"The run {run_folder} has no result yet.")
    if metrics["interrupted"] or expected is None:
        return
    outcome = {"seconds": round(seconds, 2), "psnr": metrics["psnr"], "gaussians": metrics["gaussians"]}
    write_json(run_folder / "forecast.json", {"expected": expected, "outcome": outcome})
    entry = {"machine": machine(settings), "scene": str(scene), "expected": expected, "outcome": outcome}
    entries = [*history(), entry][-REMEMBERED:]
    with atomic_path(_history()) as temporary:
        temporary.write_text("".join(to_json(entry) + "\n" for entry in entries), encoding="utf-8")


def history() -> list[dict[str, Any]]:
    """The runs that were recorded on this computer, oldest first; lines that cannot be read are left out."""
    try:
        lines = _history().read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    entries = []
    for line in lines:
        try:
            entry = from_json(line)
            float(entry["outcome"]["seconds"]) / float(entry["expected"]["first_guess"])
            entry["machine"], entry["scene"], entry["outcome"]["psnr"], entry["expected"]["first_psnr"]
        except (ValueError, KeyError, TypeError, ZeroDivisionError):
            continue
        entries.append(entry)
    return entries


def machine(settings: TrainSettings) -> str:
    """What decides how fast a run is: processor, cores, backend."""
    return f"{platform.machine()} {platform.node()}, {os.cpu_count()} cores, {device_for(settings.backend)}"


def describe(forecast: dict[str, Any]) -> str:
    """The lines that `forecast SCENE` prints."""
    lines = [f"{'':<10}{'time':<26}{'validation PSNR':<28}memory"]
    for name, line in forecast["presets"].items():
        least, likely, most = (time_text(seconds) for seconds in line["seconds"])
        psnr = "too few photographs"
        if line["psnr"]:
            low, middle, high = line["psnr"]
            psnr = f"{middle:.1f} dB ({low:.1f} to {high:.1f})"
        time_range = f"{likely} ({least} to {most})"
        lines.append(f"{name:<10}{time_range:<26}{psnr:<28}{line['memory_mb'] / 1000:.1f} GB")
    return "\n".join(lines)


def time_text(seconds: float) -> str:
    """A duration as people say it: 45 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _look(scene_folder: Path, settings: TrainSettings) -> tuple[float | None, float, float]:
    """PSNR on validation views, and seconds: of the training, and of all."""
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        metrics = train(scene_folder, Path(folder) / "run", settings)["metrics"]
    return metrics["psnr"], metrics["seconds"], time.monotonic() - started


def _predicted(speed: Speed, extent: Extent, settings: TrainSettings) -> float:
    size = Size(settings.iterations, settings.width, settings.max_gaussians)
    return predicted_seconds(speed, extent, size, recipe_of(settings.recipe, settings.effects).densify_until)


def _expected(
    document: dict[str, Any], extent: Extent, settings: TrainSettings, past: list[dict[str, Any]], scene: Path
) -> dict[str, Any]:
    size = Size(settings.iterations, settings.width, settings.max_gaussians)
    guess = _predicted(Speed(**document["speed"]), extent, settings) + document["seconds_beside"]
    ratios = [entry["outcome"]["seconds"] / entry["expected"]["first_guess"] for entry in past]
    likely = float(np.median(ratios)) if ratios else 1.0
    least, most = LEAST * likely, MOST * likely
    if len(ratios) >= ENOUGH:
        least, most = min(0.9 * likely, min(ratios)), max(1.1 * likely, max(ratios))
    first, spread = _psnr(document["looks"], size.iterations)
    psnr = None
    if first is not None:
        here = [entry for entry in past if entry["scene"] == str(scene.resolve())]
        known = [(entry["outcome"]["psnr"], entry["expected"]["first_psnr"]) for entry in here]
        errors = [outcome - expected for outcome, expected in known if outcome and expected]
        likely_psnr = first + (float(np.median(errors)) if errors else 0.0)
        spread = 0.5 * spread + SPREAD_DB if errors else spread
        psnr = [round(likely_psnr + sign * spread, 2) for sign in (-1, 0, 1)]
    return {
        **size.numbers(),
        "seconds": [round(guess * ratio, 2) for ratio in (least, likely, most)],
        "psnr": psnr,
        "memory_mb": round(_memory_mb(extent, size)),
        "first_guess": round(guess, 3),
        "first_psnr": first and round(first, 3),
    }


def _psnr(looks: list[float] | None, iterations: int) -> tuple[float | None, float]:
    """dB on validation views after so many iterations, and how far off that may be; None without such views."""
    if looks is None:
        return None, 0.0
    first, second = looks
    slope = max(0.0, second - first) / math.log(SECOND_LOOK.iterations / FIRST_LOOK.iterations)
    gain = GAIN * slope * max(0.0, math.log(iterations / SECOND_LOOK.iterations)) ** GAIN_EXPONENT
    return second + gain, SPREAD_DB + SPREAD_OF_GAIN * gain


def _memory_mb(extent: Extent, size: Size) -> float:
    return BASE_MB + needed(extent, size.width, size.max_gaussians) / 1e6


def _history() -> Path:
    return cache_root() / "history.jsonl"


def _remembered(scene: Scene) -> Path:
    return cache_folder(scene, "forecast") / "forecast.json"
