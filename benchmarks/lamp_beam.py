"""Decide about the beam of a lamp on generated scenes, and compare runs with and without it.

Run: `python benchmarks/lamp_beam.py FOLDER [--seeds 21 22]`
Results: benchmarks/results/lamp_beam.json

A lamp at the camera lights a room or a street in clear or colored water: alone, with a lens that falls off, or with a
wide or a narrow beam that points beside the middle of the photos. Some of these scenes, and the photographs of
aqualoc_amphorae where they are there, are then trained without and with the beam. How bright a place is under a lamp
has no true value, so that restored colors get the one exposure that suits them best, as in restored_colors.py.
"""

import json
import sys
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import SHARED, write_results
from benchmarks.effects_matrix import BLUE, NO_WATER
from benchmarks.restoration_limit import COAST, SETTINGS
from benchmarks.restored_colors import OURS, compare
from swag_engine.formats.run_folder import RunFolder
from swag_engine.planning.plan import plan_scene
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train
from tests.scenes.effect_scenes import rendered, settings_for
from tests.scenes.make_scene import Water, make_scene

PLACES = {"room": "around", "street": "walk"}
"""Pattern of the cameras by place."""
WATERS = {"clear": Water(**NO_WATER), "blue": Water(**BLUE), "coast": COAST}
LIGHTS: dict[str, dict[str, float]] = {
    "lamp": {},
    "lamp, exposure": {"exposure": 0.1},
    "lamp, lens": {"vignetting": 0.35},
    "lamp, wide beam": {"beam": 0.4},
    "lamp, beam": {"beam": 1.0},
    "lamp, beam, exposure": {"beam": 1.0, "exposure": 0.1},
}
TRAINED = (
    ("room", "coast", "lamp"),
    ("room", "coast", "lamp, beam"),
    ("room", "blue", "lamp, beam, exposure"),
    ("room", "blue", "lamp, lens"),
    ("street", "clear", "lamp, beam"),
    ("street", "coast", "lamp, beam"),
)
"""Scenes that are trained, of the second seed."""
REAL = TrainSettings(iterations=1000, width=480, max_gaussians=72_000)
"""Settings for photographs: those of a draft."""


def make(folder: Path, seeds: list[int]) -> dict[tuple[str, str, str, int], Path]:
    """Return the folders of the scenes by place, water, light and seed, making those that are not there."""
    made = {}
    for place, pattern in PLACES.items():
        for seed in seeds:
            for water in WATERS:
                for light, amounts in LIGHTS.items():
                    out = folder / f"{place}-{water}-{light.replace(', ', '-').replace(' ', '-')}-{seed}"
                    made[place, water, light, seed] = out
                    if not (out / "truth.json").exists():
                        effects = {"water": WATERS[water], "lamp": 1.0, **amounts}
                        make_scene(settings_for(out, seed=seed, **effects), rendered(folder, pattern, seed))
    return made


def summary(decisions: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return by light how often lamp, beam and water are on, and the ranges of the beam's figures where the lamp is.

    Water is on where attenuation and backscatter both are; false water where one of them is in clear water.
    """
    found = {}
    for light in LIGHTS:
        rows = [row for row in decisions if row["light"] == light]
        lit = [row for row in rows if row["lamp"] == "on"]
        found[light] = {
            "scenes": len(rows),
            "lamp_on": len(lit),
            "beam_on": sum(row["beam"] == "on" for row in lit),
            "in_water": sum(row["water"] != "clear" for row in rows),
            "water_on": sum(
                row["water"] != "clear" and row["attenuation"] == row["backscatter"] == "on" for row in rows
            ),
            "false_water": sum(
                row["water"] == "clear" and "on" in (row["attenuation"], row["backscatter"]) for row in rows
            ),
            "bic_gain": [min(row["bic_gain"] for row in lit), max(row["bic_gain"] for row in lit)],
            "falloff": [min(row["falloff"] for row in lit), max(row["falloff"] for row in lit)],
        }
    return found


def run_both(scene: Path, out: Path, settings: TrainSettings, with_truth: bool) -> dict[str, dict[str, float]]:
    """Train a scene without and with the beam; return PSNR of test views, dB, and delta E of restored photos."""
    found = {}
    for state in ("off", "on"):
        run = out / f"run-{scene.name}-{state}"
        if not RunFolder(run).finished():
            train(scene, run, replace(settings, effects=f"beam={state}"))
        metrics = json.loads((run / "metrics.json").read_text("utf-8"))
        found[state] = {"psnr": metrics["test_psnr"], "validation_psnr": metrics["psnr"]}
        if with_truth:
            row = compare(scene, run)[0]
            found[state] |= {"delta_e": row[OURS]["delta_e"], "best_gain": row["best gain"]["delta_e"]}
    return found


def main() -> None:
    """Decide, train, and write the results."""
    parser = ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22])
    chosen = parser.parse_args()
    decisions: list[dict[str, Any]] = []
    scenes = make(chosen.folder, chosen.seeds)
    for (place, water, light, seed), scene in scenes.items():
        effects = plan_scene(scene, scene).effects
        evidence = effects["beam"].evidence
        row = {"place": place, "water": water, "light": light, "seed": seed}
        row |= {name: effects[name].state for name in ("lamp", "beam", "attenuation", "backscatter")}
        row |= {key: evidence.get(key) for key in ("falloff", "bic_gain")}
        print(row, flush=True)
        decisions.append(row)
    runs = {}
    for place, water, light in TRAINED:
        scene = scenes[place, water, light, chosen.seeds[-1]]
        runs[f"{place}, {water}, {light}"] = run_both(scene, chosen.folder, SETTINGS, with_truth=True)
        print(place, water, light, runs[f"{place}, {water}, {light}"], flush=True)
    if (real := SHARED / "aqualoc_amphorae").exists():
        runs["aqualoc_amphorae"] = run_both(real, chosen.folder, REAL, with_truth=False)
        print(real.name, runs[real.name], flush=True)
    write_results("lamp_beam", {"decisions": summary(decisions), "runs": runs})


if __name__ == "__main__":
    main()
