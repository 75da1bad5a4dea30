"""Compare one exponential with two in water whose attenuation depends on the wavelength, as real water's does.

Run: `python benchmarks/spectral_water.py`
Results: benchmarks/results/spectral_water.json

A channel of a camera sees a band of wavelengths. Those that water takes most are gone first, so that the attenuation of
the channel falls with range. The absorption of pure water is that of Pope and Fry 1997 (Applied Optics 36), dissolved
matter absorbs with a slope of 0.014 per nanometre (Bricaud et al. 1981), particles scatter inversely with the
wavelength. Channels are normal curves about 600, 535 and 460 nm. Attenuation alone is simulated, without noise, and
each law is fitted with the true colors at hand: the difference is the most that a second exponential can give.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import write_results
from benchmarks.effects_volume import color_error

NANOMETRES = np.arange(400, 701, 10.0)
PURE = np.array([
    .0066, .0047, .0045, .0050, .0064, .0092, .0098, .0106, .0127, .0150, .0204, .0325, .0409, .0434, .0474, .0565,
    .0619, .0695, .0896, .1351, .2224, .2644, .2755, .2916, .3108, .3400, .4100, .4390, .4650, .5160, .6240,
])  # fmt: skip
"""Absorption of pure water, 1/m."""
CHANNELS = np.exp(-0.5 * ((NANOMETRES - np.array([[600], [535], [460]])) / np.array([[35], [38], [28]])) ** 2)
WATERS = {"ocean": (0.02, 0.05, 12.0), "coast": (0.15, 0.3, 6.0), "green": (0.4, 0.5, 6.0)}
"""Absorption of dissolved matter at 440 nm and scattering at 550 nm, 1/m; the longest range, m."""
DEPTHS = (2.0, 8.0)
"""Below the surface, m: light has lost its longest wavelengths on the way down."""
SEEDS = range(3)
POINTS = 2000


def reflectances(random: np.random.Generator) -> np.ndarray:
    """Return smooth reflectances (POINTS, wavelengths) of surfaces: grey, with more or less red, green and blue."""
    curves = np.stack(
        [
            np.tanh((NANOMETRES - 590) / 30),
            np.exp(-0.5 * ((NANOMETRES - 530) / 50) ** 2),
            np.tanh((480 - NANOMETRES) / 30),
        ]
    )
    grey = random.uniform(0.05, 0.5, (POINTS, 1))
    return (grey * np.exp(random.normal(0, 0.5, (POINTS, 3)) @ curves)).clip(0.01, 0.95)


def two_exponentials(p: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return the log gain at ranges r (N,), metres.

    p is its value at range 0, its slope there (1/m), the fraction of that slope far away (logit), and how fast the
    slope falls (log, 1/m).
    """
    far, rate = 1 / (1 + np.exp(-p[2])), np.exp(p[3])
    return p[0] + p[1] * (far * r - (1 - far) * np.expm1(-rate * r) / rate)


def measure(matter: float, scattering: float, longest: float, depth: float, seed: int) -> dict[str, float]:
    """Return delta E as taken and restored by each law, and the attenuation of red near (below 2 m) and far."""
    random = np.random.default_rng(seed)
    absorbed = PURE + matter * np.exp(-0.014 * (NANOMETRES - 440))
    scattered = scattering * 550 / NANOMETRES
    daylight = np.exp(-(absorbed + 0.1 * scattered) * depth)
    surfaces, r = reflectances(random), random.uniform(0.5, longest, POINTS)
    white = CHANNELS @ daylight
    clean = (surfaces * daylight) @ CHANNELS.T / white
    # A part of the scattered light still arrives.
    passed = np.exp(-(absorbed + 0.3 * scattered) * r[:, None])
    light = (surfaces * daylight * passed) @ CHANNELS.T / white
    one, two = np.empty_like(light), np.empty_like(light)
    for channel in range(3):
        gain = np.log(clean[:, channel] / light[:, channel])
        line = np.polyfit(r, gain, 1)
        found = least_squares(lambda p, gain=gain: two_exponentials(p, r) - gain, [line[1], line[0], 1.0, -1.5])
        one[:, channel] = light[:, channel] * np.exp(np.polyval(line, r))
        two[:, channel] = light[:, channel] * np.exp(two_exponentials(found.x, r))
    red = np.log(clean[:, 0] / light[:, 0]) / r
    errors = {"as taken": light, "one exponential": one, "two exponentials": two}
    return {name: color_error(clean, restored) for name, restored in errors.items()} | {
        "red near": float(red[r < 2].mean()),
        "red far": float(red[r > 0.8 * longest].mean()),
    }


def main() -> None:
    """Measure all waters, print their medians over the seeds and write the results."""
    scenes = {}
    for name, water in WATERS.items():
        for depth in DEPTHS:
            rows = [measure(*water, depth, seed) for seed in SEEDS]
            row = {key: round(float(np.median([row[key] for row in rows])), 3) for key in rows[0]}
            scenes[f"{name}, {depth:g} m deep"] = row
            print(name, depth, row)
    write_results("spectral_water", {"scenes": scenes})


if __name__ == "__main__":
    main()
