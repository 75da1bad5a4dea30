"""Ablation: every recipe, and the default recipe with each effect switched, trained on one scene over several seeds."""

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
from ..scene.colmap import Scene, load_scene
from ..settings.effect_names import EFFECTS, TOGETHER
from ..settings.presets import SIZES
from ..settings.recipes import RECIPES, SWITCHES, has, recipe_of
from ..settings.settings import TrainSettings
from ..training.pacing.preset_size import fit_preset
from ..training.trainer import train, with_scale_of
from .evaluate_run import evaluate_run

DEFAULT_RECIPE = "swag"
"""The recipe whose effects are switched."""
ALL = ",".join(f"{name}=on" for name, effect in REGISTRY.items() if not effect.needs_network)
"""The effects that need no network, all switched on."""
METRICS = {
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
    """One row of the table.

    Attributes:
        name: Name of the row.
        recipe: Recipe of its runs.
        effects: Effects that are switched by hand, as in the settings.
    """

    name: str
    recipe: str
    effects: str = ""


def ablation_rows(plan: Plan | None = None) -> list[Row]:
    """List the rows: every recipe, and the default recipe with each effect switched to the opposite of the plan.

    Args:
        plan: The plan of the scene, None for the defaults of the recipe.

    Returns:
        The rows in the order of the table.
    """
    default = recipe_of(DEFAULT_RECIPE, "", plan.switches() if plan else None)
    table = [Row(name, name) for name in RECIPES]
    for effect in (*TOGETHER, *EFFECTS, *SWITCHES):
        on = has(default, TOGETHER.get(effect, (effect,))[0])
        state, word = ("off", "without") if on else ("on", "with")
        if recipe_of(DEFAULT_RECIPE, f"{effect}={state}", plan.switches() if plan else None) != default:
            table.append(
                Row(f"{DEFAULT_RECIPE} {word} {effect.replace('_', ' ')}", DEFAULT_RECIPE, f"{effect}={state}")
            )
    table.append(Row(f"{DEFAULT_RECIPE} with all", DEFAULT_RECIPE, ALL))
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
    """Train and evaluate every row with several seeds; write ablation.json and ablation.md.

    A run that exists is not trained again, and one that was stopped is continued, so that the same call after an
    interrupt gives what an uninterrupted one would.

    Args:
        scene: Folder of the scene.
        out: Folder of the runs and of the two files.
        seeds: Number of runs of each row, with seeds from 0.
        settings: Size and length of the runs.
        weights_dir: Folder where networks are searched first.
        on_run: Gets the name of the row, the seed and the metrics of each run.
        should_stop: Asked between two iterations; when it returns true, the ablation ends.

    Returns:
        The document in ablation.json: `rows` with `mean` and `spread` (standard deviation over the seeds) of each of
        METRICS, and `interrupted`.

    Raises:
        InputError: As `train`, and where `out` holds runs of another scene or of other settings.
    """
    return compare_rows(ablation_rows(plan_scene(scene)), scene, out, seeds, settings, weights_dir, on_run, should_stop)


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
    """Train and evaluate given rows; the other arguments, result and errors are those of `ablate`."""
    if seeds < 1:
        raise InputError(f"The number of seeds must be 1 or more, not {seeds}.")
    # The same sizes for all rows, whatever the speed of each: those of the first run where there is one.
    sized = settings_of_run(load_scene(scene), _folder(out, compared[0], 0), settings)
    kept = {name: getattr(settings, name) or getattr(sized, name) for name in (*SIZES, "metres_per_unit")}
    settings = replace(settings, **kept)
    document: dict[str, Any] = {"scene": str(scene), "settings": settings.to_json(), "seeds": seeds, "rows": []}
    document["interrupted"] = False
    for row in compared:
        figures: list[dict[str, Any]] = []
        for seed in range(seeds):
            changed: dict[str, Any] = {"recipe": row.recipe, "effects": row.effects, "seed": seed}
            wanted = replace(settings, **changed)
            found = _metrics(scene, _folder(out, row, seed), wanted, weights_dir, should_stop)
            if found is None:
                document["interrupted"] = True
                break
            figures.append(found)
            on_run(row.name, seed, found)
        if figures:
            document["rows"].append(_summary(row, figures))
            write_json(out / "ablation.json", document)
            with atomic_path(out / "ablation.md") as temporary:
                temporary.write_text(format_table(document) + "\n", encoding="utf-8")
        if document["interrupted"]:
            break
    return document


def _folder(out: Path, row: Row, seed: int) -> Path:
    return out / row.name.replace(" ", "-") / f"seed-{seed}"


def _metrics(
    scene: Path, folder: Path, settings: TrainSettings, weights_dir: Path | None, should_stop: Callable[[], bool]
) -> dict[str, Any] | None:
    """Return the metrics of one run as METRICS has them, None where it was stopped before its end."""
    metrics = metrics_of_run(scene, folder, settings, weights_dir, should_stop)
    if metrics is None:
        return None
    stored = folder / "evaluation.json"
    evaluation = read_json(stored, "") if stored.exists() else evaluate_run(folder, weights_dir)
    values = metrics | {"floater_mass": evaluation["floater_mass"], "delta_e": evaluation["restored"]["delta_e"]}
    return {name: values[name] for name in METRICS} | {"water": metrics["water"], "notes": metrics["notes"]}


def metrics_of_run(
    scene: Path, folder: Path, settings: TrainSettings, weights_dir: Path | None, should_stop: Callable[[], bool]
) -> dict[str, Any] | None:
    """Return the metrics of a run; train it first, or continue it, where it is not finished.

    Args:
        scene: Folder of the scene.
        folder: Folder of the run.
        settings: Settings of the run, as `settings_of_run` returns them.
        weights_dir: Folder where networks are searched first.
        should_stop: Asked between two iterations.

    Returns:
        The document in metrics.json, None where the run was stopped before its end.

    Raises:
        InputError: As `train`, and where the folder holds a run of another scene or of other settings.
    """
    run = RunFolder(folder)
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
    return read_json(run.metrics, f"{folder} has no metrics.json: delete the folder and start again.")


def settings_of_run(scene: Scene, folder: Path, asked: TrainSettings) -> TrainSettings:
    """Return the settings that a run has, or that `train` would give it.

    Args:
        scene: The scene.
        folder: Folder of the run, which need not exist.
        asked: What the user chose.

    Returns:
        Settings with all sizes: those of the run where there is one, so that it is continued as it was started.

    Raises:
        InputError: If the run's config.json or a photo cannot be read.
    """
    run = RunFolder(folder)
    return run.read_config()[1] if run.config.exists() else fit_preset(scene, with_scale_of(scene, asked))


def _summary(row: Row, figures: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a row of the document: mean and standard deviation of each metric, None where too few runs have it."""
    mean: dict[str, float | None] = {}
    spread: dict[str, float | None] = {}
    for name in METRICS:
        known = [f[name] for f in figures if f[name] is not None and np.isfinite(f[name])]
        mean[name] = float(np.mean(known)) if known else None
        spread[name] = float(np.std(known, ddof=1)) if len(known) > 1 else None
    notes = sorted({note for f in figures for note in [f["water"], *f["notes"]] if note})
    return {"name": row.name, "recipe": row.recipe, "effects": row.effects, "mean": mean, "spread": spread} | {
        "runs": figures,
        "notes": notes,
    }


def format_table(document: dict[str, Any]) -> str:
    """Format the result of `ablate` as a Markdown table.

    Args:
        document: What `ablate` returned.

    Returns:
        The table: means, for PSNR with the standard deviation where there are several seeds.
    """
    lines = ["| method | " + " | ".join(METRICS.values()) + " |", "|---" * (len(METRICS) + 1) + "|"]
    digits = {"psnr": 2, "test_psnr": 2, "test_ssim": 3, "delta_e": 1, "gaussians": 0, "seconds": 0}
    for row in document["rows"]:
        cells = []
        for name in METRICS:
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
