"""What a scene's images and sparse points say about each effect, before training (docs/method.md section 9).

Colours are taken in linear light. Every finding carries the figures it rests on, each with its threshold, and says in
one sentence why; "unknown" is an answer, for where the photographs cannot tell.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import cv2
import numpy as np
from scipy.spatial import cKDTree

from ..base.transfer import srgb_to_linear
from ..evidence.fit import MOST_SIGHTINGS, Family, Fit, Sightings, independent_channels, lens_terms
from ..evidence.observations import (
    LEAST_CHANGE,
    LEAST_OBSERVATIONS,
    LEAST_RANGE_RATIO,
    LEAST_VEIL,
    Observations,
    track_ratio,
)
from ..priors.interpolate import Admission
from ..scene.colmap import Scene
from ..scene.images import TrainingImage

State = Literal["on", "off", "unknown"]

LEAST_BIC_GAIN = 10.0
LEAST_FALLOFF = 0.15
"""Share of its light that a lamp must lose over the scene's range beyond what water takes."""
LEAST_LAMP_BIC, SURE_LAMP_BIC, LEAST_LAMP_SHARE = 30.0, 1000.0, 0.78
"""Light that changes by itself, as in a room, can look like a lamp. A BIC gain below the first is none; one below the
second counts where light falls off by so much of what the inverse square of range would make it."""
LAMP_ERROR = 0.3
"""Share of a lamp's fall-off that its formula may be wrong by: water under a lamp must take so much more."""
GREY = 0.2
"""Spread of beta_D over the channels, as a share of the largest, below which the loss has no colour: water has one."""
LEAST_GAIN_SD, LEAST_GAIN_BIC, LEAST_GAIN_BIC_BY_LAMP = 0.045, 100.0, 700.0
"""Of the log gains: the light of waves and what a telephone does, which the formula misses, look like gains of 3 %, or
gain a BIC of some tens by them, and that of a lamp of some hundreds."""
LEAST_LENS = 0.05
WIDEST_INTERVAL = 0.5
"""Of the largest beta_D: half of its 95 % interval, as a share of it."""
MOST_RADIUS_CORRELATION = 0.75
LEAST_COLOR, SURE_COLOR, LEAST_WATER_BIC = 0.2, 0.08, 50.0
"""Share by which one colour must fade beside another, the lower 95 % bound of that, and its BIC gain. Shine, blur and
what a telephone makes of a picture take from some surfaces only, and halves of the scene disagree about them."""
SURE_BIC = 400.0
"""BIC gains of attenuation and of the veil that water is believed by without sure colours, where the darkest light
rises with range, too: shine and lamps bring no veil that the dark shows."""
HALVES = 12
"""Random halves of the scene that the intervals are taken from."""
LEAST_DARK_RISE, LEAST_DARK = 0.27, 0.003
"""By how much the darkest light must rise with range, as a share of what the fitted backscatter would raise it, and in
light. Colours that grow alike with range, as they do where far texture is blurred, look like a veil without it."""
DARKEST = 0.01
RANGE_BINS = 8

LEAST_FLICKER, LEAST_SHARED = 0.06, 0.0035
"""Sd of the log light that points side by side share, and that times their correlation."""
BESIDE, MOST_BESIDE = 0.04, 1000
"""Distance of points side by side, in halves of a photograph's diagonal, and how many of them two photographs tell."""
SMOOTH_DEGREES = {4: 60, 2: 0}
"""Degree of the polynomial over a photograph that is no flicker, for so many points at least: the waves' light is finer
than a lens' fall-off, a lamp's beam, and what a telephone does for contrast."""
LEAST_STEADINESS = 0.6
"""Flicker between the nearer half of the views over that of the farther: waves do not care where the camera is, but
shine and the shadows of a lamp do."""
PAIR_ANGLE, PAIR_RANGE, LEAST_PAIR = 10.0, 0.05, 30

MOST_FRAMES, MOST_SHARED = 40, 0.5
CELLS, LEAST_CELLS, LEAST_POINTS, LEAST_ACCEPTED = 16, 0.5, 500, 0.8
LEAST_OPEN_WATER, LEAST_CELLS_OF_WATER, FLAT = 0.05, 0.01, 1.5


@dataclass(frozen=True)
class Finding:
    """One effect: whether it is there, the figures behind that, and why in a sentence."""

    state: State
    evidence: dict[str, Any]
    reason: str


@dataclass(frozen=True)
class WaterFindings:
    """What the sightings say of the effects that change a point's colour with range or photograph.

    effects: attenuation, backscatter, separate_backscatter, lamp, exposure. fit: the values of the family that was
    chosen (None where nothing could be fitted), and which `images` its log gains are of, by index. intervals: for
    beta_D, beta_B and B the lower and upper 95 % bounds, each (2, 3).
    """

    effects: dict[str, Finding]
    fit: Fit | None = None
    images: Sequence[int] = ()
    intervals: dict[str, np.ndarray] = field(default_factory=dict)


# Water, lamp and exposure ---------------------------------------------------------------------------------------------


def water_findings(observations: Observations, open_water: np.ndarray | None = None, seed: int = 0) -> WaterFindings:
    """Attenuation, backscatter, its own coefficient, lamp and exposure, of all sightings of a scene.

    open_water (3,): linear light where the photographs show nothing but water, as open_water_light gives it.
    """
    names = ("attenuation", "backscatter", "separate_backscatter", "lamp", "exposure")
    if len(observations) < LEAST_OBSERVATIONS:
        reason = f"It cannot be told: only {len(observations)} sightings of points can be used."
        figures = {"sightings": len(observations), "sightings_least": LEAST_OBSERVATIONS}
        return WaterFindings({name: Finding("unknown", figures, reason) for name in names})
    random = np.random.default_rng(seed)
    ratio = float(np.quantile(track_ratio(observations), 0.95))
    correlation = float(abs(np.corrcoef(observations.ranges, observations.radius)[0, 1]))
    points = random.permutation(np.unique(observations.track))
    most = max(2, int(len(points) * MOST_SIGHTINGS / len(observations)))
    sightings = Sightings(observations.take(np.isin(observations.track, points[:most])), open_water=open_water)
    rich = Family(attenuation=True, backscatter=True, separate=True, lamp=True, lens=True, gains=True)
    first = sightings.fit(rich)
    sightings = sightings.without_outliers(first)
    independent = independent_channels(first.residual)

    def bic(fit: Fit) -> float:
        return fit.bic(sightings.count, independent)

    # Gains and lens are decided with every other term in the model, so that neither can stand for water.
    apart = {
        (lens, gains): sightings.fit(replace(rich, lens=lens, gains=gains))
        for lens in (False, True)
        for gains in (False, True)
    }
    gained = min((fit for (_, gains), fit in apart.items() if gains), key=bic)
    plain = min((fit for (_, gains), fit in apart.items() if not gains), key=bic)
    spread = _spread(gained)
    gain_bic = bic(plain) - bic(gained)
    gains = gain_bic > LEAST_GAIN_BIC and spread > LEAST_GAIN_SD
    lens_bic = bic(apart[False, gains]) - bic(apart[True, gains])
    lens = lens_bic > LEAST_BIC_GAIN and _unevenness(apart[True, gains]) > LEAST_LENS
    exposure = Finding(
        "on" if gains else "off",
        {"gain_sd": spread, "gain_sd_least": LEAST_GAIN_SD, "bic_gain": gain_bic, "bic_gain_least": LEAST_GAIN_BIC},
        f"The photographs' brightness differs by {spread:.1%} (sd; more than {LEAST_GAIN_SD:.1%} counts).",
    )

    fits = {
        family: sightings.fit(family)
        for lamp in (False, True)
        for family in (
            Family(lamp=lamp, lens=lens, gains=gains),
            Family(True, lamp=lamp, lens=lens, gains=gains),
            Family(True, True, lamp=lamp, lens=lens, gains=gains),
            Family(True, True, True, lamp=lamp, lens=lens, gains=gains),
        )
    }
    near, far = np.quantile(observations.ranges, (0.05, 0.95))
    veiled = fits[Family(True, True, True, lens=lens, gains=gains)]
    expected = veiled.B * (np.exp(-veiled.beta_B * near) - np.exp(-veiled.beta_B * far))
    channel = int(np.argmax(expected))
    rise, least_rise = dark_rise(observations)[channel], max(LEAST_DARK_RISE * expected[channel], LEAST_DARK)
    witness = rise >= least_rise
    believed = [fit for family, fit in fits.items() if witness or not family.backscatter]
    lamp = _lamp(believed, bic, observations.ranges)
    none, direct, tied, separate = (fit for family, fit in fits.items() if family.lamp == (lamp.state == "on"))
    veil = separate.B * (1 - np.exp(-separate.beta_B * far))
    veil_bic = bic(direct) - min(bic(tied), bic(separate))
    adds_light = bool(witness and veil_bic > LEAST_BIC_GAIN and veil.max() >= LEAST_VEIL)

    best = min((direct, tied, separate) if adds_light else (direct,), key=bic)
    change = 1 - np.exp(-best.beta_D * (far - near))
    strongest = int(np.argmax(change))
    attenuation_bic = bic(none) - bic(best)
    falls_off = lamp.state != "off"
    least_change = LEAST_CHANGE + (LAMP_ERROR * lamp.evidence["falloff"] if falls_off else 0.0)
    loses = attenuation_bic > LEAST_BIC_GAIN and change.max() >= LEAST_CHANGE
    halves = [sightings.half(random).fit(best.family, best, steps=10) for _ in range(HALVES)] if loses else []
    weakest = int(np.argmin(change))
    grey = float(1 - best.beta_D[weakest] / max(best.beta_D[strongest], 1e-12))
    parted = [
        float(-np.expm1((made.beta_D[weakest] - made.beta_D[strongest]) * (far - near))) for made in (best, *halves)
    ]
    color = abs(parted[0]) if loses else 0.0  # no minus before nothing
    sure_color = color - 1.96 * float(np.std(parted[1:], ddof=1)) if loses else 0.0
    colored = grey >= GREY and color >= LEAST_COLOR and sure_color >= SURE_COLOR and attenuation_bic > LEAST_WATER_BIC
    veiled_surely = adds_light and min(veil_bic, attenuation_bic) > SURE_BIC
    dims = loses and change.max() >= least_change and (colored or veiled_surely)
    veils = adds_light and dims
    # The coefficients are those of the widest family that was accepted: what need not be separate is nearly tied.
    fit = separate if veils else direct if dims else none
    if dims and fit.family != best.family:
        halves = [sightings.half(random).fit(fit.family, fit, steps=10) for _ in range(HALVES)]
    intervals = _intervals(fit, halves) if dims else {}
    width = float(np.ptp(intervals["beta_D"], axis=0)[strongest] / 2 / fit.beta_D[strongest]) if dims else float("nan")
    resolution = float(sightings.resolution(none, far - near, LEAST_CHANGE).max())

    named = ("red", "green", "blue")[strongest]
    effects = {
        "attenuation": Finding(
            "on" if dims else "off",
            {
                "bic_gain": attenuation_bic,
                "bic_gain_least": LEAST_WATER_BIC,
                "change": change.tolist(),
                "change_least": least_change,
                "color": color,
                "color_least": LEAST_COLOR,
                "sure_color": sure_color,
                "sure_color_least": SURE_COLOR,
                "color_of_loss": grey,
                "color_of_loss_least": GREY,
                "interval": width,
                "interval_most": WIDEST_INTERVAL,
                "resolution": resolution,
                "resolution_most": LEAST_CHANGE,
            },
            f"{named.capitalize()} loses {change.max():.0%} between the nearest and the farthest points "
            f"({least_change:.0%} at least); BIC gain {attenuation_bic:,.0f} ({LEAST_WATER_BIC:.0f} at least)"
            + (
                f"; beside another it fades by {color:.0%} ({LEAST_COLOR:.0%} counts), for sure {sure_color:.0%}."
                if dims and colored
                else "; the veil that the darkest light shows says the same."
                if dims
                else "."
            ),
        ),
        "backscatter": Finding(
            "on" if veils else "off",
            {
                "bic_gain": veil_bic,
                "bic_gain_least": LEAST_BIC_GAIN,
                "veil": veil.tolist(),
                "veil_least": LEAST_VEIL,
                "dark_rise": float(rise),
                "dark_rise_least": float(least_rise),
            },
            f"The water adds {veil.max():.3f} of light at the far end ({LEAST_VEIL} at least), BIC gain "
            f"{veil_bic:,.0f} ({LEAST_BIC_GAIN:.0f} at least); the darkest light rises with range by {rise:.3f} "
            f"({least_rise:.3f} at least)" + ("." if dims else "; without attenuation it is no water."),
        ),
        "separate_backscatter": _separate(tied, separate, bic(tied) - bic(separate), bool(veils)),
        "lamp": lamp,
        "exposure": exposure,
    }
    if loses and not dims:
        effects["attenuation"] = _untold(
            effects["attenuation"],
            f"It cannot be told from a lamp, the lens, shine or blur, which take from all colours alike: {named} loses "
            f"{change.max():.0%} between the nearest and the farthest points ({least_change:.0%} at least), and "
            f"fades beside another colour by {color:.0%}, {max(sure_color, 1e-9):.0%} for sure ({LEAST_COLOR:.0%} and "
            f"{SURE_COLOR:.0%} at least).",
        )
    elif not dims and resolution > LEAST_CHANGE:
        effects["attenuation"] = _untold(
            effects["attenuation"],
            f"It cannot be told: a loss of {LEAST_CHANGE:.0%} between the nearest and the farthest points would be "
            f"known to +-{resolution:.0%} only.",
        )
    if dims and width > WIDEST_INTERVAL and not veiled_surely and sure_color < LEAST_COLOR:
        effects["attenuation"] = _untold(
            effects["attenuation"],
            f"The water cannot be told: the loss of {named} is known to +-{width:.0%} only (+-{WIDEST_INTERVAL:.0%} at "
            "most).",
        )
    if effects["attenuation"].state == "unknown" and adds_light:
        effects["backscatter"] = _untold(effects["backscatter"], effects["attenuation"].reason)
    if gains and lamp.state == "on" and gain_bic <= LEAST_GAIN_BIC_BY_LAMP:
        effects["exposure"] = _untold(
            exposure,
            f"It cannot be told from the lamp's own light: BIC gain {gain_bic:,.0f} ({LEAST_GAIN_BIC_BY_LAMP:.0f} at "
            "least under a lamp).",
        )
    for name in ("attenuation", "backscatter", "lamp"):
        finding = effects[name]
        finding.evidence.update(
            range_ratio=ratio,
            range_ratio_least=LEAST_RANGE_RATIO,
            radius_correlation=correlation,
            radius_correlation_most=MOST_RADIUS_CORRELATION,
        )
        if ratio < LEAST_RANGE_RATIO:
            effects[name] = _untold(
                finding,
                f"It cannot be told: points are seen from ranges of ratio {ratio:.2f} at most ({LEAST_RANGE_RATIO} at "
                "least).",
            )
        elif correlation > MOST_RADIUS_CORRELATION:
            effects[name] = _untold(
                finding,
                f"It cannot be told from the lens' fall-off: range and distance from the picture's middle go together "
                f"(correlation {correlation:.2f}, {MOST_RADIUS_CORRELATION} at most).",
            )
    return WaterFindings(effects, fit, np.unique(sightings.observations.image).tolist(), intervals)


def _spread(fit: Fit) -> float:
    """Sd of the log gains without that of their errors. A survey's straight lines cannot tell gains that rise from one
    photograph to the next from a lens that is brighter on one side: what is not known so does not count."""
    squared_errors, directions = np.linalg.eigh(fit.gain_covariance)
    known = squared_errors < LEAST_GAIN_SD**2
    variance = (directions.T @ fit.log_gains)[known] ** 2 - squared_errors[known]
    return float(np.sqrt(max(variance.sum() / max(known.sum() - 1, 1), 0)))


def _unevenness(fit: Fit) -> float:
    """Log ratio of the brightest and the darkest of a photograph's middle, edges and corners."""
    places = np.stack(np.meshgrid([-0.8, 0, 0.8], [-0.6, 0, 0.6]), -1).reshape(-1, 2)
    return float(np.ptp(lens_terms(places) @ fit.lens))


def _untold(finding: Finding, reason: str) -> Finding:
    return Finding("unknown", finding.evidence, reason)


def _lamp(fits: Sequence[Fit], bic: Callable[[Fit], float], ranges: np.ndarray) -> Finding:
    """A lamp where light falls off as 1 / (tau + r^2) beyond what water takes, or where the loss has no colour."""
    near, far = np.quantile(ranges, (0.05, 0.95))
    ambient = min((fit for fit in fits if not fit.family.lamp), key=bic)
    lit = min((fit for fit in fits if fit.family.lamp), key=bic)
    gain = bic(ambient) - bic(lit)
    loss = 1 - np.exp(-ambient.beta_D * (far - near))
    grey = float(1 - ambient.beta_D.min() / max(ambient.beta_D.max(), 1e-12)) if ambient.family.attenuation else 1.0
    even, falling = (
        next(fit for fit in fits if fit.family == Family(lamp=lamp, lens=lit.family.lens, gains=lit.family.gains))
        for lamp in (False, True)
    )
    colorless = grey < GREY and loss.max() >= LEAST_FALLOFF and bic(even) - bic(falling) > LEAST_BIC_GAIN
    if colorless:  # then water is no alternative, and the lamp is weighed against even light
        lit, gain = falling, bic(even) - bic(falling)
    falloff = 1 - (lit.tau + near**2) / (lit.tau + far**2)
    share = falloff / max(1 - (near / far) ** 2, 1e-12)
    least = LEAST_LAMP_BIC if share >= LEAST_LAMP_SHARE else SURE_LAMP_BIC
    found = falloff >= LEAST_FALLOFF and gain > least
    tied = falloff >= LEAST_FALLOFF and gain > -LEAST_BIC_GAIN
    figures = {
        "bic_gain": gain,
        "bic_gain_least": least,
        "inverse_square": float(share),
        "inverse_square_least": LEAST_LAMP_SHARE,
        "falloff": float(falloff),
        "falloff_least": LEAST_FALLOFF,
        "color_of_loss": grey,
        "color_of_loss_most": GREY,
    }
    reason = (
        f"Light falls off from the camera by {falloff:.0%} over the scene's range ({LEAST_FALLOFF:.0%} at least)"
        + ("" if colorless else " beyond what water takes")
        + f"; BIC gain {gain:,.0f} ({least:.0f} at least)"
        + (f", and the loss has no colour (spread {grey:.0%}, {GREY:.0%} at most)." if colorless else ".")
    )
    if tied and not found:
        reason = (
            f"It cannot be told: light that falls off from the camera by {falloff:.0%} explains the colours as well as "
            f"water does (BIC gain {gain:,.0f}, {least:.0f} at least)."
        )
    return Finding("on" if found else "unknown" if tied else "off", figures, reason)


def _separate(tied: Fit, separate: Fit, gain: float, veiled: bool) -> Finding:
    ratio = separate.beta_B / np.maximum(separate.beta_D, 1e-12)
    found = veiled and gain > LEAST_BIC_GAIN
    reason = (
        f"A coefficient of its own explains the colours better by a BIC of {gain:,.0f} ({LEAST_BIC_GAIN:.0f} at least)"
    )
    return Finding(
        "on" if found else "off",
        {"bic_gain": gain, "bic_gain_least": LEAST_BIC_GAIN, "ratio": ratio.tolist()},
        reason + ("." if veiled else "; there is no backscatter."),
    )


def _intervals(fit: Fit, halves: Sequence[Fit]) -> dict[str, np.ndarray]:
    """95 % bounds (2, 3): the spread over halves drawn without putting back is that of the whole."""
    bounds = {}
    for name in ("beta_D", "beta_B", "B"):
        value = getattr(fit, name)
        sd = np.std([getattr(half, name) for half in halves], axis=0, ddof=1)
        bounds[name] = np.stack([np.maximum(value - 1.96 * sd, 0), value + 1.96 * sd])
    return bounds


def dark_rise(observations: Observations) -> np.ndarray:
    """By how much light the darkest percent around the points is brighter at the far end of the ranges, (3,)."""
    edges = np.quantile(observations.ranges, np.linspace(0, 1, RANGE_BINS + 1))
    bins = np.clip(np.searchsorted(edges, observations.ranges) - 1, 0, RANGE_BINS - 1)
    dark = np.stack([np.quantile(observations.darkest[bins == k], DARKEST, axis=0) for k in np.unique(bins)])
    return dark[-2:].mean(0) - dark[:2].mean(0)


# Caustics -------------------------------------------------------------------------------------------------------------


def caustics_finding(observations: Observations, centres: np.ndarray, positions: np.ndarray) -> Finding:
    """Whether light flickers on the ground: the same point, seen from nearly the same place, brighter or darker, and
    what lies right beside it with it. centres (V, 3) of the cameras, positions (P, 3) of the points.

    Only the changes that whole photographs do not share count, and those of lone points are errors of matching.
    """
    views = len(centres)
    grey = np.log(observations.light.mean(1) + 1e-3)
    changes: list[np.ndarray] = []
    angles: list[np.ndarray] = []
    by_image = [np.flatnonzero(observations.image == k) for k in range(views)]
    for a in range(views):
        tracks_a = observations.track[by_image[a]]
        for b in range(a + 1, views):
            _, left, right = np.intersect1d(tracks_a, observations.track[by_image[b]], return_indices=True)
            left, right = by_image[a][left], by_image[b][right]
            places = positions[observations.track[left]]
            rays = [places - centres[k] for k in (a, b)]
            cosine = (rays[0] * rays[1]).sum(1) / np.maximum(
                observations.ranges[left] * observations.ranges[right], 1e-12
            )
            same = (cosine > np.cos(np.radians(PAIR_ANGLE))) & (
                np.abs(np.log(observations.ranges[left] / observations.ranges[right])) < PAIR_RANGE
            )
            if same.sum() < LEAST_PAIR:
                continue
            place = observations.place[left][same]
            beside = cKDTree(place).query_pairs(BESIDE, output_type="ndarray")
            beside = beside[:: 1 + len(beside) // MOST_BESIDE]
            changes.append(_rough(grey[right][same] - grey[left][same], place)[beside])
            angles.append(np.arccos(np.clip(cosine[same], -1, 1))[beside].mean(1))
    change, angle = np.concatenate([np.zeros((0, 2)), *changes]), np.concatenate([np.zeros(0), *angles])
    figures: dict[str, Any] = {
        "flicker_least": LEAST_FLICKER,
        "shared_least": LEAST_SHARED,
        "steadiness_least": LEAST_STEADINESS,
        "pairs": len(change),
        "pairs_least": LEAST_PAIR,
    }
    if len(change) < LEAST_PAIR:
        return Finding(
            "unknown",
            figures,
            f"It cannot be told: only {len(change)} times ({LEAST_PAIR} at least) do two photographs see points "
            f"side by side from nearly the same place (within {PAIR_ANGLE:.0f} degrees and {PAIR_RANGE:.0%} of range).",
        )
    nearer = angle <= np.median(angle)
    flicker, correlation = _flicker(change)
    farther = _flicker(change[~nearer])[0] if (~nearer).any() else flicker
    steadiness = _flicker(change[nearer])[0] / max(farther, 0.01)  # less is none, and its ratio would be noise
    shared = flicker * correlation
    found = flicker > LEAST_FLICKER and shared > LEAST_SHARED and steadiness > LEAST_STEADINESS
    figures |= {"flicker": flicker, "neighbours": correlation, "shared": shared, "steadiness": steadiness}
    return Finding(
        "on" if found else "off",
        figures,
        f"Seen again from nearly the same place, light on the ground differs by {flicker:.1%} (sd; more than "
        f"{LEAST_FLICKER:.0%} counts), alike for what lies side by side (correlation {correlation:.2f}; the product "
        f"{shared:.2%}, more than {LEAST_SHARED:.2%} counts) and as much between near views as between farther ones "
        f"({steadiness:.2g} times, more than {LEAST_STEADINESS} counts).",
    )


def _rough(change: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Log changes (n,) without what is smooth over the photograph."""
    usual = 3 * _robust_sd(change)
    middle = np.median(change)
    degree = next(degree for degree, least in SMOOTH_DEGREES.items() if len(change) >= least)
    x, y = place.T
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], 1)
    smooth = np.linalg.lstsq(terms, np.clip(change, middle - usual, middle + usual), rcond=None)[0]
    return change - terms @ smooth


def _flicker(change: np.ndarray) -> tuple[float, float]:
    """Sd of the log light that two points side by side (n, 2) share, and their correlation: the rest is error of the
    colours."""
    usual = 3 * max(_robust_sd(change), 1e-6)
    clipped = np.clip(change, -usual, usual)
    correlation = float(np.corrcoef(clipped.T)[0, 1]) if (np.ptp(clipped, axis=0) > 0).all() else 0.0
    return usual / 3 * float(np.sqrt(max(correlation, 0))), correlation


def _robust_sd(values: np.ndarray) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


# What is asked of whole photographs -----------------------------------------------------------------------------------


def moving_objects_finding(masked: Sequence[str]) -> Finding:
    """masked: names of the photographs that the user gave masks for."""
    figures = {"masked_images": len(masked)}
    if masked:
        return Finding("on", figures, f"Masks were given for {len(masked)} photographs; what they cover is left out.")
    return Finding(
        "unknown", figures, "Only training shows it: what moves stays unexplained when everything else is learned."
    )


def interpolation_finding(pairs: Sequence[tuple[str, str]], scene: Scene, admission: Admission | None) -> Finding:
    """pairs of training neighbours as priors.interpolate.neighbour_pairs gives them; admission: None without a
    network."""
    seen = {view.name: view.point_indices for view in scene.views}
    shared = [len(np.intersect1d(seen[a], seen[b])) / max(min(len(seen[a]), len(seen[b])), 1) for a, b in pairs]
    share = float(np.median(shared)) if shared else float("nan")
    figures: dict[str, Any] = {
        "images": len(scene.views),
        "images_most": MOST_FRAMES,
        "shared_points": share,
        "shared_points_most": MOST_SHARED,
    }
    if not pairs:
        return Finding("off", figures, "No two training photographs follow each other.")
    if len(scene.views) > MOST_FRAMES:
        return Finding(
            "off", figures, f"There are {len(scene.views)} photographs (up to {MOST_FRAMES} may be too few)."
        )
    if share >= MOST_SHARED:
        return Finding(
            "off",
            figures,
            f"Neighbouring photographs share {share:.0%} of their points (less than {MOST_SHARED:.0%} would be few).",
        )
    sparse = f"Neighbouring photographs share only {share:.0%} of their points ({MOST_SHARED:.0%} would do)"
    if admission is None:
        return Finding("unknown", figures, f"{sparse}; whether made frames help needs an interpolation network.")
    figures |= {"psnr": admission.psnr, "gain": admission.gain, "consistent": admission.consistent}
    if admission.admitted:
        return Finding("on", figures, f"{sparse}, and made frames match left-out ones with {admission.psnr:.1f} dB.")
    return Finding("off", figures, admission.reason)


def open_water_light(images: Sequence[TrainingImage], scene: Scene) -> np.ndarray | None:
    """Median linear light (3,) of the flat cells without points, None where they are less than a hundredth."""
    empty = _empty_and_flat(images, scene)
    if empty.mean() < LEAST_CELLS_OF_WATER:
        return None
    colors = np.concatenate(
        [
            cv2.resize(image.pixels, (CELLS, CELLS), interpolation=cv2.INTER_AREA)[cells]
            for image, cells in zip(images, empty, strict=True)
        ]
    )
    display = np.median(colors, axis=0) / 255
    return srgb_to_linear(display)


def semantics_finding(wanted: bool, images: Sequence[TrainingImage], scene: Scene, veiled: bool) -> Finding:
    """wanted: the user asked for labels. Open water: flat cells without points, counted where there is backscatter."""
    share = float(np.mean(_empty_and_flat(images, scene))) if veiled else 0.0
    figures: dict[str, Any] = {"wanted": wanted, "open_water": share, "open_water_least": LEAST_OPEN_WATER}
    if wanted:
        return Finding("on", figures, "Labels were asked for.")
    return Finding(
        "on" if share > LEAST_OPEN_WATER else "off",
        figures,
        f"Open water covers {share:.0%} of the photographs (more than {LEAST_OPEN_WATER:.0%} counts)"
        + ("." if veiled else ": there is no backscatter to fill it."),
    )


def depth_prior_finding(images: Sequence[TrainingImage], scene: Scene, accepted: float | None) -> Finding:
    """accepted: share of the photographs whose predicted depth passes section 3's gate, None without a network."""
    counts = _cells(images, scene)
    cells, points = float((counts > 0).mean()), float(np.median(counts.sum((1, 2))))
    figures: dict[str, Any] = {
        "cells": cells,
        "cells_least": LEAST_CELLS,
        "points": points,
        "points_least": LEAST_POINTS,
    }
    if cells >= LEAST_CELLS and points >= LEAST_POINTS:
        return Finding(
            "off",
            figures,
            f"Sparse points suffice: {points:.0f} a photograph ({LEAST_POINTS} at least) in {cells:.0%} of its cells "
            f"({LEAST_CELLS:.0%} at least).",
        )
    few = (
        f"Sparse points are few: {points:.0f} a photograph ({LEAST_POINTS} would do) in {cells:.0%} of its cells "
        f"({LEAST_CELLS:.0%} would do)"
    )
    if accepted is None:
        return Finding("unknown", figures, f"{few}; a depth network would have to be named.")
    figures |= {"accepted": accepted, "accepted_least": LEAST_ACCEPTED}
    return Finding(
        "on" if accepted >= LEAST_ACCEPTED else "off",
        figures,
        f"{few}; predicted depth fits them in {accepted:.0%} of the photographs ({LEAST_ACCEPTED:.0%} at least).",
    )


def _cells(images: Sequence[TrainingImage], scene: Scene) -> np.ndarray:
    """Sparse points in each of CELLS x CELLS cells of each photograph, (V, CELLS, CELLS)."""
    seen = {view.name: view.point_indices for view in scene.views}
    counts = []
    for image in images:
        camera = image.camera
        places = scene.points.positions[seen[camera.name]] @ camera.world_to_camera[:3, :3].T
        places = (places + camera.world_to_camera[:3, 3]) @ camera.K.T
        x, y = (places[places[:, 2] > 0, :2] / places[places[:, 2] > 0, 2:]).T
        box = [[0, camera.height], [0, camera.width]]
        counts.append(np.histogram2d(y, x, bins=CELLS, range=box)[0])
    return np.stack(counts)


def _empty_and_flat(images: Sequence[TrainingImage], scene: Scene) -> np.ndarray:
    """Cells (V, CELLS, CELLS) that have no point in or beside them, and no contrast."""
    counts = _cells(images, scene)
    flat = []
    for image in images:
        grey = cv2.GaussianBlur(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1)
        rough = cv2.absdiff(grey, cv2.GaussianBlur(grey, (0, 0), 4))
        flat.append(cv2.resize(rough, (CELLS, CELLS), interpolation=cv2.INTER_AREA) < FLAT)
    beside = np.stack([cv2.dilate(count, np.ones((3, 3))) for count in counts])
    return (beside == 0) & np.stack(flat)
