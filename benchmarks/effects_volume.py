"""Measure the plan's decisions and coefficients in scattering water, rendered by Cycles as a volume.

Run: `python benchmarks/effects_volume.py [--clean FOLDER] [--workers N] [--seeds 0 ...]`
Results: benchmarks/results/effects_volume.json

The reef and the wreck stand in a medium that absorbs and scatters, below a surface lit by the sun: light fades on its
way down as well as on its way to the camera and is scattered several times, so that nothing follows the image formation
model of docs/method.md section 1 exactly. The true attenuation lies between absorption alone (all scattered light still
arrives) and absorption + scattering, the beam attenuation (none does).

Beside the colors that the fit restores it gives those of a trained run and of photos that it restores, and those of the
best gain and of the best laws of range, chosen with the truth at hand: no fit to the photos can do better with such a
law.
"""

import multiprocessing
import os
import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.optimize import minimize
from torch.nn.functional import softplus

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import write_results
from benchmarks.effects_matrix import EFFECTS, decide_effects
from swag_engine.base.transfer import srgb_to_linear
from swag_engine.evaluation.metrics import render_image
from swag_engine.evidence.noise import estimate_noise
from swag_engine.experiments.evaluate_run import load_run
from swag_engine.formats.run_folder import RunFolder
from swag_engine.rendering.model import SceneModel
from swag_engine.rendering.restored_photo import restored_photo
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import TrainingImage, load_images
from swag_engine.settings.settings import TrainSettings
from swag_engine.training.trainer import train

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
XYZ_OF_RGB = ((0.412453, 0.357580, 0.180423), (0.212671, 0.715160, 0.072169), (0.019334, 0.119193, 0.950227))
"""CIE XYZ of linear sRGB (IEC 61966-2-1)."""
D65 = (0.950456, 1.0, 1.088754)
"""CIE XYZ of white."""
PIXELS = 5_000
"""Pixels that the best gain and the best laws are found from."""
LAWS = ("exponential", "two exponentials", "any law")
"""Laws of range that are compared: e^(-beta r); a local coefficient that falls from one value to another; and any that
takes more light and adds more light with range, linear between PIECES + 1 quantiles of range."""
PIECES = 8
STEPS = 700
"""Steps of Adam in which a law is found; with half as many delta E is up to 0.2 larger."""
SETTINGS = TrainSettings(iterations=1000, width=320, max_gaussians=20_000, backend="cpu")
"""Of the trained runs."""
THERE = {effect: effect in ("attenuation", "backscatter") for effect in EFFECTS}


def run_case(name: str, pattern: str, seed: int, clean: Path) -> dict:
    """Render the scene unless it exists, decide its effects, and return truth and decisions side by side.

    Other seeds than 0 have another reef and wreck, and coefficients that differ by up to 20 %.
    """
    from tests.scenes.effect_scenes import camera_poses, settings_for
    from tests.scenes.make_scene import Rendered, focal_length, make_scene
    from tests.scenes.reef_model import Model, Renderer

    settings = settings_for(clean / "volume" / f"{name}-{pattern}-{seed}", seed=seed, volume=True, truth="all")
    water = WATERS[name] | COMMON
    random = np.random.default_rng([seed, *name.encode(), *pattern.encode()])
    for part in ("absorption", "scattering") if seed else ():
        water[part] = tuple((np.array(water[part]) * random.uniform(0.8, 1.2, 3)).tolist())
    kept = settings.out / "light.npz"
    if not kept.exists():
        factor, poses = settings.supersample, camera_poses(pattern)
        width, height, focal = (n * factor for n in (settings.width, settings.height, focal_length(settings)))
        renderer = Renderer(Model(settings.seed), width, height, focal, settings.samples)
        still = [renderer.still(pose) for pose in poses]
        volume = renderer.volume(poses, factor, 5 * settings.samples, **water)
        make_scene(settings, Rendered(poses, still, still, volume))
        half = [(view.color[::factor, ::factor], view.range[::factor, ::factor]) for view in still]
        np.savez(kept, clean=np.stack([c for c, _ in half]), range=np.stack([r for _, r in half]))
    os.environ["SWAG_CACHE_DIR"] = str(clean / "cache")
    effects, fit, seconds, observations = decide_effects(settings.out)
    row: dict = {
        "scene": name,
        "pattern": pattern,
        "seed": seed,
        "seconds": round(seconds, 2),
        "observations": observations,
        "truth": water,
    }
    row["states"] = {effect: effects[effect].state for effect in EFFECTS}
    if fit is not None and row["states"]["attenuation"] == "on":
        row["fit"] = {part: getattr(fit, part).tolist() for part in ("beta_D", "beta_B", "B")}
        with np.load(kept) as arrays:
            clean_light, ranges = arrays["clean"], arrays["range"]
        photos = photos_of(settings.out, ranges.shape[2])
        seen = srgb_to_linear(np.stack([photo.pixels for photo in photos]) / 255)
        row["delta_e"] = color_errors(clean_light, ranges, seen, fit) | least_errors(clean_light, ranges, seen)
        row["delta_e"] |= trained_errors(settings.out, photos, clean_light, ranges)
    return row


def photos_of(scene_folder: Path, width: int) -> list[TrainingImage]:
    """Read all photos of a scene, sorted by name: JPEG files, which is what all methods get."""
    scene = load_scene(scene_folder)
    return load_images(scene, sorted(scene.views, key=lambda view: view.name), width)


def trained_errors(
    scene_folder: Path, photos: list[TrainingImage], clean: np.ndarray, ranges: np.ndarray
) -> dict[str, float]:
    """Train a scene and measure its result.ply and its restored photos in all views, as `color_errors`."""
    out = scene_folder.with_name(f"{scene_folder.name}-run")
    if not RunFolder(out).finished():
        train(scene_folder, out, SETTINGS, resume=out.exists())
    run = load_run(out)
    model, solid, scene = SceneModel(run.trained, run.effects), np.isfinite(ranges), load_scene(scene_folder)
    images = [
        render_image(run.cloud, photo.camera, SETTINGS.sh_degree, effects=run.effects, amount=0) for photo in photos
    ]
    restored = [
        restored_photo(model, run.limit, photo, estimate_noise([photo], scene.views), SETTINGS.sh_degree)
        for photo in photos
    ]
    lights = {"trained": srgb_to_linear(np.stack([image.numpy() for image in images])), "photo": np.stack(restored)}
    return {name: color_error(clean[solid], light[solid]) for name, light in lights.items()}


def color_errors(clean: np.ndarray, ranges: np.ndarray, seen: np.ndarray, fit: object) -> dict[str, float]:
    """Measure the error of colors (V, H, W, 3), as seen and as restored by the fit; see `color_error`."""
    solid = np.isfinite(ranges)
    r, light = (values[solid].astype(np.float64) for values in (ranges[..., None], seen))
    restored = (light + fit.B * np.expm1(-fit.beta_B * r)).clip(0) * np.exp(fit.beta_D * r)  # type: ignore[attr-defined]
    return {name: color_error(clean[solid], found) for name, found in (("seen", light), ("restored", restored))}


def color_error(clean: np.ndarray, light: np.ndarray) -> float:
    """Measure the median delta E (CIE 1976) of light (N, 3) to the clean light (N, 3), both linear.

    Each channel is scaled to the clean one's median, because light lost between surface and scene is not part of the
    water between scene and camera.
    """
    from tests.scenes.make_scene import srgb

    J = clean.astype(np.float64)
    scaled = light * np.median(J, 0) / np.maximum(np.median(light, 0), 1e-9)
    first, second = (
        cv2.cvtColor(srgb(values.clip(0, 1)).astype(np.float32)[None], cv2.COLOR_RGB2LAB)[0] for values in (scaled, J)
    )
    return round(float(np.median(np.linalg.norm(first - second, axis=1))), 2)


def least_errors(clean: np.ndarray, ranges: np.ndarray, seen: np.ndarray) -> dict[str, float]:
    """Measure the median delta E of the best gain of each channel and of the best laws of range, found with the truth.

    Args:
        clean: (V, H, W, 3) linear light without water.
        ranges: (V, H, W) metres, infinite where nothing is.
        seen: (V, H, W, 3) linear light through the water.

    Returns:
        Delta E by "best gain" and the names of LAWS.
    """
    solid = np.flatnonzero(np.isfinite(ranges))
    solid = np.random.default_rng(0).permutation(solid)[:PIXELS]
    J, light = (torch.from_numpy(values.reshape(-1, 3)[solid]).float() for values in (clean, seen))
    r = torch.from_numpy(ranges.reshape(-1)[solid]).float()
    truth, medians = lab_of_light(J), (J.median(0).values / light.median(0).values).log()

    def errors(restored: torch.Tensor) -> torch.Tensor:
        return (lab_of_light(restored) - truth).square().sum(1).add(1e-2).sqrt()

    simplex = medians.numpy() + 0.3 * np.vstack([np.zeros(3), np.eye(3)])
    best = minimize(
        lambda gains: float(errors(light * torch.tensor(gains).float().exp()).median()),
        simplex[0],
        method="Nelder-Mead",
        options={"initial_simplex": simplex},
    )
    found = {"best gain": round(float(best.fun), 2)}
    for law in LAWS:
        found[law] = round(float(errors(restored_by_best(law, light, r, medians, errors)).median()), 2)
    return found


def restored_by_best(
    law: str, light: torch.Tensor, r: torch.Tensor, gains: torch.Tensor, errors: Callable[[torch.Tensor], torch.Tensor]
) -> torch.Tensor:
    """Restore light (N, 3) at ranges (N,) by the values of a law of LAWS that give the least mean of `errors`.

    `gains` are initial values of the log gains (3,).
    """
    z = (r / r.median())[:, None]
    edges = torch.quantile(z, torch.linspace(0, 1, PIECES + 1))
    pieces = [((z - low) / (high - low)).clamp(0, 1) for low, high in zip(edges[:-1], edges[1:], strict=True)]
    dark = (2 * light.quantile(0.02, 0)).log()
    rows = PIECES if law == "any law" else 1
    values = {
        "gains": gains.clone(),
        "depth": torch.full((rows, 3), -1.0 if rows == 1 else -2.0),  # optical depth, softplus
        "far": torch.zeros(3),  # coefficient at the far end over that at the near end, sigmoid
        "fall": torch.zeros(1),  # how fast it falls, log
        "backscatter": torch.full((3,), -2.0),  # of the backscatter, softplus
        "added": (dark if rows == 1 else dark - np.log(rows)).repeat(rows, 1),  # background light, log
    }
    for value in values.values():
        value.requires_grad_()

    def restored() -> torch.Tensor:
        depths, added = softplus(values["depth"]), values["added"].exp()
        if law == "any law":
            depth, scattered = (sum(p * x for p, x in zip(pieces, of, strict=True)) for of in (depths, added))
        else:
            length, far, fall = z, values["far"].sigmoid(), values["fall"].exp()
            if law == "two exponentials":
                length = far * z - (1 - far) * torch.expm1(-fall * z) / fall
            depth, scattered = depths[0] * length, -added[0] * torch.expm1(-softplus(values["backscatter"]) * z)
        return (light - scattered) * torch.exp(depth + values["gains"])

    adam = torch.optim.Adam(values.values(), lr=0.05)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, STEPS)
    for _ in range(STEPS):
        adam.zero_grad()
        tried = restored()
        # Colors that are cut off at black or white would have no gradient.
        (errors(tried).mean() + (tried - 1).clamp(min=0).mean() + 10 * (-tried).clamp(min=0).mean()).backward()
        adam.step()
        schedule.step()
    return restored().detach()


def lab_of_light(light: torch.Tensor) -> torch.Tensor:
    """Convert linear light (N, 3) to CIE L*a*b* with white point D65; differentiable."""
    xyz = light.clamp(1e-6, 1) @ torch.tensor(XYZ_OF_RGB).T / torch.tensor(D65)
    t = torch.where(xyz > 0.008856, xyz.clamp(min=1e-6) ** (1 / 3), 7.787 * xyz + 16 / 116)
    return torch.stack([116 * t[:, 1] - 16, 500 * (t[:, 0] - t[:, 1]), 200 * (t[:, 1] - t[:, 2])], 1)


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
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    asked = parser.parse_args()
    work = [(name, pattern, seed, asked.clean) for seed in asked.seeds for name, pattern in CASES]
    # A process for each: rendering a volume changes the lights and the film of its Blender.
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(asked.workers, mp_context=fresh, max_tasks_per_child=1) as pool:
        rows = list(pool.map(run_case, *zip(*work, strict=True)))
    decisions = [right(row, effect) for row in rows for effect in EFFECTS]
    print(f"{len(rows)} scenes, {np.mean(decisions):.1%} of {len(decisions)} decisions right")
    columns = ("water", "cameras", *EFFECTS, "beta_D", "absorption", "beam", "delta E")
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for row in rows:
        absorbed, scattered = (np.array(row["truth"][name]) for name in ("absorption", "scattering"))
        found, error = "-", "-"
        if "fit" in row:
            found = " ".join(f"{x:.3f}" for x in row["fit"]["beta_D"])
            error = " ".join(f"{name} {value}" for name, value in row["delta_e"].items())
        ends = [" ".join(f"{x:.3f}" for x in value) for value in (absorbed, absorbed + scattered)]
        print(f"| {' | '.join((row['scene'], row['pattern'], *row['states'].values(), found, *ends, error))} |")
    result = {"right": float(np.mean(decisions)), "decisions": len(decisions), "rows": rows}
    write_results("effects_volume", result)


if __name__ == "__main__":
    main()
