"""Forecast of the time, memory and quality of a run, from two short probe runs and from earlier runs on the machine.

forecast_scene(Path("SCENE"))                     # of each preset, with ranges
expected_outcome(Path("SCENE"), settings)         # of one run, from the last forecast of its scene
record_outcome(Path("RUN"), expected, seconds)    # keep the outcome for the next forecast
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
from ..kernels.hardware import hardware_of
from ..scene.colmap import Scene, load_scene
from ..scene.images import cache_folder, cache_root
from ..settings.presets import PRESETS, Size
from ..settings.recipes import recipe_of
from ..settings.settings import TrainSettings
from ..training.pacing.memory import needed
from ..training.pacing.preset_size import fit_preset, limit_gaussians, sizes_of_presets
from ..training.pacing.speed import Extent, Speed, measure_speed, predicted_seconds
from ..training.trainer import train

Progress = Callable[[str, float], None]
"""A function of the stage and its fraction (0..1)."""
FIRST_PROBE = Size(60, 240, 5_000)
"""Size of the first probe run, which takes seconds."""
SECOND_PROBE = Size(170, 340, 12_000)
"""Size of the second probe run; its gain in PSNR over the first predicts that of longer runs."""
GAIN = 1.5
"""Factor in PSNR after T iterations = second probe + GAIN * slope * ln(T / 170)^GAIN_EXPONENT, with the slope in dB per
ln of iterations between the probes. Fitted to 500 to 9000 iterations of three scenes at 480 pixels (train_scenes.json
and tradeoff_*.json in benchmarks/results): the median error is 0.4 dB, the largest 1.2 dB."""
GAIN_EXPONENT = 0.25
"""Exponent in the same formula."""
ERROR_DB = 0.3
"""Half the range of the predicted PSNR, dB, before what grows with the gain."""
ERROR_OF_GAIN = 0.2
"""Half the range of the predicted PSNR as a fraction of the predicted gain."""
LEAST = 0.75
"""Shortest time as a fraction of the predicted one, while fewer than ENOUGH runs are known on the machine."""
MOST = 1.5
"""Longest time as a fraction of the predicted one, while fewer than ENOUGH runs are known on the machine."""
ENOUGH = 3
"""Runs on the machine from which on their own times give the range."""
KEPT_OUTCOMES = 200
"""Outcomes of runs that are kept in the cache, at most."""
BASE_MB = 500
"""Memory of Python, torch and the kernels, MB."""


def forecast_scene(
    scene_folder: Path, settings: TrainSettings | None = None, progress: Progress = lambda stage, fraction: None
) -> dict[str, Any]:
    """Predict time, memory and quality of each preset, and keep the forecast for `expected_outcome`.

    Args:
        scene_folder: Folder of the scene.
        settings: Settings of the run; sizes in them replace those of the presets.
        progress: Gets the stage and its fraction.

    Returns:
        {"presets": {name: {"iterations", "width", "max_gaussians", "seconds": [least, likely, most], "psnr": the same
        in dB on validation images, or None, "memory_mb"}}, "sizes": as `sizes_of_presets` returns, ...}.

    Raises:
        InputError: For anything wrong with the scene.
    """
    settings = settings or TrainSettings()
    scene = load_scene(scene_folder)
    progress("Speed", 0.0)
    speed, extent = measure_speed(scene, settings), Extent.of(scene)
    looks = []
    for number, size in enumerate((FIRST_PROBE, SECOND_PROBE)):
        progress("Probe runs", number / 2)
        sized = replace(settings, preset="draft", time_budget="", **size.numbers())
        psnr, training, seconds = _probe(scene_folder, sized)
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
    past = [entry for entry in past_outcomes() if entry["machine"] == document["machine"]]
    presets = {}
    for name in PRESETS:
        sized, _ = limit_gaussians(scene, fit_preset(scene, replace(settings, preset=name, time_budget=""), speed))
        presets[name] = _expected(document, extent, sized, past, scene_folder)
    progress("Probe runs", 1.0)
    return document | {"presets": presets, "sizes": sizes_of_presets(scene, settings, speed)}


def corrected_speed(speed: Speed, predicted: float, training: float, whole: float) -> tuple[Speed, float]:
    """Correct a speed that was measured over few iterations by the time of a probe run, which has more.

    Args:
        speed: Measured speed.
        predicted: Time that this speed predicts for the training of the probe run, s.
        training: Time that the training took, s.
        whole: Time of the whole probe run, s.

    Returns:
        The speed, never slower than before, and the time of the run without its training, s.
    """
    factor = min(1.0, training / predicted)
    return speed.times(factor), max(0.0, whole - factor * predicted)


def expected_outcome(scene_folder: Path, settings: TrainSettings) -> dict[str, Any] | None:
    """Predict time, memory and quality of one run from the last forecast of its scene.

    Args:
        scene_folder: Folder of the scene.
        settings: Settings of the run.

    Returns:
        As a preset in `forecast_scene`; None where the scene has no forecast on this machine with the same recipe and
        effects, or the run has a time budget.
    """
    try:
        scene = load_scene(scene_folder)
        document = from_json(_remembered(scene).read_text())
        same = all(document[name] == getattr(settings, name) for name in ("recipe", "effects"))
        if settings.budget or not same or document["machine"] != machine(settings):
            return None
        past = [entry for entry in past_outcomes() if entry["machine"] == document["machine"]]
        sized, _ = limit_gaussians(scene, fit_preset(scene, settings, Speed(**document["speed"])))
        return _expected(document, Extent.of(scene), sized, past, scene_folder)
    except (OSError, ValueError, LookupError, TypeError, InputError):  # there is no forecast, or its file is damaged
        return None


def record_outcome(run_folder: Path, expected: dict[str, Any] | None, seconds: float) -> None:
    """Keep the outcome of a finished run for later forecasts, and write forecast.json to its folder.

    Args:
        run_folder: Folder of the run.
        expected: What `expected_outcome` returned before the run.
        seconds: Time of the whole run, with reading images and writing results.

    Raises:
        InputError: When a file of the run is missing or damaged, or a file cannot be written.
    """
    run = RunFolder(run_folder)
    scene, settings, _ = run.read_config()
    metrics = read_json(run.metrics, f"The run {run_folder} has no result yet.")
    if metrics["interrupted"] or expected is None:
        return
    outcome = {"seconds": round(seconds, 2), "psnr": metrics["psnr"], "gaussians": metrics["gaussians"]}
    write_json(run_folder / "forecast.json", {"expected": expected, "outcome": outcome})
    entry = {"machine": machine(settings), "scene": str(scene), "expected": expected, "outcome": outcome}
    entries = [*past_outcomes(), entry][-KEPT_OUTCOMES:]
    with atomic_path(_history_file()) as temporary:
        temporary.write_text("".join(to_json(entry) + "\n" for entry in entries), encoding="utf-8")


def past_outcomes() -> list[dict[str, Any]]:
    """Return the outcomes kept on this computer, oldest first, without lines that cannot be read."""
    try:
        lines = _history_file().read_text(encoding="utf-8").splitlines()
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
    """Return a name for what the speed of a run depends on: processor, cores, backend."""
    return f"{platform.machine()} {platform.node()}, {os.cpu_count()} cores, {hardware_of(settings).backend}"


def describe(forecast: dict[str, Any]) -> str:
    """Format a forecast as the table that `forecast SCENE` prints."""
    lines = [f"{'':<10}{'time':<26}{'validation PSNR':<28}{'memory':<10}size"]
    for name, line in forecast["presets"].items():
        least, likely, most = (time_text(seconds) for seconds in line["seconds"])
        psnr = "too few photos"
        if line["psnr"]:
            low, middle, high = line["psnr"]
            psnr = f"{middle:.1f} dB ({low:.1f} to {high:.1f})"
        time_range = f"{likely} ({least} to {most})"
        size = f"{line['iterations']} iterations, {line['width']} px, {line['max_gaussians']} Gaussians"
        lines.append(f"{name:<10}{time_range:<26}{psnr:<28}{line['memory_mb'] / 1000:<7.1f}GB {size}")
    return "\n".join(lines)


def time_text(seconds: float) -> str:
    """Format a duration: 45 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _probe(scene_folder: Path, settings: TrainSettings) -> tuple[float | None, float, float]:
    """Make a probe run; return the PSNR on validation images, and the seconds of the training and of the whole run."""
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
    first, error = _psnr(document["looks"], size.iterations)
    psnr = None
    if first is not None:
        here = [entry for entry in past if entry["scene"] == str(scene.resolve())]
        known = [(entry["outcome"]["psnr"], entry["expected"]["first_psnr"]) for entry in here]
        errors = [outcome - expected for outcome, expected in known if outcome and expected]
        likely_psnr = first + (float(np.median(errors)) if errors else 0.0)
        error = 0.5 * error + ERROR_DB if errors else error
        psnr = [round(likely_psnr + sign * error, 2) for sign in (-1, 0, 1)]
    return {
        **size.numbers(),
        "seconds": [round(guess * ratio, 2) for ratio in (least, likely, most)],
        "psnr": psnr,
        "memory_mb": round(_memory_mb(extent, size)),
        "first_guess": round(guess, 3),
        "first_psnr": first and round(first, 3),
    }


def _psnr(looks: list[float] | None, iterations: int) -> tuple[float | None, float]:
    """Predict the PSNR on validation images and its error, both in dB; None without probes of that."""
    if looks is None:
        return None, 0.0
    first, second = looks
    slope = max(0.0, second - first) / math.log(SECOND_PROBE.iterations / FIRST_PROBE.iterations)
    gain = GAIN * slope * max(0.0, math.log(iterations / SECOND_PROBE.iterations)) ** GAIN_EXPONENT
    return second + gain, ERROR_DB + ERROR_OF_GAIN * gain


def _memory_mb(extent: Extent, size: Size) -> float:
    return BASE_MB + needed(extent, size.width, size.max_gaussians) / 1e6


def _history_file() -> Path:
    return cache_root() / "history.jsonl"


def _remembered(scene: Scene) -> Path:
    return cache_folder(scene, "forecast") / "forecast.json"
