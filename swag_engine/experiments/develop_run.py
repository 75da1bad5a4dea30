"""Automatic development of the restored colors of a run: exposure and white point.

White point: the gains that bring near, bright and nearly grey parts of the restored training views half way to grey;
sand and coral that are clearly colored stay so. Exposure: the one that makes the brightest near parts almost white,
unless highlights would be lost elsewhere, or a dark place would be made brighter than a photographer would expose it.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..base.transfer import LUMINANCE, srgb_to_linear
from ..effects.scene_effects import SceneEffects
from ..formats.run_folder import RunFolder
from ..gaussians.cloud import GaussianCloud
from ..rendering.render import render
from ..scene.cameras import Camera
from ..scene.colmap import Scene, load_scene
from ..splats.development import KNEE, NO_DEVELOPMENT, ColorView, Development

WIDTH = 160
"""Width in pixels of the views that the development is found from."""
COVERED = 0.9
"""Least alpha of a pixel that counts."""
MOST_CLIPPED = 0.01
"""Largest fraction of pixels that may be brighter than HEADROOM."""
HEADROOM = 2.0
"""Linear light, of which the roll-off makes display value 0.987: one stop above white, which 8 bits still hold."""
BRIGHT_QUANTILE = 0.98
"""Quantile of the near parts' luminance that exposure is measured at."""
BRIGHT_LIGHT = 0.8
"""Linear light that it becomes: white paint and fresh snow reflect 0.8 to 0.9."""
MEDIAN_LIGHT = 0.13
"""Linear light of the median surface up to which exposure is raised: exposure meters make the mean of a scene 0.12 to
0.14 (ISO 2720, K = 12.5 to 14). A room without anything bright would otherwise be shown far too bright."""
MOST_STOPS = 0.5
"""Most that exposure is raised, stops. A place may be dark: two rooms in coastal water, which would be raised by 1 and
1.6 stops, are at delta E 12.0 with this and 17.5 without. Lowering exposure loses nothing."""
MOST_STOPS_UNDER_LAMP = 2.0
"""The same where a lamp lights the place: how bright that is has no true value. It raises noise as well."""
NEARLY_GREY = 0.35
"""Largest ratio, in stops, of red and of blue to green in parts that are taken for neutral. At 0.6 the sand of the demo
scene counts and turns grey: delta E 15.7 instead of 12.8."""
NEUTRAL_WEIGHT = 0.5
"""Part of the median ratio of nearly grey parts that the white point takes away. They may be brown or blue themselves,
which is about as likely as an error of that size in the water: with all of it, two of four rooms turned blue (hue error
28 degrees larger, 8 degrees with half), while eight streets gained 0.3 delta E (0.2 with half)."""
LEAST_NEUTRAL = 0.02
"""Fraction of the near parts that must be bright and nearly grey for a white point."""
CLIPPED_VALUE = 254.5 / 255
"""Display value from which 8 bits hold the largest number."""


def color_view(folder: Path, develop: str, cloud: GaussianCloud, effects: SceneEffects) -> ColorView:
    """Find how the colors of a run are shown; an older run gets its automatic development now.

    Args:
        folder: Folder of the run.
        develop: As `RunFolder.color_view`.
        cloud: Gaussians of the run.
        effects: Effects of the run.

    Returns:
        The view.

    Raises:
        InputError: As `RunFolder.color_view` and `automatic_development`.
    """
    run = RunFolder(folder)
    if develop == "auto" and "auto" not in run.read_developments():
        return ColorView(restored=Development.from_json(automatic_development(folder, cloud, effects)))
    return run.color_view(develop)


def automatic_development(
    folder: Path, cloud: GaussianCloud, effects: SceneEffects, scene: Scene | None = None
) -> dict[str, Any]:
    """Find the automatic development of a run from its restored training views.

    Args:
        folder: Folder of the run.
        cloud: Gaussians of the run.
        effects: Effects of the run.
        scene: The scene, or the part of it that the run was trained on; read without it.

    Returns:
        The values of `Development`, for `RunFolder.write_development`; `clipped` and `clipped_before`, fractions of the
        surface's pixels in all training views that are clipped in red, green and blue with and without it; `neutral`,
        the fraction of the near parts that is bright and nearly grey; `note`, a sentence for the user. A run without
        water and lamp is not developed.

    Raises:
        InputError: Where there is no run, or its scene or a file is damaged.
    """
    scene_folder, settings, _ = RunFolder(folder).read_config()
    if effects.medium is None and effects.lamp is None:
        note = "No water was modelled: colors are as photographed and are not developed."
        return NO_DEVELOPMENT.to_json() | {"note": note}
    scene = scene or load_scene(scene_folder)
    cameras = scene.training_cameras(WIDTH)
    seen = [_restored(cloud, effects, camera, settings.sh_degree) for camera in cameras]
    colors, weights = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    development, neutral = find_development(
        colors, weights, MOST_STOPS if effects.lamp is None else MOST_STOPS_UNDER_LAMP
    )
    white = (
        f"white point from the {neutral:.1%} of the near parts that are bright and nearly grey"
        if neutral >= LEAST_NEUTRAL
        else f"white point kept: only {neutral:.1%} of the near parts are bright and nearly grey "
        f"(threshold {LEAST_NEUTRAL:.0%})"
    )
    return development.to_json() | {
        "clipped": _clipped(development.apply(colors)),
        "clipped_before": _clipped(colors),
        "neutral": neutral,
        "note": f"Exposure {development.exposure:+.2f} stops; {white}.",
    }


def find_development(colors: np.ndarray, weights: np.ndarray, most_stops: float) -> tuple[Development, float]:
    """Find exposure and white point.

    Args:
        colors: (N, 3) restored display values of surfaces.
        weights: (N,) 0..1, large where little water was in front.
        most_stops: Most that exposure is raised.

    Returns:
        The development, which is none without colors, and the fraction of the weight that is bright and nearly grey.
    """
    if not weights.sum():
        return NO_DEVELOPMENT, 0.0
    light = np.maximum(srgb_to_linear(colors), 1e-4)
    white, neutral = _white_point(light, weights)
    bright = _weighted_quantile(light @ (LUMINANCE * white), weights, BRIGHT_QUANTILE)
    highlights = np.quantile((light * white).max(axis=1), 1 - MOST_CLIPPED)
    median = float(np.median(light @ (LUMINANCE * white)))  # far parts count as much: they are as visible
    raised = min(np.log2(BRIGHT_LIGHT / bright), max(0.0, np.log2(MEDIAN_LIGHT / median)))
    stops = min(raised, most_stops, np.log2(HEADROOM / highlights))
    red, green, blue = white.tolist()
    return Development(round(float(stops), 3), (red, green, blue), knee=KNEE), neutral


def _white_point(light: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Return gains (3,) that keep the luminance of grey, and the fraction of the weight that they are from."""
    bright = light @ LUMINANCE > np.average(light @ LUMINANCE, weights=weights)
    ratios = np.log2(light[:, [0, 2]] / light[:, 1:2])
    grey = bright & (np.abs(ratios) < NEARLY_GREY).all(axis=1) & (light.max(axis=1) < 1)
    fraction = float(weights[grey].sum() / weights.sum())
    if fraction < LEAST_NEUTRAL:
        return np.ones(3), fraction
    red, blue = (_weighted_quantile(column, weights[grey], 0.5) for column in ratios[grey].T)
    gains = 2.0 ** (-NEUTRAL_WEIGHT * np.array([red, 0, blue]))
    return np.round(gains / (LUMINANCE @ gains), 4), fraction


def _weighted_quantile(values: np.ndarray, weights: np.ndarray, quantile: float) -> float:
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order][min(np.searchsorted(sums, sums[-1] * quantile), len(order) - 1)])


@torch.no_grad()
def _restored(
    cloud: GaussianCloud, effects: SceneEffects, camera: Camera, sh_degree: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return restored display values (N, 3) of the pixels with a surface, and transmissions (N,) of red to blue."""
    picture = render(cloud, camera, sh_degree, effects.medium, amount=0, with_range=True, lamp=effects.lamp)
    assert picture.range is not None
    covered = picture.alpha > COVERED
    ranges = picture.range[covered]
    beta = ranges.new_zeros(3) if effects.medium is None else effects.medium.beta_D
    transmission = torch.exp(-beta.max() * ranges)
    return picture.color[covered].cpu().numpy().astype(np.float64), transmission.cpu().numpy().astype(np.float64)


def _clipped(colors: np.ndarray) -> list[float]:
    """Return the fraction of the pixels (N, 3) that is clipped, by channel."""
    return np.round((colors >= CLIPPED_VALUE).mean(axis=0), 5).tolist()
