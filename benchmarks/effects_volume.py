"""Measure the plan's decisions and coefficients in scattering water, rendered by Cycles as a volume.

Run: `python benchmarks/effects_volume.py [--clean FOLDER] [--workers N]`
Results: benchmarks/results/effects_volume.json

The reef and the wreck stand in a medium that absorbs and scatters, below a surface lit by the sun: light fades on its
way down as well as on its way to the camera and is scattered several times, so that nothing follows the image formation
model of docs/method.md section 1 exactly. The true attenuation lies between absorption alone (all scattered light still
arrives) and absorption + scattering, the beam attenuation (none does).
"""

import multiprocessing
import os
import sys
import tempfile
from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import write_results
from benchmarks.effects_matrix import EFFECTS, decide_effects

COMMON = {"surface": 5.0, "light": 1.4}
WATERS: dict[str, dict] = {
    "clear": {"absorption": (0.12, 0.03, 0.015), "scattering": (0.015,) * 3, "anisotropy": 0.8},
    "blue": {"absorption": (0.17, 0.045, 0.025), "scattering": (0.05,) * 3, "anisotropy": 0.6},
    "green": {"absorption": (0.22, 0.07, 0.11), "scattering": (0.08,) * 3, "anisotropy": 0.8},
    "murky": {"absorption": (0.2, 0.06, 0.05), "scattering": (0.15,) * 3, "anisotropy": 0.7},
}
"""Coefficients per metre for red, green, blue; the phase function is Henyey-Greenstein with this anisotropy."""
CASES = (
    ("clear", "oblique"),
    ("blue", "orbit"),
    ("blue", "nadir"),
    ("green", "orbit"),
    ("green", "oblique"),
    ("murky", "orbit"),
)
THERE = {effect: effect in ("attenuation", "backscatter") for effect in EFFECTS}


def run_case(name: str, pattern: str, clean: Path) -> dict:
    """Render the scene unless it exists, decide its effects, and return truth and decisions side by side."""
    from tests.scenes.effect_scenes import camera_poses, settings_for
    from tests.scenes.make_scene import Rendered, focal_length, make_scene
    from tests.scenes.reef_model import Model, Renderer

    settings = settings_for(clean / "volume" / f"{name}-{pattern}", volume=True, truth="all")
    water = WATERS[name] | COMMON
    kept = settings.out / "light.npz"
    if not kept.exists():
        factor, poses = settings.supersample, camera_poses(pattern)
        width, height, focal = (n * factor for n in (settings.width, settings.height, focal_length(settings)))
        renderer = Renderer(Model(settings.seed), width, height, focal, settings.samples)
        still = [renderer.still(pose) for pose in poses]
        volume = renderer.volume(poses, factor, 5 * settings.samples, **water)
        make_scene(settings, Rendered(poses, still, still, volume))
        half = [(view.colour[::factor, ::factor], view.range[::factor, ::factor]) for view in still]
        np.savez(
            kept, clean=np.stack([c for c, _ in half]), range=np.stack([r for _, r in half]), seen=np.stack(volume)
        )
    os.environ["SWAG_CACHE_DIR"] = str(clean / "cache")
    effects, fit, seconds, sightings = decide_effects(settings.out)
    row: dict = {
        "scene": name,
        "pattern": pattern,
        "seconds": round(seconds, 2),
        "sightings": sightings,
        "truth": water,
    }
    row["states"] = {effect: effects[effect].state for effect in EFFECTS}
    row["reasons"] = {effect: effects[effect].reason for effect in EFFECTS}
    if fit is not None and row["states"]["attenuation"] == "on":
        row["fit"] = {part: getattr(fit, part).tolist() for part in ("beta_D", "beta_B", "B")}
        with np.load(kept) as arrays:
            row["delta_e"] = color_errors(arrays["clean"], arrays["range"], arrays["seen"], fit)
    return row


def color_errors(clean: np.ndarray, ranges: np.ndarray, seen: np.ndarray, fit: object) -> dict[str, float]:
    """Measure the median delta E (CIE 1976) to the clean colours (V, H, W, 3), as seen and as restored by the fit.

    Each channel is scaled to the clean one's median, because light lost between surface and scene is not part of the
    water between scene and camera.
    """
    from tests.scenes.make_scene import srgb

    solid = np.isfinite(ranges)
    J, r, light = (
        clean[solid].astype(np.float64),
        ranges[solid].astype(np.float64)[:, None],
        seen[solid].astype(np.float64),
    )
    restored = (light + fit.B * np.expm1(-fit.beta_B * r)).clip(0) * np.exp(fit.beta_D * r)  # type: ignore[attr-defined]

    def lab(values: np.ndarray) -> np.ndarray:
        values = values * np.median(J, 0) / np.maximum(np.median(values, 0), 1e-9)
        return cv2.cvtColor(srgb(values.clip(0, 1)).astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0]

    pairs = {"seen": light, "restored": restored}
    return {name: round(float(np.median(np.linalg.norm(lab(v) - lab(J), axis=1))), 2) for name, v in pairs.items()}


def right(row: dict, effect: str) -> bool:
    """Return whether a decision is right; in nadir surveys "undetermined" is right as well."""
    state = row["states"][effect]
    if THERE[effect]:
        return state == "on" or (row["pattern"] == "nadir" and state == "unknown")
    return state != "on"


def main() -> None:
    """Run every scene, print a table and write the results."""
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clean", type=Path, default=Path(tempfile.gettempdir()) / "swag_effects_clean")
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    # A process for each: rendering a volume changes the lights and the film of its Blender.
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(asked.workers, mp_context=fresh, max_tasks_per_child=1) as pool:
        rows = list(pool.map(run_case, *zip(*CASES, strict=True), [asked.clean] * len(CASES)))
    decisions = [right(row, effect) for row in rows for effect in EFFECTS]
    print(f"{len(rows)} scenes, {np.mean(decisions):.1%} of {len(decisions)} decisions right")
    columns = ("water", "cameras", *EFFECTS, "beta_D", "absorption", "beam", "delta E")
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for row in rows:
        absorbed, scattered = (np.array(row["truth"][name]) for name in ("absorption", "scattering"))
        found, error = "-", "-"
        if "fit" in row:
            found = " ".join(f"{x:.3f}" for x in row["fit"]["beta_D"])
            error = f"{row['delta_e']['seen']} -> {row['delta_e']['restored']}"
        ends = [" ".join(f"{x:.3f}" for x in value) for value in (absorbed, absorbed + scattered)]
        print(f"| {' | '.join((row['scene'], row['pattern'], *row['states'].values(), found, *ends, error))} |")
    result = {"right": float(np.mean(decisions)), "decisions": len(decisions), "rows": rows}
    write_results("effects_volume", result)


if __name__ == "__main__":
    main()
