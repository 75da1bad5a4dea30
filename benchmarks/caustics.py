"""Compare three ways to keep caustics out of the learned colors.

Run: `python benchmarks/caustics.py`
Results: benchmarks/results/caustics.json

A flat wall, four metres wide, is seen in sixteen images under caustics of known strength (tests/scenes/make_scene.py)
with noise of standard deviation .02, and is learned back by Adam on L1: without any model, with a weight that falls
where patches differ in brightness, and with the light field of swag_engine/effects/caustics.py. The figure is PSNR
against the wall after one global gain, the mean of three seeds.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import write_results
from swag_engine.effects.caustics import Illumination
from swag_engine.effects.image_gain import apply_log_gains
from swag_engine.kernels.reference.transfer import to_display, to_light

ROWS, COLUMNS, VIEWS, STEPS = 60, 96, 16, 640
WAYS = ("no model", "weight", "field")
TRUSTED = 0.05
"""Difference of patch means, display values, at which the weight is one half."""
PATCH = 3
"""Side of a patch, pixels."""


def images_of(wall: Tensor, strength: float, seed: int) -> list[Tensor]:
    """Render VIEWS noisy images of the wall (H, W, 3) under caustics of this strength."""
    from tests.scenes.make_scene import caustic_pattern

    random, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    y, x = np.mgrid[:ROWS, :COLUMNS] * 4 / COLUMNS
    places = np.stack([x, y, np.zeros_like(x)], -1)
    made = []
    for _ in range(VIEWS):
        light = 1 + strength * (torch.from_numpy(caustic_pattern(places, random)).float() - 1)
        shown = to_display(to_light(wall) * light[..., None]).clamp(0, 1)
        made.append(shown + 0.02 * torch.randn(wall.shape, generator=generator))
    return made


def trust(image: Tensor, picture: Tensor) -> Tensor:
    """Return a weight (H, W) that is one half where patches differ by TRUSTED."""
    difference = (image - picture).mean(2)[None, None]
    patch = torch.nn.functional.avg_pool2d(difference, PATCH, 1, PATCH // 2, count_include_pad=False)[0, 0]
    return 1 / (1 + (patch / TRUSTED).square())


def learned(seen: list[Tensor], way: str) -> Tensor:
    """Optimise the wall (H, W, 3) from its images in one of WAYS."""
    picture = torch.stack(seen).mean(0).requires_grad_()
    field = Illumination.starting([str(view) for view in range(VIEWS)], COLUMNS, ROWS)
    field.log_light.requires_grad_()
    optimizer = torch.optim.Adam([{"params": [picture]}, {"params": [field.log_light]}])
    for step in range(STEPS):
        for group, rate in zip(optimizer.param_groups, (5e-3, 2e-2), strict=True):
            group["lr"] = rate * (1 - step / STEPS)
        view = step % VIEWS
        shown = apply_log_gains(picture, [field.log_gain(str(view), *picture.shape[:2])]) if way == "field" else picture
        weight = trust(seen[view], shown.detach()) if way == "weight" else torch.ones(ROWS, COLUMNS)
        optimizer.zero_grad()
        ((shown - seen[view]).abs().mean(2) * weight).mean().backward()
        optimizer.step()
    return picture.detach()


def psnr(picture: Tensor, wall: Tensor) -> float:
    """Measure PSNR after removing one global gain."""
    gain = (to_light(picture) / to_light(wall)).median()
    return float(-10 * (to_display(to_light(picture) / gain) - wall).square().mean().log10())


def main() -> None:
    """Run every strength, way and seed, print a table and write the results."""
    table: dict[str, dict[str, float]] = {}
    for strength in (0.0, 0.4, 0.8):
        figures: dict[str, list[float]] = {way: [] for way in WAYS}
        for seed in range(3):
            texture = np.random.default_rng(seed).uniform(0, 1, (ROWS, COLUMNS, 3))
            wall = torch.from_numpy(cv2.GaussianBlur(texture, (0, 0), 1.2) * 2 - 0.5).float().clamp(0.05, 0.9)
            seen = images_of(wall, strength, seed)
            for way in WAYS:
                figures[way].append(psnr(learned(seen, way), wall))
        table[str(strength)] = {way: round(float(np.mean(values)), 2) for way, values in figures.items()}
        print(strength, table[str(strength)], flush=True)
    write_results("caustics", {"psnr": table})


if __name__ == "__main__":
    main()
