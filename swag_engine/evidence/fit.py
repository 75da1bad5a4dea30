"""Fits of water, lamp and exposure to observations of sparse points: families of terms, with their certainty.

A point seen from several ranges changes color by the water between. Per channel, in linear light,

    I = g [ J L(r) exp(-beta_D r) + B (1 - exp(-beta_B r)) ],   L(r) = (tau + r_bar^2) / (tau + r^2) with a lamp, else 1

with a J for every point, and a gain g for every image that varies over it as the lens or the beam of a lamp does. J is
projected out (variable projection, Golub and Pereyra 1973); the rest is searched on a grid and then refined by damped
Gauss-Newton steps. Families of fewer terms are compared by the Bayesian information criterion.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from .observations import LEAST_BACKGROUND_LIGHT, Observations

OPEN_WATER_SD = 0.2
"""Relative standard deviation of B from the light of what looks like open water."""
MOST_FITTED = 6_000
"""Observations that are fitted; more do not reduce the errors, which are no noise then."""
USUAL_ERROR = 0.1
"""Relative error of a color until a fit has shown it; weighs the priors."""
SEPARATION = 0.5
"""Usual log ratio of beta_B and beta_D (Akkaynak and Treibitz 2018); only a long range shows it."""
GRID = np.geomspace(0.03, 4.0, 9)
"""Coefficients times the median range from which the search starts."""
LAMP_GRID = (0.1, 1.0, 10.0)
"""tau over the squared median range, likewise."""
COEFFICIENTS = np.log((1e-3, 8.0))
"""Bounds of the log of coefficients times the median range."""
LAMPS = np.log((0.01, 1000.0))
"""Bounds of the log of tau over the squared median range."""
LENS = slice(10, 15)
"""Place of the lens among the parameters of a fit."""
GAINS = 15
"""Place of the first log gain among the parameters of a fit."""
PRIOR_SD = 2.0
"""Standard deviation of log gains and lens terms: wide enough to decide only what the images leave open."""


# Families of models ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Family:
    """Which terms of the formula a fit has.

    Attributes:
        attenuation: Light is lost with range.
        backscatter: Light is added with range.
        separate: beta_B is not beta_D.
        lamp: Light falls off from the camera.
        lens: Light varies over each image.
        gains: Light varies from image to image.
        backscatter_gains: Backscatter alone does so, instead: water scatters more of the sun's light when it is seen
            against the sun.
    """

    attenuation: bool = False
    backscatter: bool = False
    separate: bool = False
    lamp: bool = False
    lens: bool = False
    gains: bool = False
    backscatter_gains: bool = False

    @property
    def varies(self) -> bool:
        """Whether something varies from image to image."""
        return self.gains or self.backscatter_gains


@dataclass(frozen=True)
class Fit:
    """The values of a family that explain observations best.

    Attributes:
        family: Its terms.
        beta_D: (3,) per unit of the ranges.
        beta_B: (3,) per unit of the ranges.
        B: (3,) linear light.
        tau: In squared units; infinite without a lamp.
        log_gains: (V,) of the images or of their backscatter, mean 0.
        gain_covariance: (V, V) of the log gains.
        lens: (5,) coefficients of lens_terms.
        squares: (3,) mean squared weighted residual.
        residual: (M, 3) weighted residual.
    """

    family: Family
    beta_D: np.ndarray
    beta_B: np.ndarray
    B: np.ndarray
    tau: float
    log_gains: np.ndarray
    gain_covariance: np.ndarray
    lens: np.ndarray
    squares: np.ndarray
    residual: np.ndarray

    @property
    def parameters(self) -> int:
        """Number of free parameters."""
        family = self.family
        return (
            3 * (family.attenuation + family.backscatter + family.separate)
            + family.lamp
            + len(self.lens) * family.lens
            + family.varies * (len(self.log_gains) - 1)
        )

    def bic(self, count: float, independent: float = 3.0) -> float:
        """Return the Bayesian information criterion for `count` independent observations of `independent` channels."""
        return float(count * independent / 3 * np.log(self.squares).sum() + self.parameters * np.log(count))


class WeightedObservations:
    """Observations prepared for fits: points and images numbered without gaps, ranges over their median `unit`.

    Args:
        observations: The observations.
        weights: (M, 3) make residuals relative to the channel's mean light; the same for all families.
        noise: Expected mean squared residual.
        open_water: (3,) light that B is expected to be near, None without.
    """

    def __init__(
        self,
        observations: Observations,
        weights: np.ndarray | None = None,
        noise: float = USUAL_ERROR**2,
        open_water: np.ndarray | None = None,
    ) -> None:
        self.observations, self.noise, self.open_water = observations, noise, open_water
        _, self.track = np.unique(observations.track, return_inverse=True)
        _, self.image = np.unique(observations.image, return_inverse=True)
        self.views = int(self.image.max()) + 1
        self.unit = float(np.median(observations.ranges))
        self.r = observations.ranges / self.unit
        self.terms = lens_terms(observations.place)
        self.light = observations.light
        counts = np.bincount(self.track)
        self.weights = np.ones_like(self.light) / self.light.mean(0) ** 2 if weights is None else weights
        self.count = float(np.sum(counts - 1))
        rows = np.arange(len(self.track))
        self.sums = csr_matrix((np.ones(len(rows)), (self.track, rows)))
        self.by_image = csr_matrix((np.ones(len(rows)), (self.image, rows)))

    def without_outliers(self, fit: Fit) -> "WeightedObservations":
        """Drop the tenth of the points that `fit` explains worst, and weigh single outliers less."""
        size = np.sqrt((fit.residual**2).mean(1))
        mean = np.bincount(self.track, size**2) / np.bincount(self.track)
        good = (mean <= np.quantile(mean, 0.9))[self.track]
        usual = 2.5 * np.median(size[good])
        huber = np.minimum(1, usual / np.maximum(size[good], 1e-12))
        weights, noise = self.weights[good] * huber[:, None], float(fit.squares.mean())
        return WeightedObservations(self.observations.take(good), weights, noise, self.open_water)

    def half(self, random: np.random.Generator) -> "WeightedObservations":
        """Draw a random half of the blocks of points.

        A block is what is seen first in the same third of the images and the same quarter of the image: what is wrong
        with one surface (shine, blur) is wrong with all of its points.
        """
        _, first = np.unique(self.track, return_index=True)
        third = self.image[first] * 3 // self.views
        blocks = third * 4 + (self.observations.place[first] > 0) @ [1, 2]
        order = random.permutation(np.unique(blocks))
        chosen = np.isin(blocks, order[: max(len(order) // 2, 1)])[self.track]
        return WeightedObservations(self.observations.take(chosen), self.weights[chosen], self.noise, self.open_water)

    # -- one family ---------------------------------------------------------------------------------------------------

    def fit(self, family: Family, start: Fit | None = None, steps: int = 25) -> Fit:
        """Fit a family by least squares.

        Args:
            family: Its terms.
            start: Fit to start from; a grid without it.
            steps: Gauss-Newton steps at most.

        Returns:
            The fit.
        """
        values = self._start(family) if start is None else self._from(family, start)
        damping = 1e-3
        cost, gradient, curvature = self._linearised(family, values)
        for _ in range(steps):
            step = self._step(family, values, gradient, curvature, damping)
            tried = self._bounded(family, values + step)
            new_cost, new_gradient, new_curvature = self._linearised(family, tried)
            if new_cost < cost:
                converged = cost - new_cost < 1e-5 * cost
                values, cost, gradient, curvature = tried, new_cost, new_gradient, new_curvature
                damping = max(damping / 5, 1e-9)
                if converged:
                    break
            else:
                damping *= 8
                if damping > 1e6:
                    break
        return self._result(family, values, curvature)

    # Parameters, in this order: log beta_D (3), log beta_B (3), B (3), log tau, lens (5), log gains (views). Ranges are
    # in medians, so the first ten have size about 1. Parameters that a family does not have stay.

    def _free(self, family: Family) -> np.ndarray:
        return np.concatenate(
            [
                np.full(3, family.attenuation),
                np.full(3, family.separate),
                np.full(3, family.backscatter),
                [family.lamp],
                np.full(5, family.lens),
                np.full(self.views, family.varies),
            ]
        )

    def _bounded(self, family: Family, values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[:6] = np.clip(values[:6], *COEFFICIENTS)
        values[6:9] = np.clip(values[6:9], 0, 1)
        values[9] = np.clip(values[9], *LAMPS)
        values[GAINS:] -= values[GAINS:].mean()
        if not family.separate:
            values[3:6] = values[:3]
        return values

    def _step(
        self, family: Family, values: np.ndarray, gradient: np.ndarray, curvature: np.ndarray, damping: float
    ) -> np.ndarray:
        free = self._free(family)
        # What lies at a bound and would go beyond it stays there.
        free[6:9] &= (values[6:9] > 0) | (gradient[6:9] < 0)
        index = np.flatnonzero(free)
        matrix = curvature[np.ix_(index, index)]
        matrix = matrix + np.diag(damping * np.diag(matrix) + 1e-12)
        step = np.zeros_like(values)
        step[index] = -np.linalg.solve(matrix, gradient[index])
        step[:6] = np.clip(step[:6], -1.5, 1.5)
        step[9] = np.clip(step[9], -1.5, 1.5)
        return step

    def _factors(self, family: Family, values: np.ndarray, c: int) -> tuple[np.ndarray, ...]:
        """Of channel c: gain, transmission with the lamp, gain of backscatter, backscatter without B, all (M,)."""
        lens, varying = self.terms @ values[LENS], values[GAINS:][self.image]
        backscatter_gain = np.exp(lens + varying)
        gain = np.exp(lens) if family.backscatter_gains else backscatter_gain
        direct = np.exp(-np.exp(values[c]) * self.r) if family.attenuation else np.ones_like(self.r)
        if family.lamp:
            tau = np.exp(values[9])
            direct = direct * (tau + 1) / (tau + self.r**2)
        scattered = -np.expm1(-np.exp(values[3 + c]) * self.r) if family.backscatter else np.zeros_like(self.r)
        return gain, direct, backscatter_gain, scattered

    def _solved(self, family: Family, values: np.ndarray, c: int) -> tuple[np.ndarray, ...]:
        """Solve for each point's J in channel c.

        Returns J's factor, the gain of backscatter, backscatter without B, J, the residual, and per point the weighted
        square of J's factor.

        No J is negative. In dense water, where backscatter is nearly all of the light, this keeps the background light
        from being overestimated.
        """
        gain, direct, backscatter_gain, scattered = self._factors(family, values, c)
        a, weight = gain * direct, self.weights[:, c]
        square = np.bincount(self.track, weight * a * a)
        rest = self.light[:, c] - backscatter_gain * values[6 + c] * scattered
        J = (np.bincount(self.track, weight * a * rest) / square).clip(min=0)
        return gain * direct, backscatter_gain, scattered, J, rest - a * J[self.track], square

    def _linearised(self, family: Family, values: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost (half the sum of squares), its gradient and the Gauss-Newton curvature, over all parameters."""
        size = len(values)
        cost, gradient, curvature = 0.0, np.zeros(size), np.zeros((size, size))
        for c in range(3):
            a, backscatter_gain, scattered, J_of_point, residual, square = self._solved(family, values, c)
            weight, B, J = self.weights[:, c], values[6 + c], J_of_point[self.track]
            added = backscatter_gain * B * scattered
            seen = a * J + added
            columns, places = [], []
            if family.attenuation:
                change = -a * J * np.exp(values[c]) * self.r
                if family.backscatter and not family.separate:
                    change = change + backscatter_gain * B * np.exp(values[c]) * self.r * (1 - scattered)
                columns.append(change)
                places.append(c)
            if family.separate:
                columns.append(backscatter_gain * B * np.exp(values[3 + c]) * self.r * (1 - scattered))
                places.append(3 + c)
            if family.backscatter:
                columns.append(backscatter_gain * scattered)
                places.append(6 + c)
            if family.lamp:
                tau = np.exp(values[9])
                columns.append(a * J * tau * (self.r**2 - 1) / ((tau + 1) * (tau + self.r**2)))
                places.append(9)
            if family.lens:
                columns += list((seen[:, None] * self.terms).T)
                places += range(10, GAINS)
            # Project out of each column what a change of J can explain, where J is free to change. The
            # residual has no such part: J is the best one.
            changes, weighted = np.array(columns).reshape(len(columns), len(seen)), weight * a
            along, free = self.sums @ (weighted * changes).T, (J_of_point > 0) / square
            cost += 0.5 * float(weight @ residual**2)
            gradient[places] += changes @ (-weight * residual)
            curvature[np.ix_(places, places)] += (weight * changes) @ changes.T - along.T @ (free[:, None] * along)
            if family.varies:  # their columns have a number for each observation of the image alone
                varying = added if family.backscatter_gains else seen
                own = csr_matrix((weighted * varying, (self.track, self.image)), (len(square), self.views))
                together = self.by_image @ (weight * varying * changes).T - own.T @ (free[:, None] * along)
                gradient[GAINS:] -= self.by_image @ (weight * varying * residual)
                curvature[np.ix_(range(GAINS, size), places)] += together
                curvature[np.ix_(places, range(GAINS, size))] += together.T
                curvature[GAINS:, GAINS:] -= (own.T @ own.multiply(free[:, None])).toarray()
                curvature[np.arange(GAINS, size), np.arange(GAINS, size)] += self.by_image @ (weight * varying**2)
        prior = self.noise / PRIOR_SD**2
        cost += 0.5 * prior * float(np.sum(values[10:] ** 2))
        gradient[10:] += prior * values[10:]
        curvature[np.arange(10, size), np.arange(10, size)] += prior
        if family.separate:
            prior = self.noise / SEPARATION**2
            apart = values[3:6] - values[:3]
            cost += 0.5 * prior * float(apart @ apart)
            gradient[:6] += prior * np.concatenate([-apart, apart])
            curvature[:6, :6] += prior * np.kron([[1, -1], [-1, 1]], np.eye(3))
        if family.backscatter and self.open_water is not None:
            priors = self.noise / (OPEN_WATER_SD * np.maximum(self.open_water, LEAST_BACKGROUND_LIGHT)) ** 2
            off = values[6:9] - self.open_water
            cost += 0.5 * float(priors @ off**2)
            gradient[6:9] += priors * off
            curvature[6:9, 6:9] += np.diag(priors)
        return cost, gradient, curvature

    def _start(self, family: Family) -> np.ndarray:
        """Of a grid: one coefficient a channel, B in closed form, and for all channels one tau."""
        best, lowest = np.zeros(GAINS + self.views), np.inf
        best[:6] = COEFFICIENTS[0]
        for tau in LAMP_GRID if family.lamp else (1.0,):
            values, total = best.copy(), 0.0
            values[6:] = 0
            values[9] = np.log(tau)
            for c in range(3):
                lowest_here = np.inf
                chosen = (COEFFICIENTS[0], 0.0)
                for beta in np.log(GRID) if family.attenuation else (COEFFICIENTS[0],):
                    values[c] = values[3 + c] = beta
                    values[6 + c] = 0
                    direct, _, scattered, _, residual, square = self._solved(family, values, c)
                    B, weight = 0.0, self.weights[:, c]
                    if family.backscatter:
                        own = (
                            scattered
                            - direct * (np.bincount(self.track, weight * direct * scattered) / square)[self.track]
                        )
                        B = float(np.clip((weight * own) @ residual / max((weight * own) @ own, 1e-12), 0, 1))
                        residual = residual - B * own
                    loss = float(weight @ residual**2)
                    if loss < lowest_here:
                        lowest_here, chosen = loss, (beta, B)
                values[c] = values[3 + c] = chosen[0]
                values[6 + c] = chosen[1]
                total += lowest_here
            if total < lowest:
                best, lowest = values, total
        return best

    def _from(self, family: Family, start: Fit) -> np.ndarray:
        values = np.zeros(GAINS + self.views)
        with np.errstate(divide="ignore"):
            values[:3], values[3:6] = np.log(start.beta_D * self.unit), np.log(start.beta_B * self.unit)
        values[6:9] = start.B if family.backscatter else 0
        values[9] = np.log(start.tau / self.unit**2) if np.isfinite(start.tau) else 0.0
        values[LENS] = start.lens
        if family.varies and len(start.log_gains) == self.views:
            values[GAINS:] = start.log_gains
        return self._bounded(family, values)

    def resolution(self, fit: Fit, span: float, change: float) -> np.ndarray:
        """Estimate how well an attenuation would be known beside the terms of a fit, a lens and gains.

        Args:
            fit: Fit without attenuation.
            span: Difference of range, in units of the ranges.
            change: Fraction of light that the attenuation takes over that span.

        Returns:
            (3,) twice the standard error of that fraction.
        """
        family = replace(fit.family, attenuation=True, lens=True)
        values = self._from(family, fit)
        values[:6] = np.log(-np.log1p(-change) / span * self.unit)
        curvature = self._linearised(family, values)[2]
        index = np.flatnonzero(self._free(family))
        noise = fit.squares.mean() * 3 / independent_channels(fit.residual)
        errors = np.sqrt(np.diag(noise * np.linalg.pinv(curvature[np.ix_(index, index)]))[:3])
        return -2 * errors * np.log1p(-change) * (1 - change)

    def _result(self, family: Family, values: np.ndarray, curvature: np.ndarray) -> Fit:
        residual = np.stack([self._solved(family, values, c)[4] for c in range(3)], 1) * np.sqrt(self.weights)
        squares = np.maximum((residual**2).sum(0) / self.count, 1e-12)
        index = np.flatnonzero(self._free(family))
        covariance = np.zeros((len(values), len(values)))
        # The channels of one observation err alike: three channels are not three observations.
        noise = squares.mean() * 3 / independent_channels(residual)
        covariance[np.ix_(index, index)] = noise * np.linalg.pinv(curvature[np.ix_(index, index)])
        centred = np.eye(self.views) - 1 / self.views  # only differences of gains mean anything
        zero = np.zeros(3)
        return Fit(
            family=family,
            beta_D=np.exp(values[:3]) / self.unit if family.attenuation else zero,
            beta_B=np.exp(values[3:6]) / self.unit if family.backscatter else zero,
            B=values[6:9] if family.backscatter else zero,
            tau=float(np.exp(values[9]) * self.unit**2) if family.lamp else np.inf,
            log_gains=values[GAINS:],
            gain_covariance=centred @ covariance[GAINS:, GAINS:] @ centred,
            lens=values[LENS],
            squares=squares,
            residual=residual,
        )


def lens_terms(place: np.ndarray) -> np.ndarray:
    """Return the terms (M, 5) of the log light over an image at places (M, 2): x, y, x^2, xy, y^2.

    They stand for the fall-off of a lens to the corners, or the beam of a lamp that points elsewhere than the camera.
    """
    x, y = place.T
    return np.stack([x, y, x * x, x * y, y * y], 1)


def independent_channels(residual: np.ndarray) -> float:
    """Return the number of independent channels of residuals (M, 3), 1 to 3: their participation ratio."""
    moment = residual.T @ residual
    return float(np.trace(moment) ** 2 / max(np.sum(moment**2), 1e-300))
