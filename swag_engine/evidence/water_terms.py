"""The terms of the image formation that observations of a scene call for: camera, lamp, background light, attenuation.

Each stage compares families of the fit (fit.py) by the Bayesian information criterion (BIC), with the terms that the
stages before it have found. The decisions of the effects (effects/) read the figures and say them in words.
Thresholds were measured on the scenes of benchmarks/effects_matrix.py and on real ones (docs/effects.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .fit import MOST_FITTED, Family, Fit, WeightedObservations, independent_channels, lens_terms
from .observations import LEAST_BACKGROUND_LIGHT, LEAST_CHANGE, Observations, track_ratio

CHANNELS = ("red", "green", "blue")
NEAR_QUANTILE = 0.05
"""Quantile of the ranges that counts as the near end of a scene."""
FAR_QUANTILE = 0.95
"""Quantile of the ranges that counts as the far end, and of the range ratios of points."""
LEAST_BIC_GAIN = 10.0
"""BIC gain from which a term counts where nothing else is asked of it."""

# Exposure and lens
LEAST_GAIN_SD = 0.045
"""Standard deviation of the log gains of the images: waves and phone processing look like gains of 3 %."""
LEAST_GAIN_BIC = 100.0
"""BIC gain of the gains: waves and phone processing gain some tens by them, and gains of backscatter are as good there
where water scatters the sun's light."""
LEAST_LENS = 0.05
"""Log ratio of the brightest and the darkest place of an image from which the lens or a beam is modelled."""

# Lamp
LEAST_FALLOFF = 0.15
"""Fraction of its light that a lamp must lose over the scene's range beyond what the water takes."""
LEAST_LAMP_BIC = 30.0
"""BIC gain of a lamp whose light falls off nearly as the inverse square: changing room light can look like a lamp."""
SURE_LAMP_BIC = 1000.0
"""BIC gain of a lamp whose light falls off less than that."""
LEAST_LAMP_SHARE = 0.78
"""Fall-off as a fraction of that of the inverse square from which LEAST_LAMP_BIC suffices."""
LAMP_ERROR = 0.3
"""Fraction of a lamp's fall-off that its formula may be wrong by: water under a lamp must take so much more."""
GREY = 0.2
"""Relative difference of beta_D between channels below which the loss has no color; water has one."""

# Water
LEAST_COLOR = 0.2
"""Fraction by which one color must fade beside another."""
SURE_COLOR = 0.08
"""Lower 95 % bound of that fraction."""
LEAST_WATER_BIC = 50.0
"""BIC gain of attenuation: shine, blur and phone processing take from some surfaces only."""
SURE_BIC = 400.0
"""BIC gains of attenuation and of the background light that suffice without sure colors, where the darkest light
rises with range too."""
WIDEST_INTERVAL = 0.5
"""Half of the 95 % interval of the largest beta_D, as a fraction of it."""
HALVES = 12
"""Random halves of the scene from which intervals are estimated."""
HALF_STEPS = 10
"""Gauss-Newton steps of the fit to a half."""
LEAST_DARK_RISE = 0.27
"""Rise of the darkest light with range, as a fraction of the rise that the fitted backscatter predicts."""
LEAST_DARK = 0.003
"""Rise of the darkest light with range, linear light."""
DARKEST = 0.01
"""Quantile of light that counts as the darkest."""
RANGE_BINS = 8
"""Bins of range in which the darkest light is taken."""


@dataclass(frozen=True)
class CameraTerms:
    """Gains of the images, and the fall-off of light over each image.

    Attributes:
        gains: Whether the images differ in exposure.
        gain_sd: Standard deviation of their log gains, without that of their errors.
        gain_bic: BIC gain by gains.
        over_backscatter: Whether that is counted over gains of backscatter alone, as the sun's direction changes it,
            because these explain more than no gains do and the darkest light rises with range. They are only tried
            where gains would count.
        lens: Whether light differs over each image.
        lens_bic: BIC gain by that.
        lens_fit: Fit of all terms with the lens.
    """

    gains: bool
    gain_sd: float
    gain_bic: float
    over_backscatter: bool
    lens: bool
    lens_bic: float
    lens_fit: Fit

    @property
    def unevenness(self) -> float:
        """Log ratio of the brightest and the darkest of an image's centre, edges and corners."""
        places = np.stack(np.meshgrid([-0.8, 0, 0.8], [-0.6, 0, 0.6]), -1).reshape(-1, 2)
        return float(np.ptp(lens_terms(places) @ self.lens_fit.lens))


@dataclass(frozen=True)
class LampTerm:
    """Light that falls off from the camera.

    Attributes:
        found: Whether a lamp explains the colors better than water alone.
        tied: Whether it explains them as well.
        bic_gain: BIC gain by the lamp.
        bic_needed: BIC gain that is needed.
        falloff: Fraction of light lost over the scene's range.
        inverse_square: That fraction over the one of the inverse square.
        grey: Relative difference of the loss between channels.
        colorless: Whether the loss without a lamp has no color.
        beta_D: (3,) attenuation that goes with the lamp, per unit of the ranges.
    """

    found: bool
    tied: bool
    bic_gain: float
    bic_needed: float
    falloff: float
    inverse_square: float
    grey: float
    colorless: bool
    beta_D: np.ndarray


@dataclass(frozen=True)
class LampFamily:
    """What is known of attenuation under a lamp: lamp and water both take light with range and can replace each other.

    Attributes:
        loss: (3,) fraction of light that lamp and water take together between the near and the far end.
        beta_error: Error of beta_D, the same in all channels, per unit of the ranges. It is what LAMP_ERROR of the
            lamp's fall-off takes, so that it is smaller where the ranges differ more.
    """

    loss: np.ndarray
    beta_error: float


@dataclass(frozen=True)
class WaterTerm:
    """Attenuation and backscatter.

    Attributes:
        adds_light: Whether the observations show background light.
        background: (3,) light that the water adds at the far end of the scene.
        background_bic: BIC gain by it.
        dark_rise: Rise of the darkest light with range, beyond what a lamp's fall-off leaves of that at the near end.
        dark_rise_needed: Rise that is needed.
        loses: Whether light is lost with range.
        attenuates: Whether that loss is water's.
        change: (3,) fraction of light lost between the near and the far end.
        change_needed: Fraction that is needed.
        bic_gain: BIC gain by attenuation.
        color: Fraction by which one color fades beside another.
        sure_color: Lower 95 % bound of it.
        grey: Relative difference of beta_D between channels.
        colored: Whether it is certain that the loss has a color.
        sure: Whether background light and BIC alone show the water.
        strongest: Channel that loses most.
        interval: Half of the 95 % interval of its beta_D, as a fraction of it; NaN without attenuation.
        resolution: Error with which a loss of LEAST_CHANGE would be known.
    """

    adds_light: bool
    background: np.ndarray
    background_bic: float
    dark_rise: float
    dark_rise_needed: float
    loses: bool
    attenuates: bool
    change: np.ndarray
    change_needed: float
    bic_gain: float
    color: float
    sure_color: float
    grey: float
    colored: bool
    sure: bool
    strongest: int
    interval: float
    resolution: float

    @property
    def backscatters(self) -> bool:
        """Whether the water adds light: without attenuation that is no water."""
        return self.adds_light and self.attenuates

    @property
    def channel(self) -> str:
        """Name of the channel that loses most."""
        return CHANNELS[self.strongest]


@dataclass
class WaterTerms:
    """What the observations of a scene call for.

    Attributes:
        range_ratio: Farthest over nearest range of a point, its FAR_QUANTILE over the points.
        radius_correlation: Correlation of range with the distance from the image centre, absolute.
        camera: Exposure and lens.
        lamp: A lamp at the camera.
        water: Attenuation and backscatter.
        tied: Fit in which backscatter has the coefficient of attenuation.
        separate: Fit in which it has its own.
        separate_bic: BIC gain by a coefficient of its own.
        fit: Values of the family that was chosen.
        images: Images that the fit's gains are of, by index.
        lamp_family: What is known of attenuation under a lamp; None without either.
        intervals: 95 % bounds (2, 3) of beta_D, beta_B and B; empty without attenuation. Those of beta_D have the error
            of the lamp family added.
    """

    range_ratio: float
    radius_correlation: float
    camera: CameraTerms
    lamp: LampTerm
    water: WaterTerm
    tied: Fit
    separate: Fit
    separate_bic: float
    fit: Fit
    images: Sequence[int]
    lamp_family: LampFamily | None = None
    intervals: dict[str, np.ndarray] = field(default_factory=dict)


def find_water_terms(observations: Observations, open_water: np.ndarray | None = None, seed: int = 0) -> WaterTerms:
    """Find the terms that observations call for.

    Args:
        observations: At least LEAST_OBSERVATIONS of them.
        open_water: (3,) linear light where the images show nothing but water; None where they do not.
        seed: Seed of the points and halves that are drawn.

    Returns:
        The terms.
    """
    random = np.random.default_rng(seed)
    ratio = float(np.quantile(track_ratio(observations), FAR_QUANTILE))
    correlation = float(abs(np.corrcoef(observations.ranges, observations.radius)[0, 1]))
    points = random.permutation(np.unique(observations.track))
    most = max(2, int(len(points) * MOST_FITTED / len(observations)))
    weighted = WeightedObservations(
        observations.take(np.isin(observations.track, points[:most])), open_water=open_water
    )
    rich = Family(attenuation=True, backscatter=True, separate=True, lamp=True, lens=True, gains=True)
    first = weighted.fit(rich)
    comparison = _Comparison(observations, weighted.without_outliers(first), independent_channels(first.residual))
    camera = comparison.camera_terms(rich)
    fits = comparison.water_families(camera)
    widest = Family(True, True, True, lens=camera.lens, gains=camera.gains)
    dark = {lit: comparison.dark_rise(fits[replace(widest, lamp=lit)]) for lit in (False, True)}
    may_add_light = any(each.rises for each in dark.values())
    lamp = comparison.lamp_term([fit for family, fit in fits.items() if may_add_light or not family.backscatter])
    none, direct, tied, separate = (fit for family, fit in fits.items() if family.lamp == lamp.found)
    water, fit, intervals = comparison.water_term(none, direct, tied, separate, lamp, dark[lamp.found], random)
    images = np.unique(comparison.weighted.observations.image).tolist()
    separate_bic = comparison.bic(tied) - comparison.bic(separate)
    family = comparison.lamp_family(fit)
    if family:
        intervals["beta_D"] = (intervals["beta_D"] + family.beta_error * np.array([[-1.0], [1.0]])).clip(min=0)
    return WaterTerms(
        ratio, correlation, camera, lamp, water, tied, separate, separate_bic, fit, images, family, intervals
    )


@dataclass(frozen=True)
class _DarkRise:
    """Rise of the darkest light with range in the channel where backscatter should raise it most.

    Under a lamp near surfaces are lit and far ones are not: the rise is counted from what is left of the darkest near
    light at the far end.
    """

    rise: float
    needed: float

    @property
    def rises(self) -> bool:
        return self.rise >= self.needed


class _Comparison:
    """Families of terms fitted to the same observations."""

    def __init__(self, observations: Observations, weighted: WeightedObservations, independent: float) -> None:
        self.observations, self.weighted, self.independent = observations, weighted, independent
        self.near, self.far = np.quantile(observations.ranges, (NEAR_QUANTILE, FAR_QUANTILE))

    def bic(self, fit: Fit) -> float:
        return fit.bic(self.weighted.count, self.independent)

    def camera_terms(self, rich: Family) -> CameraTerms:
        """Gains and lens are found with every other term in the model, so that neither can stand for water."""
        bic = self.bic
        apart = {
            (lens, gains): self.weighted.fit(replace(rich, lens=lens, gains=gains))
            for lens in (False, True)
            for gains in (False, True)
        }
        gained = min((fit for (_, gains), fit in apart.items() if gains), key=bic)
        plain = min((fit for (_, gains), fit in apart.items() if not gains), key=bic)
        gain_sd, gain_bic, over_backscatter = _gain_sd(gained), bic(plain) - bic(gained), False
        if gain_bic > LEAST_GAIN_BIC and gain_sd > LEAST_GAIN_SD:
            sunlit = self.weighted.fit(replace(gained.family, gains=False, backscatter_gains=True))
            over_backscatter = bic(sunlit) < bic(plain) and self.dark_rise(sunlit).rises
            if over_backscatter:
                gain_bic = bic(sunlit) - bic(gained)
        gains = gain_bic > LEAST_GAIN_BIC and gain_sd > LEAST_GAIN_SD
        lens_bic = bic(apart[False, gains]) - bic(apart[True, gains])
        terms = CameraTerms(gains, gain_sd, gain_bic, over_backscatter, True, lens_bic, apart[True, gains])
        return replace(terms, lens=lens_bic > LEAST_BIC_GAIN and terms.unevenness > LEAST_LENS)

    def water_families(self, camera: CameraTerms) -> dict[Family, Fit]:
        """No water, attenuation, backscatter tied and separate, each without and with a lamp."""
        return {
            family: self.weighted.fit(family)
            for lamp in (False, True)
            for family in (
                Family(lamp=lamp, lens=camera.lens, gains=camera.gains),
                Family(True, lamp=lamp, lens=camera.lens, gains=camera.gains),
                Family(True, True, lamp=lamp, lens=camera.lens, gains=camera.gains),
                Family(True, True, True, lamp=lamp, lens=camera.lens, gains=camera.gains),
            )
        }

    def dark_rise(self, fit: Fit) -> _DarkRise:
        """Colors that grow alike with range, as where far texture is blurred, look like backscatter without it."""
        left = (fit.tau + self.near**2) / (fit.tau + self.far**2) if fit.family.lamp else 1.0
        near, far = dark_ends(self.observations)
        near_light, far_light = (fit.B * -np.expm1(-fit.beta_B * end) for end in (self.near, self.far))
        expected = far_light - left * near_light
        channel = int(np.argmax(expected))
        needed = max(LEAST_DARK_RISE * expected[channel], LEAST_DARK)
        return _DarkRise(float((far - left * near)[channel]), float(needed))

    def lamp_term(self, fits: Sequence[Fit]) -> LampTerm:
        """A lamp where light falls off as 1 / (tau + r^2) beyond what water takes, or where the loss has no color."""
        bic, near, far = self.bic, self.near, self.far
        ambient = min((fit for fit in fits if not fit.family.lamp), key=bic)
        lit = min((fit for fit in fits if fit.family.lamp), key=bic)
        gain = bic(ambient) - bic(lit)
        loss = 1 - np.exp(-ambient.beta_D * (far - near))
        grey = _grey(ambient) if ambient.family.attenuation else 1.0
        even, falling = (
            next(fit for fit in fits if fit.family == Family(lamp=lamp, lens=lit.family.lens, gains=lit.family.gains))
            for lamp in (False, True)
        )
        colorless = grey < GREY and loss.max() >= LEAST_FALLOFF and bic(even) - bic(falling) > LEAST_BIC_GAIN
        if colorless:  # then water is no alternative, and the lamp is weighed against even light
            lit, gain = falling, bic(even) - bic(falling)
        falloff = 1 - (lit.tau + near**2) / (lit.tau + far**2)
        fraction = falloff / max(1 - (near / far) ** 2, 1e-12)
        needed = LEAST_LAMP_BIC if fraction >= LEAST_LAMP_SHARE else SURE_LAMP_BIC
        enough = falloff >= LEAST_FALLOFF
        return LampTerm(
            found=bool(enough and gain > needed),
            tied=bool(enough and gain > -LEAST_BIC_GAIN),
            bic_gain=gain,
            bic_needed=needed,
            falloff=float(falloff),
            inverse_square=float(fraction),
            grey=grey,
            colorless=bool(colorless),
            beta_D=lit.beta_D,
        )

    def lamp_family(self, fit: Fit) -> LampFamily | None:
        """What is known of the attenuation of a fit under a lamp; None where it has not both."""
        if not (fit.family.lamp and fit.family.attenuation):
            return None
        near, far = self.near, self.far
        lamp = float(np.log((fit.tau + far**2) / (fit.tau + near**2)))
        return LampFamily(
            loss=-np.expm1(-fit.beta_D * (far - near) - lamp),
            beta_error=LAMP_ERROR * lamp / float(far - near),
        )

    def water_term(
        self,
        none: Fit,
        direct: Fit,
        tied: Fit,
        separate: Fit,
        lamp: LampTerm,
        dark: _DarkRise,
        random: np.random.Generator,
    ) -> tuple[WaterTerm, Fit, dict[str, np.ndarray]]:
        """Attenuation and backscatter, the fit that was chosen, and its intervals."""
        bic, weighted, span = self.bic, self.weighted, self.far - self.near
        background = separate.B * (1 - np.exp(-separate.beta_B * self.far))
        background_bic = bic(direct) - min(bic(tied), bic(separate))
        adds_light = bool(dark.rises and background_bic > LEAST_BIC_GAIN and background.max() >= LEAST_BACKGROUND_LIGHT)

        best = min((direct, tied, separate) if adds_light else (direct,), key=bic)
        change = 1 - np.exp(-best.beta_D * span)
        strongest, weakest = int(np.argmax(change)), int(np.argmin(change))
        bic_gain = bic(none) - bic(best)
        change_needed = LEAST_CHANGE + (LAMP_ERROR * lamp.falloff if lamp.found or lamp.tied else 0.0)
        loses = bool(bic_gain > LEAST_BIC_GAIN and change.max() >= LEAST_CHANGE)

        def halves_of(fit: Fit) -> list[Fit]:
            return [weighted.half(random).fit(fit.family, fit, steps=HALF_STEPS) for _ in range(HALVES)]

        halves = halves_of(best) if loses else []
        fades = [float(-np.expm1((fit.beta_D[weakest] - fit.beta_D[strongest]) * span)) for fit in (best, *halves)]
        color = abs(fades[0]) if loses else 0.0  # abs: no minus sign before zero
        sure_color = color - 1.96 * float(np.std(fades[1:], ddof=1)) if loses else 0.0
        grey = float(1 - best.beta_D[weakest] / max(best.beta_D[strongest], 1e-12))
        colored = bool(
            grey >= GREY and color >= LEAST_COLOR and sure_color >= SURE_COLOR and bic_gain > LEAST_WATER_BIC
        )
        sure = bool(adds_light and min(background_bic, bic_gain) > SURE_BIC)
        attenuates = bool(loses and change.max() >= change_needed and (colored or sure))
        # The coefficients are those of the widest family that was accepted: what need not be separate is nearly tied.
        fit = separate if adds_light and attenuates else direct if attenuates else none
        if attenuates and fit.family != best.family:
            halves = halves_of(fit)
        intervals = _intervals(fit, halves) if attenuates else {}
        interval = float("nan")
        if attenuates:
            interval = float(np.ptp(intervals["beta_D"], axis=0)[strongest] / 2 / fit.beta_D[strongest])
        term = WaterTerm(
            adds_light=adds_light,
            background=background,
            background_bic=background_bic,
            dark_rise=dark.rise,
            dark_rise_needed=dark.needed,
            loses=loses,
            attenuates=attenuates,
            change=change,
            change_needed=change_needed,
            bic_gain=bic_gain,
            color=color,
            sure_color=sure_color,
            grey=grey,
            colored=colored,
            sure=sure,
            strongest=strongest,
            interval=interval,
            resolution=float(weighted.resolution(none, span, LEAST_CHANGE).max()),
        )
        return term, fit, intervals


def _grey(fit: Fit) -> float:
    return float(1 - fit.beta_D.min() / max(fit.beta_D.max(), 1e-12))


def _gain_sd(fit: Fit) -> float:
    """Standard deviation of the log gains without that of their errors.

    Straight survey lines cannot distinguish gains that rise from one image to the next from a lens that is brighter on
    one side: directions that are not known do not count.
    """
    squared_errors, directions = np.linalg.eigh(fit.gain_covariance)
    known = squared_errors < LEAST_GAIN_SD**2
    variance = (directions.T @ fit.log_gains)[known] ** 2 - squared_errors[known]
    return float(np.sqrt(max(variance.sum() / max(known.sum() - 1, 1), 0)))


def _intervals(fit: Fit, halves: Sequence[Fit]) -> dict[str, np.ndarray]:
    """95 % bounds (2, 3): the spread over halves drawn without replacement is that of the whole."""
    bounds = {}
    for name in ("beta_D", "beta_B", "B"):
        value = getattr(fit, name)
        sd = np.std([getattr(half, name) for half in halves], axis=0, ddof=1)
        bounds[name] = np.stack([np.maximum(value - 1.96 * sd, 0), value + 1.96 * sd])
    return bounds


def dark_ends(observations: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Measure the darkest light around the points at the near and at the far end of the ranges.

    Args:
        observations: Observations of the scene.

    Returns:
        (3,) linear light at the near end, and at the far end.
    """
    edges = np.quantile(observations.ranges, np.linspace(0, 1, RANGE_BINS + 1))
    bins = np.clip(np.searchsorted(edges, observations.ranges) - 1, 0, RANGE_BINS - 1)
    dark = np.stack([np.quantile(observations.darkest[bins == k], DARKEST, axis=0) for k in np.unique(bins)])
    return dark[:2].mean(0), dark[-2:].mean(0)
