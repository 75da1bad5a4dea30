"""What each method, and each part of ours, is worth on a scene: the same run many times with one thing changed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path
from ..effects.registry import REGISTRY
from ..formats.run_folder import RunFolder, read_json, write_json
from ..planning.plan import Plan, plan_scene
from ..settings.effect_names import EFFECTS, TOGETHER
from ..settings.recipes import RECIPES, SWITCHES, has, recipe_of
from ..settings.settings import TrainSettings
from ..training.trainer import train
from .evaluate_run import evaluate_run

OURS = "swag"
ALL = ",".join(f"{name}=on" for name, effect in REGISTRY.items() if not effect.needs_network)
"""Every effect that needs no network."""
FIGURES = {
    "psnr": "validation PSNR",
    "test_psnr": "test PSNR",
    "test_ssim": "SSIM",
    "delta_e": "delta E",
    "floater_mass": "floaters",
    "gaussians": "Gaussians",
    "seconds": "seconds",
}


@dataclass(frozen=True)
class Row:
    """One line of the table: what it is called, and the settings that make it."""

    name: str
    recipe: str
    effects: str = ""


def rows(plan: Plan | None = None) -> list[Row]:
    """Every recipe, and ours with each effect switched to what it is not for a scene with these effects.

    plan: the scene's, None where it is not known.
    """
    ours = recipe_of(OURS, "", plan.switches() if plan else None)
    table = [Row(name, name) for name in RECIPES]
    for effect in (*TOGETHER, *EFFECTS, *SWITCHES):
        on = has(ours, TOGETHER.get(effect, (effect,))[0])
        state, word = ("off", "without") if on else ("on", "with")
        if recipe_of(OURS, f"{effect}={state}", plan.switches() if plan else None) != ours:
            table.append(Row(f"{OURS} {word} {effect.replace('_', ' ')}", OURS, f"{effect}={state}"))
    table.append(Row(f"{OURS} with all", OURS, ALL))
    return table


def ablate(
    scene: Path,
    out: Path,
    seeds: int,
    settings: TrainSettings,
    weights_dir: Path | None = None,
    on_run: Callable[[str, int, dict[str, Any]], None] = lambda name, seed, figures: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Train and evaluate every row with seeds 0 to seeds - 1; write ablation.json and ablation.md to the folder `out`.

    `settings` gives size and length of the runs. A run that is there already is not made again, and one that was
    stopped goes on, so that the same call after an interruption ends where an uninterrupted one would. on_run gets
    the name of the row, the seed and the figures of each run. Returns the document in ablation.json: `rows` with
    `mean` and `spread` (standard deviation over the seeds) of each of FIGURES, and `interrupted`.
    Raises InputError as train does, and where `out` holds runs of another scene or size.
    """
    return compare_rows(rows(plan_scene(scene)), scene, out, seeds, settings, weights_dir, on_run, should_stop)


def compare_rows(
    compared: Sequence[Row],
    scene: Path,
    out: Path,
    seeds: int,
    settings: TrainSettings,
    weights_dir: Path | None = None,
    on_run: Callable[[str, int, dict[str, Any]], None] = lambda name, seed, figures: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Train and evaluate these rows; everything else as of `ablate`."""
    if seeds < 1:
        raise InputError(f"The number of seeds must be 1 or more, not {seeds}.")
    document: dict[str, Any] = {"scene": str(scene), "settings": settings.to_json(), "seeds": seeds, "rows": []}
    document["interrupted"] = False
    for row in compared:
        figures: list[dict[str, Any]] = []
        for seed in range(seeds):
            changed: dict[str, Any] = {"recipe": row.recipe, "effects": row.effects, "seed": seed}
            wanted = replace(settings, **changed)
            found = _figures(scene, out / row.name.replace(" ", "-") / f"seed-{seed}", wanted, weights_dir, should_stop)
            if found is None:
                document["interrupted"] = True
                break
            figures.append(found)
            on_run(row.name, seed, found)
        if figures:
            document["rows"].append(_summary(row, figures))
            write_json(out / "ablation.json", document)
            with atomic_path(out / "ablation.md") as temporary:
                temporary.write_text(table(document) + "\n", encoding="utf-8")
        if document["interrupted"]:
            break
    return document


def _figures(
    scene: Path, folder: Path, settings: TrainSettings, weights_dir: Path | None, should_stop: Callable[[], bool]
) -> dict[str, Any] | None:
    """The figures of one run, made or found; None where it was stopped before its end."""
    metrics = metrics_of_run(scene, folder, settings, weights_dir, should_stop)
    if metrics is None:
        return None
    stored = folder / "evaluation.json"
    evaluation = read_json(stored, "") if stored.exists() else evaluate_run(folder, weights_dir)
    values = metrics | {"floater_mass": evaluation["floater_mass"], "delta_e": evaluation["restored"]["delta_e"]}
    return {name: values[name] for name in FIGURES} | {"water": metrics["water"], "notes": metrics["notes"]}


def metrics_of_run(
    scene: Path, folder: Path, settings: TrainSettings, weights_dir: Path | None, should_stop: Callable[[], bool]
) -> dict[str, Any] | None:
    """metrics.json of a run: made, gone on with, or found finished; None where it was stopped before its end.

    Raises InputError as train does, and where the folder holds a run of another scene or of other settings.
    """
    run, settings = RunFolder(folder), settings.sized()
    if should_stop():
        return None
    if run.config.exists():
        known = run.read_config()
        if known[0].resolve() != scene.resolve() or known[1] != settings:
            raise InputError(f"{folder} holds a run of another scene or other settings: choose another folder.")
    if not (run.config.exists() and run.finished()):
        result = train(scene, folder, settings, run.config.exists(), should_stop=should_stop, weights_dir=weights_dir)
        if result["interrupted"]:
            return None
    return read_json(run.metrics, f"{folder} has no figures: delete it.")


def _summary(row: Row, figures: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean and spread of each figure that is known; None where no run has it."""
    mean: dict[str, float | None] = {}
    spread: dict[str, float | None] = {}
    for name in FIGURES:
        known = [f[name] for f in figures if f[name] is not None and np.isfinite(f[name])]
        mean[name] = float(np.mean(known)) if known else None
        spread[name] = float(np.std(known, ddof=1)) if len(known) > 1 else None
    notes = sorted({note for f in figures for note in [f["water"], *f["notes"]] if note})
    return {"name": row.name, "recipe": row.recipe, "effects": row.effects, "mean": mean, "spread": spread} | {
        "runs": figures,
        "notes": notes,
    }


def table(document: dict[str, Any]) -> str:
    """The rows as a Markdown table: mean, and spread over the seeds where there are several."""
    lines = ["| method | " + " | ".join(FIGURES.values()) + " |", "|---" * (len(FIGURES) + 1) + "|"]
    digits = {"psnr": 2, "test_psnr": 2, "test_ssim": 3, "delta_e": 1, "gaussians": 0, "seconds": 0}
    for row in document["rows"]:
        cells = []
        for name in FIGURES:
            mean, spread = row["mean"][name], row["spread"][name]
            if mean is None:
                cells.append("-")
            elif name == "floater_mass":
                cells.append(f"{mean:.1%}")
            else:
                shown = f"{mean:.{digits[name]}f}"
                with_spread = spread is not None and name in ("psnr", "test_psnr")
                cells.append(f"{shown} ± {spread:.2f}" if with_spread else shown)
        lines.append(f"| {row['name']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
