"""Measure how often the plan's decisions are right on generated scenes of known truth.

Run: `python benchmarks/effects_matrix.py [--clean FOLDER] [--only tuning|final|land] [--workers N]`
Results: benchmarks/results/effects_matrix.json (summary and seeds), docs/images/effects_matrix.webp

A reef with a wreck is rendered without water by Cycles along three camera patterns; a street, a room and flat ground
are ray-cast. Water, lamp, exposure, caustics, fish, vignetting and a phone's image processing are added with amounts
drawn by each scene's seed. The thresholds of the plan were chosen on seeds 0 to 4 (the set "tuning" has three of them)
and frozen; the sets "final" (seed 7) and "land" (five seeds of scenes in air) were drawn afterwards.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import RESULTS, save_chart, write_results

EFFECTS = ("attenuation", "backscatter", "lamp", "exposure", "vignetting", "caustics")
STATES = ("on", "off", "unknown")
SEEN = 5.0
"""Change (8-bit display values, 95th percentile over pixels) above which an effect counts as visible."""
LEAST_FALLOFF = 0.03
"""Fraction of its light that a lens must lose at the corners; less is not visible and counts as absent."""
NO_WATER = {"beta_D": (0.0, 0.0, 0.0), "beta_B": (0.0, 0.0, 0.0), "B_inf": (0.0, 0.0, 0.0)}
BLUE = {"beta_D": (0.17, 0.062, 0.042), "beta_B": (0.13, 0.08, 0.068), "B_inf": (0.03, 0.175, 0.255)}
GREEN = {"beta_D": (0.25, 0.10, 0.14), "beta_B": (0.20, 0.12, 0.13), "B_inf": (0.05, 0.20, 0.12)}
SCENES: dict[str, dict] = {
    "clear": {},
    "clear, exposure": {"exposure": 0.12},
    "clear, caustics": {"caustics": 0.8},
    "clear, lens": {"vignetting": 0.35},
    "clear, faint lens": {"vignetting": 0.02},
    "clear, lamp": {"lamp": 1.0},
    "blue": {"water": BLUE},
    "blue, weak": {"water": BLUE, "amount": 0.35},
    "green": {"water": GREEN},
    "attenuation only": {"water": BLUE | {"B_inf": (0.0, 0.0, 0.0)}},
    "blue, lamp": {"water": BLUE, "lamp": 1.0},
    "green, lamp, exposure": {"water": GREEN, "lamp": 0.8, "exposure": 0.08},
    "green, weak, caustics, exposure": {"water": GREEN, "amount": 0.4, "caustics": 0.5, "exposure": 0.06},
    "blue, lens": {"water": BLUE, "vignetting": 0.35},
    "green, lens, exposure": {"water": GREEN, "vignetting": 0.3, "exposure": 0.1},
    "blue, lamp, lens": {"water": BLUE, "lamp": 1.0, "vignetting": 0.35},
    "green, fish": {"water": GREEN, "fish": True},
}
SKY = NO_WATER | {"B_inf": (0.35, 0.55, 0.95)}
"""Scenes in air: the color of the sky behind them, no attenuation and no backscatter."""
LAND: dict[str, dict] = {
    "land": {"water": SKY},
    "land, exposure": {"water": SKY, "exposure": 0.12},
    "land, lens": {"water": SKY, "vignetting": 0.4},
    "land, telephone": {"water": SKY, "phone": 1.0},
    "land, telephone, exposure": {"water": SKY, "phone": 1.0, "exposure": 0.15},
    "land, telephone, lens": {"water": SKY, "phone": 1.0, "vignetting": 0.3},
}
BOXES: dict[str, dict[str, dict]] = {
    "walk": LAND | {"blue, weak": {"water": BLUE, "amount": 0.5}, "green, exposure": {"water": GREEN, "exposure": 0.1}},
    "around": LAND | {"clear, lamp": {"lamp": 1.0}},
    "survey": {
        "land": {},
        "land, telephone, lens": {"phone": 1.0, "vignetting": 0.3},
        "blue": {"water": BLUE},
        "green, lens": {"water": GREEN, "vignetting": 0.35},
        "blue, lamp": {"water": BLUE, "lamp": 1.0},
    },
}
"""Scenes of the ray-cast models (street, room, flat ground), by camera pattern."""
SURVEYS = ("nadir", "survey")
"""Patterns at a constant height over flat ground: range follows the position in the image, so that water, lamp and
vignetting cannot be separated and "undetermined" is the right decision."""
OF_RANGE = ("attenuation", "backscatter", "lamp", "vignetting")
"""Effects that cannot be separated there."""


@dataclass(frozen=True)
class Case:
    """A generated scene: its name in SCENES or BOXES, the camera pattern, the seed of its model and amounts."""

    name: str
    pattern: str
    seed: int

    def effects(self) -> dict:
        """Return the arguments of make_scene: the named effects, each amount varied by up to 20 % by the seed."""
        random = np.random.default_rng([self.seed, *self.name.encode(), *self.pattern.encode()])
        named = dict((LAND | BOXES.get(self.pattern, SCENES))[self.name])
        named.pop("fish", None)
        water, amount = named.pop("water", NO_WATER), named.pop("amount", 1.0)
        vary = {key: value * random.uniform(0.8, 1.2) for key, value in named.items()}
        if water is SKY:
            return vary | {"water": water}
        if "lamp" in vary:
            vary["lamp"] = min(vary["lamp"], 1.0)
        factors = {"beta_D": amount * random.uniform(0.8, 1.2, 3), "beta_B": amount * random.uniform(0.8, 1.2, 3)}
        factors["B_inf"] = random.uniform(0.8, 1.2, 3)
        scaled = {key: tuple((np.array(value) * factors[key]).tolist()) for key, value in water.items()}
        return vary | {"water": scaled}


REEF_SEEDS = {"tuning": (0, 1, 2), "final": (7,)}
"""Seeds of the scenes of a set."""
LAND_SEEDS = tuple(range(55, 60))
"""Seeds of the set "land"."""


def cases(title: str) -> list[Case]:
    """List the scenes of a set: tuning, final or land."""
    from tests.scenes.effect_scenes import PATTERNS

    if title == "land":
        return [Case(name, pattern, seed) for seed in LAND_SEEDS for pattern in BOXES for name in LAND]
    return [
        Case(name, pattern, seed)
        for seed in REEF_SEEDS[title]
        for pattern in (*PATTERNS, *BOXES)
        for name in BOXES.get(pattern, SCENES)
    ]


# One scene ------------------------------------------------------------------------------------------------------------


def made(case: Case, clean: Path):
    """Generate the scene unless its folder exists; return its settings, render passes and truth."""
    from tests.scenes.effect_scenes import rendered, settings_for
    from tests.scenes.make_scene import Water, make_scene

    passes = rendered(clean, case.pattern, case.seed, fish="fish" in case.name)
    wanted = case.effects()
    settings = settings_for(
        clean / "scenes" / f"{case.name.replace(', ', '-').replace(' ', '_')}-{case.pattern}-{case.seed}",
        seed=case.seed,
        water=Water(**wanted["water"]),
        **{key: value for key, value in wanted.items() if key != "water"},
    )
    path = settings.out / "truth.json"
    truth = json.loads(path.read_text()) if path.exists() else make_scene(settings, passes)
    shutil.rmtree(settings.out / "masks", ignore_errors=True)  # the plan must not get the masks of the fish
    return settings, passes, truth


def decide_effects(folder: Path) -> tuple:
    """Return the plan's decisions by effect, the fit, seconds and the number of observations of a scene folder."""
    from swag_engine.evidence.observations import FIT_WIDTH
    from swag_engine.evidence.scene_evidence import SceneEvidence
    from swag_engine.planning.plan import decide_all
    from swag_engine.scene.colmap import load_scene
    from swag_engine.scene.images import load_images

    scene = load_scene(folder)
    images = load_images(scene, scene.views, FIT_WIDTH)
    started = time.perf_counter()
    evidence = SceneEvidence(scene, images)
    decisions, terms = decide_all(evidence), evidence.water_terms
    return decisions, terms and terms.fit, time.perf_counter() - started, len(evidence.observations)


def run_case(case: Case, clean: Path) -> dict:
    """Generate a scene, decide its effects, and return truth and decisions side by side."""
    settings, passes, truth = made(case, clean)
    os.environ["SWAG_CACHE_DIR"] = str(clean / "cache")
    effects, fit, seconds, observations = decide_effects(settings.out)
    sizes = effect_sizes(passes, settings, truth)
    row: dict = {
        "scene": case.name,
        "pattern": case.pattern,
        "seed": case.seed,
        "seconds": round(seconds, 2),
        "observations": observations,
        "truth": case.effects(),
        "sizes": {name: round(size, 2) for name, size in sizes.items()},
        "states": {name: effects[name].state for name in EFFECTS},
        "evidence": {name: effects[name].evidence for name in (*EFFECTS, "separate_backscatter")},
    }
    row["reasons"] = {name: effects[name].reason for name in EFFECTS}
    if fit is not None:
        row["fit"] = {name: getattr(fit, name).tolist() for name in ("beta_D", "beta_B", "B")}
        row["fit"]["tau"], row["fit"]["lens"] = fit.tau, fit.lens.tolist()
    if fit is not None and effects["attenuation"].state == "on":
        row["delta_e"] = color_errors(passes, settings, fit)
    return row


def color_errors(passes, settings, fit) -> dict[str, float]:
    """Measure the median delta E (CIE 1976) to the clean colors, as photographed and with the fitted water removed.

    Both are first scaled to the clean colors' median, because absolute brightness is unknown in a photograph.
    """
    from tests.scenes.make_scene import srgb

    def lab(light: np.ndarray) -> np.ndarray:
        return cv2.cvtColor(srgb(light.clip(0, 1)).astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0]

    seen, clean, restored = [], [], []
    for view in passes.still[::4]:
        z = view.range[::5, ::5]
        solid = np.isfinite(z) & (view.alpha[::5, ::5] > 0.99)
        J, r = view.color[::5, ::5][solid].astype(np.float64), z[solid].astype(np.float64)[:, None]
        light = J * np.exp(-np.array(settings.water.beta_D) * r)
        light = light + np.array(settings.water.B_inf) * -np.expm1(-np.array(settings.water.beta_B) * r)
        clean.append(J)
        seen.append(light)
        restored.append((light + fit.B * np.expm1(-fit.beta_B * r)).clip(0) * np.exp(fit.beta_D * r))
    J = np.concatenate(clean)
    errors = {}
    for name, parts in (("seen", seen), ("restored", restored)):
        light = np.concatenate(parts)
        light = light * np.median(J) / max(float(np.median(light)), 1e-9)
        errors[name] = round(float(np.median(np.linalg.norm(lab(light) - lab(J), axis=1))), 2)
    return errors


def effect_sizes(passes, settings, truth: dict) -> dict[str, float]:
    """Measure how much each effect changes the pixels (8-bit display values, 95th percentile).

    Each is compared with the effect held at its value at the median range, vignetting with that at the image centre: a
    change that is constant over range and images cannot be distinguished from the scene itself. Exposure is everything
    that scales one image as a whole: gain, the gain of a phone's white balance, and the mean of the caustics over it.
    """
    from tests.scenes.make_scene import (
        caustic_pattern,
        focal_length,
        lamp_light,
        squared_radius,
        srgb,
        world_points,
    )

    water, reference = settings.water, truth["range"]["median"]
    gains = list(truth["exposure"]["gains"].values())
    falloff = settings.vignetting if settings.vignetting >= LEAST_FALLOFF else 0.0
    differences: dict[str, list[np.ndarray]] = {name: [] for name in EFFECTS}
    for k, (view, pose) in list(enumerate(zip(passes.still, passes.poses, strict=True)))[::4]:
        z = view.range[::5, ::5]
        solid = np.isfinite(z) & (view.alpha[::5, ::5] > 0.99)
        J, r = view.color[::5, ::5][solid].astype(np.float64), z[solid].astype(np.float64)
        waves = np.ones_like(r)
        if settings.caustics:
            pattern = caustic_pattern(
                world_points(view.range, focal_length(settings) * settings.supersample, pose),
                np.random.default_rng((settings.seed, 3, k)),
            )
            waves = 1 + settings.caustics * (view.sun_share * (pattern - 1))[::5, ::5][solid]
        balance = np.random.default_rng((settings.seed, 5, k)).normal(0, 0.03 * settings.phone, 3)  # process_as_phone
        lamp = lamp_light(r, settings.lamp, settings.lamp_tau, reference)
        parts = {
            "attenuation": np.exp(-np.array(water.beta_D) * r[:, None]),
            "backscatter": np.array(water.B_inf) * (1 - np.exp(-np.array(water.beta_B) * r[:, None])),
            "lamp": lamp[:, None],
            "exposure": np.full((1, 1), gains[k] * waves.mean() * np.exp(balance.mean())),
            "vignetting": 1 - falloff * squared_radius(view.range.shape)[::5, ::5][solid][:, None],
            "caustics": waves[:, None] / waves.mean(),
        }
        usual = {
            "attenuation": np.exp(-np.array(water.beta_D) * reference),
            "backscatter": np.array(water.B_inf) * (1 - np.exp(-np.array(water.beta_B) * reference)),
            "lamp": np.ones(1),
            "exposure": np.ones(1),
            "vignetting": np.ones(1),
            "caustics": np.ones(1),
        }

        def shown(parts: dict, J: np.ndarray = J) -> np.ndarray:
            direct = J * parts["lamp"] * parts["caustics"] * parts["attenuation"]
            return srgb(parts["exposure"] * parts["vignetting"] * (direct + parts["backscatter"])).clip(0, 1) * 255

        whole = shown(parts)
        for name in EFFECTS:
            without = shown(parts | {name: usual[name]})
            differences[name].append(np.abs(whole - without).max(1))
    return {name: float(np.quantile(np.concatenate(values), 0.95)) for name, values in differences.items()}


# All of them ----------------------------------------------------------------------------------------------------------


def judge(row: dict, name: str) -> tuple[str, bool | None]:
    """Return the truth (present, slight or absent), and whether the decision is right; None where it is not counted."""
    state, size = row["states"][name], row["sizes"][name]
    if size < 0.05:
        return "absent", state != "on"
    if size <= SEEN:
        return "slight", None
    if (row["pattern"] in SURVEYS and name in OF_RANGE) or (name == "vignetting" and "lamp" in row["truth"]):
        return "present", state in ("unknown", "on")
    return "present", state == "on"


def summary(rows: list[dict]) -> dict:
    """Summarise a set: confusion matrix and fraction of right decisions per effect, errors of the coefficients."""
    matrix: dict = {}
    for name in EFFECTS:
        counts = {truth: dict.fromkeys(STATES, 0) for truth in ("present", "slight", "absent", "present_in_surveys")}
        right = []
        for row in rows:
            truth, correct = judge(row, name)
            counts[truth][row["states"][name]] += 1
            if truth == "present" and row["pattern"] in SURVEYS:
                counts["present_in_surveys"][row["states"][name]] += 1
            if correct is not None:
                right.append(correct)
        matrix[name] = counts | {"right": float(np.mean(right)), "counted": len(right)}
    errors: dict[str, list[float]] = {"beta_D": [], "beta_B": [], "B": []}
    for row in rows:
        true = row["truth"]["water"]
        if row["states"]["attenuation"] == "on" and true["beta_D"][0] > 0:
            strongest = int(np.argmax(true["beta_D"]))
            errors["beta_D"].append(abs(row["fit"]["beta_D"][strongest] / true["beta_D"][strongest] - 1))
        if row["states"]["backscatter"] == "on" and max(true["B_inf"]) * max(true["beta_B"]) > 0:
            brightest = int(np.argmax(true["B_inf"]))
            for key, named in (("B", "B_inf"), ("beta_B", "beta_B")):
                errors[key].append(abs(row["fit"][key][brightest] / true[named][brightest] - 1))
    colors = [row["delta_e"] for row in rows if "delta_e" in row and max(row["truth"]["water"]["beta_D"]) > 0]
    air = [row for row in rows if max(row["truth"]["water"]["beta_D"]) == 0]
    survey = [row["states"]["attenuation"] for row in rows if row["pattern"] == "survey"]
    false = {name: sum(r["states"][name] == "on" and r["sizes"][name] < 0.05 for r in air) for name in EFFECTS}
    return {
        "scenes": len(rows),
        "confusion": matrix,
        "right": float(np.mean([c for row in rows for name in EFFECTS if (c := judge(row, name)[1]) is not None])),
        "wrong": [
            {"scene": row["scene"], "pattern": row["pattern"], "effect": name, "state": row["states"][name]}
            for row in rows
            for name in EFFECTS
            if judge(row, name)[1] is False
        ],
        "relative_error": {
            name: {"median": float(np.median(values)), "p90": float(np.quantile(values, 0.9)), "scenes": len(values)}
            for name, values in errors.items()
            if values
        },
        "delta_e": {name: float(np.median([pair[name] for pair in colors])) for name in ("seen", "restored") if colors},
        "in_air": {"scenes": len(air), "falsely_on": false},
        "flat_survey": {state: survey.count(state) for state in STATES},
        "seconds": float(np.median([row["seconds"] for row in rows])),
    }


def show(title: str, result: dict) -> None:
    """Print the summary of a set."""
    print(f"\n{title}: {result['scenes']} scenes, {result['right']:.1%} of the decisions right")
    print("| effect | visible: on / off / undetermined | slight | absent: on / off / undetermined | right |")
    print("|---|---|---|---|---|")
    for name, counts in result["confusion"].items():
        cells = [" / ".join(str(counts[truth][s]) for s in STATES) for truth in ("present", "slight", "absent")]
        print(f"| {name} | {cells[0]} | {cells[1]} | {cells[2]} | {counts['right']:.0%} of {counts['counted']} |")
    for name in ("relative_error", "delta_e", "in_air", "flat_survey", "seconds"):
        print(f"{name}: {json.dumps(result[name])}")


def draw(results: dict[str, dict]) -> None:
    """Draw the confusion matrices to a WebP file, one row per set of scenes."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(len(results), len(EFFECTS), figsize=(13, 2.9 * len(results)), squeeze=False)
    for row, (title, result) in zip(axes, results.items(), strict=True):
        for axis, name in zip(row, EFFECTS, strict=True):
            counts = result["confusion"][name]
            table = np.array([[counts[t][s] for s in STATES] for t in ("present", "slight", "absent")])
            axis.imshow(table / np.maximum(table.sum(1, keepdims=True), 1), cmap="Blues", vmin=0, vmax=1.4)
            for y, x in np.ndindex(3, 3):
                axis.text(x, y, table[y, x], ha="center", va="center", fontsize=12)
            axis.set_xticks(range(3), ("on", "off", "undeter-\nmined"))
            axis.set_yticks(range(3), ("visible", "slight", "absent"))
            axis.set_title(f"{name} ({title})\n{counts['right']:.0%} right", fontsize=9)
    figure.tight_layout()
    save_chart("effects_matrix", figure, dpi=72)


def main() -> None:
    """Run the sets of scenes that the command line asks for and write their summaries."""
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clean", type=Path, default=Path(tempfile.gettempdir()) / "swag_effects_clean")
    parser.add_argument("--only", choices=("tuning", "final", "land"))
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    titles = [asked.only] if asked.only else ["tuning", "final", "land"]
    seeds = [str(seed) for title in titles for seed in REEF_SEEDS.get(title, ())]
    generator = ROOT / "tests" / "scenes" / "effect_scenes.py"
    subprocess.run([sys.executable, str(generator), str(asked.clean), *seeds], check=True, stdout=subprocess.DEVNULL)
    path = RESULTS / "effects_matrix.json"
    document = json.loads(path.read_text()) if path.exists() else {"sets": {}}
    for title in titles:
        work = cases(title)
        with ProcessPoolExecutor(asked.workers) as pool:
            rows = list(pool.map(run_case, work, [asked.clean] * len(work)))
        document["sets"][title] = {"seeds": sorted({row["seed"] for row in rows}), "summary": summary(rows)}
        show(title, document["sets"][title]["summary"])
    write_results("effects_matrix", document)
    draw({title: made["summary"] for title, made in document["sets"].items()})


if __name__ == "__main__":
    main()
