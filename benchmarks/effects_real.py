"""Record the plan's decisions on the real scenes in ../shared, with a picture of each.

Run: `python benchmarks/effects_real.py`
Results: benchmarks/results/effects_real.json, docs/images/effects_NAME.webp

A picture shows an image, the same with the water and lamp that were found removed (ranges interpolated between the
sparse points), and linear light against range with the fitted curve. flsea_rgbd has single frames with metric depth,
so that no point is seen twice: there the quantiles of the light in bins of range replace the points.
"""

import sys
import textwrap
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from scipy.interpolate import griddata

from benchmarks.common import RESULTS, SHARED, save_figure
from swag_engine.base.strict_json import to_json
from swag_engine.evidence.fit import Family, Fit, WeightedObservations, lens_terms
from swag_engine.evidence.image_cells import open_water_light
from swag_engine.evidence.observations import FIT_WIDTH, Observations, observe
from swag_engine.evidence.water_terms import find_water_terms
from swag_engine.planning.plan import describe, make_plan
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.scene.split import split_views

SCENES = {
    "aqualoc_amphorae": "photographs",
    "sparus_seabed": "photographs",
    "japanese_gardens": "rendered by a NeRF",
}
QUANTILES, BINS = np.linspace(0.05, 0.95, 19), 16
COLORS = ("tab:red", "tab:green", "tab:blue")


def linear(display: np.ndarray) -> np.ndarray:
    """Convert sRGB display values to linear light."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def displayed(light: np.ndarray) -> np.ndarray:
    """Convert linear light to sRGB display values."""
    light = light.clip(0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def lamp_light(ranges: np.ndarray, fit: Fit, unit: float) -> np.ndarray:
    """Return the fitted lamp's light relative to that at range `unit`; ones where no lamp was fitted."""
    return (fit.tau + unit**2) / (fit.tau + ranges**2) if np.isfinite(fit.tau) else np.ones_like(ranges)


def restored(pixels: np.ndarray, ranges: np.ndarray, fit: Fit, unit: float, usual: float) -> np.ndarray:
    """Remove the fitted water and the lamp's fall-off; the brightness at the `usual` range is kept."""
    r = ranges[..., None]
    light = linear(pixels / 255.0) + fit.B * np.expm1(-fit.beta_B * r)
    J = light.clip(0) * np.exp(fit.beta_D * (r - usual)) / lamp_light(r, fit, unit)
    return displayed(J * np.quantile(linear(pixels / 255.0), 0.98) / max(np.quantile(J, 0.98), 1e-6))


def curve(axis, ranges: np.ndarray, light: np.ndarray, track: np.ndarray, fit: Fit, unit: float, title: str) -> None:
    """Plot light against range, every point shifted to the scene's median color so that all lie on one curve."""
    order = np.linspace(*np.quantile(ranges, (0.01, 0.99)), 100)
    for c in range(3):
        direct = np.exp(-fit.beta_D[c] * ranges) * lamp_light(ranges, fit, unit)
        backscattered = fit.B[c] * -np.expm1(-fit.beta_B[c] * ranges)
        J = np.bincount(track, direct * (light[:, c] - backscattered)) / np.bincount(track, direct**2)
        usual = np.median(J)
        shown = light[:, c] - direct * (J[track] - usual)
        some = np.random.default_rng(0).permutation(len(ranges))[:1500]
        axis.plot(ranges[some], shown[some], ".", color=COLORS[c], ms=1.5, alpha=0.35)
        at = usual * np.exp(-fit.beta_D[c] * order) * lamp_light(order, fit, unit)
        axis.plot(order, at - fit.B[c] * np.expm1(-fit.beta_B[c] * order), color=COLORS[c], lw=2)
    axis.set_xlabel("range")
    axis.set_ylabel("linear light, points at the median color")
    axis.set_ylim(0, None)
    axis.set_title(textwrap.fill(title, 72), fontsize=7, loc="left")


def picture(name: str, rows: list[tuple]) -> None:
    """Draw rows of (image, restored image, plot function, title) to docs/images/NAME.webp."""
    figure, axes = plt.subplots(len(rows), 3, figsize=(15, 3.6 * len(rows)), squeeze=False)
    for row, (photograph, clean, plot, title) in zip(axes, rows, strict=True):
        row[0].imshow(photograph)
        row[0].set_title(title, fontsize=9)
        row[1].imshow(clean)
        row[1].set_title("with water and lamp removed", fontsize=9)
        for axis in row[:2]:
            axis.axis("off")
        plot(row[2])
    figure.tight_layout()
    save_figure(name, figure, dpi=80)
    plt.close(figure)


def scene_with_points(name: str, kind: str) -> dict:
    """Plan a scene, draw its picture, and return the plan."""
    scene = load_scene(SHARED / name)
    held_out = set(split_views([view.name for view in scene.views]).test)
    views = [view for view in scene.views if view.name not in held_out]
    images = load_images(scene, views, FIT_WIDTH)
    plan = make_plan(scene, images)
    print(f"\n{name} ({kind})\n{describe(plan)}", flush=True)
    observations = observe(images, [view.point_indices for view in views], scene.points)
    found = find_water_terms(observations, open_water_light(images, scene))
    fit, unit = found.fit, float(np.median(observations.ranges))
    assert fit is not None
    index = {image: k for k, image in enumerate(found.images)}
    gains = np.exp(
        fit.log_gains[[index.get(k, 0) for k in observations.image]] + lens_terms(observations.place) @ fit.lens
    )
    _, track = np.unique(observations.track, return_inverse=True)
    image, view = images[len(images) // 2], views[len(views) // 2]
    places = scene.points.positions[view.point_indices] @ image.camera.world_to_camera[:3, :3].T
    places = places + image.camera.world_to_camera[:3, 3]
    pixel = (places @ image.camera.K.T)[:, :2] / places[:, 2:]
    y, x = np.mgrid[: image.camera.height, : image.camera.width]
    distance = np.linalg.norm(places, axis=1)
    dense = griddata(pixel, distance, (x, y), method="nearest")
    dense = cv2.GaussianBlur(dense.astype(np.float32), (0, 0), 6)
    clean = restored(image.pixels, dense, fit, unit, float(np.median(dense)))
    words = "; ".join(
        f"{title}: {', '.join(key.replace('_', ' ') for key, effect in plan.effects.items() if effect.state == state)}"
        for state, title in (("on", "on"), ("unknown", "undetermined"))
    )
    picture(
        f"effects_{name}",
        [
            (
                image.pixels,
                clean,
                lambda axis: curve(
                    axis, observations.ranges, observations.light / gains[:, None], track, fit, unit, words
                ),
                f"{name} ({kind}): {image.camera.name}",
            )
        ],
    )
    effects = {name: {"state": effect.state} for name, effect in plan.effects.items()}
    return {"kind": kind, "plan": plan.to_json() | {"effects": effects}}


def frames_with_depth() -> dict:
    """Fit the coefficients (per metre) of each frame of flsea_rgbd, draw them, and return them."""
    folder, rows, figures = SHARED / "flsea_rgbd", [], {}
    for path in sorted((folder / "images").iterdir()):
        pixels = cv2.imread(str(path))[..., ::-1]
        with np.load(next((folder / "depth").glob(f"{path.stem}*.npz"))) as arrays:
            depth = next(iter(arrays.values())).astype(np.float64)
        depth = cv2.resize(depth, pixels.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        known = depth > 0
        light = linear(pixels / 255.0)
        edges = np.quantile(depth[known], np.linspace(0.02, 0.98, BINS + 1))
        parts = []
        for k in range(BINS):
            chosen = known & (depth >= edges[k]) & (depth < edges[k + 1])
            if chosen.sum() < 200:
                continue
            levels = np.quantile(light[chosen], QUANTILES, axis=0)
            middle = np.full(len(QUANTILES), depth[chosen].mean())
            parts.append((np.arange(len(QUANTILES)), middle, levels))
        track, ranges, levels = (np.concatenate(column) for column in zip(*parts, strict=True))
        zero = np.zeros(len(track))
        observations = Observations(track, ranges, levels, zero.astype(int), np.zeros((len(track), 2)), levels)
        fit = WeightedObservations(observations).fit(Family(True, True, True))
        figures[path.name] = {
            "beta_D": fit.beta_D.tolist(), "beta_B": fit.beta_B.tolist(), "B": fit.B.tolist(),
            "metres": [float(edges[0]), float(edges[-1])],
        }  # fmt: skip
        print(
            path.name, np.round(fit.beta_D, 3), np.round(fit.beta_B, 3), np.round(fit.B, 3), np.round(edges[[0, -1]], 2)
        )
        clean = restored(
            pixels, np.where(known, depth, np.median(depth[known])), fit, 1.0, float(np.median(depth[known]))
        )
        title = f"{path.name[:24]}: beta_D {np.round(fit.beta_D, 2)} per metre"
        rows.append(
            (
                pixels,
                clean,
                lambda axis, v=(ranges, levels, track, fit, title): curve(axis, *v[:4], 1.0, v[4]),
                path.name,
            )
        )
    picture("effects_flsea_rgbd", rows)
    return {"kind": "photographs with metric depth", "per": "metre", "frames": figures}


def main() -> None:
    """Plan every scene and write the results."""
    document = {name: scene_with_points(name, kind) for name, kind in SCENES.items()}
    document["flsea_rgbd"] = frames_with_depth()
    (RESULTS / "effects_real.json").write_text(to_json(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
