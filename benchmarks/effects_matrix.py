"""Whether the plan finds the effects that generated scenes have, and none that they have not.

    python benchmarks/effects_matrix.py [--clean FOLDER] [--only tuning|final|land]

The reef and the wreck are rendered without water by Cycles along three camera patterns, and a street, a room and flat
ground are ray-cast; what each scene adds is drawn by its own seed. Thresholds were chosen on scenes of seeds 0 to 4,
three of which are "tuning"; those of seed 7 ("final") and five more seeds of what is photographed in air ("land") are
for the run after they were frozen. Writes benchmarks/results/effects_matrix.json and .png.
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

EFFECTS = ("attenuation", "backscatter", "lamp", "exposure", "caustics")
SEEN = 5.0
"""Display values of 255 by which an effect must change the brightest-changed twentieth of the pixels to count."""
NO_WATER = {"beta_D": (0.0, 0.0, 0.0), "beta_B": (0.0, 0.0, 0.0), "B_inf": (0.0, 0.0, 0.0)}
BLUE = {"beta_D": (0.17, 0.062, 0.042), "beta_B": (0.13, 0.08, 0.068), "B_inf": (0.03, 0.175, 0.255)}
GREEN = {"beta_D": (0.25, 0.10, 0.14), "beta_B": (0.20, 0.12, 0.13), "B_inf": (0.05, 0.20, 0.12)}
SCENES: dict[str, dict] = {
    "clear": {},
    "clear, exposure": {"exposure": 0.12},
    "clear, caustics": {"caustics": 0.8},
    "clear, lens": {"vignetting": 0.35},
    "clear, lamp": {"lamp": 1.0},
    "blue": {"water": BLUE},
    "blue, weak": {"water": BLUE, "amount": 0.35},
    "green": {"water": GREEN},
    "attenuation only": {"water": BLUE | {"B_inf": (0.0, 0.0, 0.0)}},
    "blue, lamp": {"water": BLUE, "lamp": 1.0},
    "green, lamp, exposure": {"water": GREEN, "lamp": 0.8, "exposure": 0.08},
    "green, weak, caustics, exposure": {"water": GREEN, "amount": 0.4, "caustics": 0.5, "exposure": 0.06},
    "blue, lens": {"water": BLUE, "vignetting": 0.35},
    "green, fish": {"water": GREEN, "fish": True},
}
SKY = NO_WATER | {"B_inf": (0.35, 0.55, 0.95)}
"""Behind what is photographed in air: no light that is lost or added on the way to it."""
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
"""Scenes of the places of boxes, by pattern. From a constant height over flat ground range and place in the picture go
together, so that water, lamp and lens cannot be told apart."""
CANNOT_TELL = ("nadir", "survey")


@dataclass(frozen=True)
class Case:
    """One scene: its name in SCENES, the camera pattern, and the seed of model and amounts."""

    name: str
    pattern: str
    seed: int

    def effects(self) -> dict:
        """What make_scene is given: the named effects with amounts that differ by up to a fifth from scene to scene."""
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
"""Of the models that Cycles renders, by set of scenes."""
LAND_SEEDS = tuple(range(55, 60))


def cases(title: str) -> list[Case]:
    """The scenes of a set: tuning, final or land."""
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
    """The scene's folder, made where it is not there yet: settings, passes and truth."""
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
    shutil.rmtree(settings.out / "masks", ignore_errors=True)  # nobody tells the plan where the fish are
    return settings, passes, truth


def looked_at(folder: Path) -> tuple:
    """What a plan finds in the scene in this folder: the effects by name, the fit, seconds, number of sightings."""
    from swag_engine.evidence.observations import FIT_WIDTH, observe
    from swag_engine.planning import evidence
    from swag_engine.scene.colmap import load_scene
    from swag_engine.scene.images import load_images

    scene = load_scene(folder)
    images = load_images(scene, scene.views, FIT_WIDTH)
    started = time.perf_counter()
    observations = observe(images, [view.point_indices for view in scene.views], scene.points)
    centres = np.stack([image.camera.centre for image in images])
    caustics = evidence.caustics_finding(observations, centres, scene.points.positions)
    found = evidence.water_findings(observations, evidence.open_water_light(images, scene))
    return found.effects | {"caustics": caustics}, found.fit, time.perf_counter() - started, len(observations)


def run_case(case: Case, clean: Path) -> dict:
    """Make the scene, look at it as a plan does, and put truth and findings side by side."""
    settings, passes, truth = made(case, clean)
    os.environ["SWAG_CACHE_DIR"] = str(clean / "cache")
    effects, fit, seconds, sightings = looked_at(settings.out)
    sizes = effect_sizes(passes, settings, truth)
    row: dict = {
        "scene": case.name,
        "pattern": case.pattern,
        "seed": case.seed,
        "seconds": round(seconds, 2),
        "sightings": sightings,
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
    """Median delta E (CIE 1976) between the clean colours and those seen through the water, as they are and with the
    fitted water taken away; both of the brightness of the clean ones, for no photograph shows absolute light.
    """
    from tests.scenes.make_scene import srgb

    def lab(light: np.ndarray) -> np.ndarray:
        return cv2.cvtColor(srgb(light.clip(0, 1)).astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0]

    seen, clean, restored = [], [], []
    for view in passes.still[::4]:
        z = view.range[::5, ::5]
        solid = np.isfinite(z) & (view.alpha[::5, ::5] > 0.99)
        J, r = view.colour[::5, ::5][solid].astype(np.float64), z[solid].astype(np.float64)[:, None]
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
    """By how much of 255 each effect changes the pixels (95th percentile), against the same with the effect at its
    mean: what is constant over range and photographs could be the place itself. Exposure is all that a photograph has
    for itself as a whole: gain, that of a telephone's white balance, and the waves' mean light on what it shows.
    """
    from tests.scenes.make_scene import caustic_pattern, focal_length, lamp_light, srgb, world_points

    water, reference = settings.water, truth["range"]["median"]
    gains = list(truth["exposure"]["gains"].values())
    differences: dict[str, list[np.ndarray]] = {name: [] for name in EFFECTS}
    for k, (view, pose) in list(enumerate(zip(passes.still, passes.poses, strict=True)))[::4]:
        z = view.range[::5, ::5]
        solid = np.isfinite(z) & (view.alpha[::5, ::5] > 0.99)
        J, r = view.colour[::5, ::5][solid].astype(np.float64), z[solid].astype(np.float64)
        waves = np.ones_like(r)
        if settings.caustics:
            pattern = caustic_pattern(
                world_points(view.range, focal_length(settings) * settings.supersample, pose),
                np.random.default_rng((settings.seed, 3, k)),
            )
            waves = 1 + settings.caustics * (view.sun_share * (pattern - 1))[::5, ::5][solid]
        balance = np.random.default_rng((settings.seed, 5, k)).normal(0, 0.03 * settings.phone, 3)  # as in `developed`
        lamp = lamp_light(r, settings.lamp, settings.lamp_tau, reference)
        parts = {
            "attenuation": np.exp(-np.array(water.beta_D) * r[:, None]),
            "backscatter": np.array(water.B_inf) * (1 - np.exp(-np.array(water.beta_B) * r[:, None])),
            "lamp": lamp[:, None],
            "exposure": np.full((1, 1), gains[k] * waves.mean() * np.exp(balance.mean())),
            "caustics": waves[:, None] / waves.mean(),
        }
        usual = {
            "attenuation": np.exp(-np.array(water.beta_D) * reference),
            "backscatter": np.array(water.B_inf) * (1 - np.exp(-np.array(water.beta_B) * reference)),
            "lamp": np.ones(1),
            "exposure": np.ones(1),
            "caustics": np.ones(1),
        }

        def shown(parts: dict, J: np.ndarray = J) -> np.ndarray:
            direct = J * parts["lamp"] * parts["caustics"] * parts["attenuation"]
            return srgb(parts["exposure"] * (direct + parts["backscatter"])).clip(0, 1) * 255

        whole = shown(parts)
        for name in EFFECTS:
            without = shown(parts | {name: usual[name]})
            differences[name].append(np.abs(whole - without).max(1))
    return {name: float(np.quantile(np.concatenate(values), 0.95)) for name, values in differences.items()}


# All of them ----------------------------------------------------------------------------------------------------------


def judged(row: dict, name: str) -> tuple[str, bool | None]:
    """What the truth is (present, slight, absent), and whether the decision is right; None where it does not count."""
    state, size = row["states"][name], row["sizes"][name]
    if size < 0.05:
        return "absent", state != "on"
    if size <= SEEN:
        return "slight", None
    if row["pattern"] in CANNOT_TELL and name in ("attenuation", "backscatter", "lamp"):
        return "present", state in ("unknown", "on")
    return "present", state == "on"


def summary(rows: list[dict]) -> dict:
    """Confusion matrix and share of right decisions per effect; errors of the coefficients where water was found."""
    matrix: dict = {}
    for name in EFFECTS:
        counts = {truth: {"on": 0, "off": 0, "unknown": 0} for truth in ("present", "slight", "absent")}
        right = []
        for row in rows:
            truth, correct = judged(row, name)
            counts[truth][row["states"][name]] += 1
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
    told = [row["states"]["attenuation"] for row in rows if row["pattern"] == "survey"]
    false = {name: sum(r["states"][name] == "on" and r["sizes"][name] < 0.05 for r in air) for name in EFFECTS}
    return {
        "scenes": len(rows),
        "confusion": matrix,
        "right": float(np.mean([c for row in rows for name in EFFECTS if (c := judged(row, name)[1]) is not None])),
        "relative_error": {
            name: {"median": float(np.median(values)), "p90": float(np.quantile(values, 0.9)), "scenes": len(values)}
            for name, values in errors.items()
            if values
        },
        "delta_e": {name: float(np.median([pair[name] for pair in colors])) for name in ("seen", "restored") if colors},
        "in_air": {"scenes": len(air), "falsely_on": false},
        "flat_survey": {state: told.count(state) for state in ("on", "off", "unknown")},
        "seconds": float(np.median([row["seconds"] for row in rows])),
    }


def show(title: str, result: dict) -> None:
    print(f"\n{title}: {result['scenes']} scenes, {result['right']:.1%} of the decisions right")
    print("| effect | there: on / off / cannot tell | slight | not there: on / off / cannot tell | right |")
    print("|---|---|---|---|---|")
    for name, counts in result["confusion"].items():
        cells = [
            " / ".join(str(counts[truth][s]) for s in ("on", "off", "unknown"))
            for truth in ("present", "slight", "absent")
        ]
        print(f"| {name} | {cells[0]} | {cells[1]} | {cells[2]} | {counts['right']:.0%} of {counts['counted']} |")
    for name in ("relative_error", "delta_e", "in_air", "flat_survey", "seconds"):
        print(f"{name}: {json.dumps(result[name])}")


def draw(path: Path, results: dict[str, dict]) -> None:
    """The confusion matrices as pictures, one row a set of scenes."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(len(results), len(EFFECTS), figsize=(13, 2.9 * len(results)), squeeze=False)
    for row, (title, result) in zip(axes, results.items(), strict=True):
        for axis, name in zip(row, EFFECTS, strict=True):
            counts = result["confusion"][name]
            truths, states = ("present", "slight", "absent"), ("on", "off", "unknown")
            table = np.array([[counts[t][s] for s in states] for t in truths])
            axis.imshow(table / np.maximum(table.sum(1, keepdims=True), 1), cmap="Blues", vmin=0, vmax=1.4)
            for y, x in np.ndindex(3, 3):
                axis.text(x, y, table[y, x], ha="center", va="center", fontsize=12)
            axis.set_xticks(range(3), ("on", "off", "cannot\ntell"))
            axis.set_yticks(range(3), ("there", "slight", "not there"))
            axis.set_title(f"{name} ({title}): {counts['right']:.0%} right", fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clean", type=Path, default=Path(tempfile.gettempdir()) / "swag_effects_clean")
    parser.add_argument("--only", choices=("tuning", "final", "land"))
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    titles = [asked.only] if asked.only else ["tuning", "final", "land"]
    seeds = [str(seed) for title in titles for seed in REEF_SEEDS.get(title, ())]
    generator = ROOT / "tests" / "scenes" / "effect_scenes.py"
    subprocess.run([sys.executable, str(generator), str(asked.clean), *seeds], check=True, stdout=subprocess.DEVNULL)
    path = ROOT / "benchmarks" / "results" / "effects_matrix.json"
    document = json.loads(path.read_text()) if path.exists() else {"sets": {}}
    for title in titles:
        work = cases(title)
        with ProcessPoolExecutor(asked.workers) as pool:
            rows = list(pool.map(run_case, work, [asked.clean] * len(work)))
        document["sets"][title] = {"summary": summary(rows), "rows": rows}
        show(title, document["sets"][title]["summary"])
    from swag_engine.base.strict_json import to_json
    from swag_engine.planning import evidence

    document["thresholds"] = {
        name: value for name, value in vars(evidence).items() if name.isupper() and isinstance(value, int | float)
    }
    path.write_text(to_json(document, indent=1) + "\n")
    draw(path.with_suffix(".png"), {title: made["summary"] for title, made in document["sets"].items()})


if __name__ == "__main__":
    main()
