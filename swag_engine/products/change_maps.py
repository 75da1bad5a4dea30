"""What changed between two surveys on one grid: which differences of height and color can be told at 95 %.

Maps are compared tile by tile; what must be known of a whole map is estimated from a regular sample of its pixels.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from .components import Components
from .geotiff import NO_LABEL
from .grid import MapGrid
from .heights import gradients, smoothed
from .photo_check import SurveyPhotos
from .tiles import Tile, tiles_of

TOLD = 1.96
"""Standard deviations of a difference told at 95 % (level of detection, Lane et al. 2003, doi 10.1002/esp.483)."""
LEAST_PIXELS = 20
"""Smallest number of pixels of a changed object."""
OPENING = 3
"""Edge, pixels, of what must fit into an object: thinner ones are seams at steps."""
SMOOTHING = 3
"""Edge of the median filter over differences, pixels."""
SCATTER = 0.5
"""Error of horizontal places in pixels: each survey samples a step of the surface differently."""
TAIL = 0.8
"""Quantile of the differences that their noise is found from."""
TAIL_SIGMA = 1.2816
"""Standard deviations at that quantile in a normal distribution."""
FAR_TAIL = 3.3
"""Limit over that quantile at least. About one difference in a thousand is larger where nothing changed: there are far
more large ones than in a normal distribution (one in 50 000). In trained surveys it was 3.2 to 4.8 times the quantile
(benchmarks/products.py)."""
LEAST_EXCESS = 15.0
"""Sum over the pixels of an object of what exceeds the limit, in limits, at least. Errors make spots that exceed it a
little. 20 pixels that exceed it by three quarters are told, or 45 by a third."""
DOUBT = 0.5
"""Error of a height over the distance of the median height from the first surface. Where splats lie in two layers it is
not certain which of them is the surface: in trained surveys errors grew with that distance by .3 to .8 of it."""
MOST_ERROR = 2.0
"""Predicted error of a height, relative to the survey's median, above which a place is not compared."""
LEAST_COLOR = 0.05
"""Smallest difference of color, display values, that counts as a change."""
SLOPES = (0.4, 0.8, 1.6)
"""Slopes between which differences of color are taken as equally large: other light changes the shading of slopes."""
SLOPE_QUANTILE = 0.25
"""Quantile that these are compared by: most of what is steep may have changed."""
MOST_BY_SLOPE = 2.0
"""Largest factor of the limit of color on a slope; a larger one is a change of all that is steep. Above a slope of 1.6
it was 1.7 to 2 under other light, 1.4 to 1.6 with other noise only and 1.2 to 1.4 in air and under a lamp
(benchmarks/products.py)."""
BROAD_STEP = 2
"""Distance in pixels of the 5 x 5 differences of height whose median tells broad changes."""
BROAD_PIXELS = 200
"""Pixels of a broad change, at least."""
BROAD_NOISE = 2.0
"""Noise that the median of a broad change may have, over that of a difference: errors of neighbours are alike. Chosen
on trained surveys of three seabeds under one kind of light, where it invents nothing (benchmarks/products.py)."""
MARGIN = 8
"""Pixels around a tile that its differences depend on, except labels."""
SAMPLE = 1_000_000
"""Pixels that noise and light are estimated from."""
FLAGS = {0: "no change told", 1: "higher", 2: "lower", 3: "color", 4: "label"}
"""Values of the map of changes."""
HEIGHT_FLAGS, LABEL = (1, 2), 4
"""Those of other heights and labels."""
BEYOND_PHOTOS = {5: 1, 6: 2}
"""Flags of height changes by the bits that mark them where no photo can check them."""
GAIN = 0.1
"""By how much more alike the photos of a survey must be at its own heights than at those of the other survey. In 410
true changes of trained surveys this was .1 to 1; where one survey was wrong by 3 to 9 pixels, its photos had -.4 to -1
(benchmarks/products.py)."""
ALIKE = 0.5
"""Least correlation of photos that show a pattern, at its height."""
LEAST_UNSURE = 100
"""Smallest number of pixels of another label where photos do not show that the surfaces of both surveys are right."""
BLOCK = 128
"""Edge of the parts in which photos check a large change, pixels."""
MOST_BLOCKS = 8
"""Parts of a large change that are checked: those with most of its pixels."""
AROUND = 12
"""Pixels around a change that its pattern in the photos is told from larger ones with."""
ORDER = (1, 2, 4, 3)
"""The order in which pixels get their flags: color may be that of another height or label."""


@dataclass(frozen=True, eq=False)
class Survey:
    """One survey on the grid; the arrays may be files that are mapped to memory.

    Attributes:
        colors: (H, W, 3) uint8 display values.
        heights: (H, W) heights of the first surface, NaN where nothing was seen.
        errors: (H, W) predicted errors of heights, of which only their ratios count.
        layers: (H, W) distances of the median heights from the first surface.
        labels: (H, W) uint8, NO_LABEL where nothing was seen; None where the survey has no labels.
    """

    colors: np.ndarray
    heights: np.ndarray
    errors: np.ndarray
    layers: np.ndarray
    labels: np.ndarray | None = None

    def part(self, place: tuple[slice, slice]) -> "Survey":
        """Return the part of the survey at rows and columns, in memory."""
        colors, heights, errors, layers = (
            np.array(one[place]) for one in (self.colors, self.heights, self.errors, self.layers)
        )
        return Survey(colors, heights, errors, layers, None if self.labels is None else np.array(self.labels[place]))


@dataclass(frozen=True, eq=False)
class Differences:
    """Differences between two surveys.

    Attributes:
        height: (H, W) later minus earlier height, NaN where one was not seen.
        limit: (H, W) smallest difference of height that is told at 95 %; of a broad change, its own.
        color: (H, W) difference of color after the light of the later survey is matched to the earlier, NaN likewise.
        slope: (H, W) largest slope to a neighbour within two pixels, in either survey.
        told: (H, W) uint8 with the bit 1 << flag for each flag of FLAGS that is told.
        excess: (H, W) by flag, by how many limits a difference exceeds its limit; 1 for labels, which have none.
    """

    height: np.ndarray
    limit: np.ndarray
    color: np.ndarray
    slope: np.ndarray
    told: np.ndarray
    excess: dict[int, np.ndarray]


class Comparison:
    """Comparison of two surveys.

    The noise of heights is estimated from the differences themselves, robustly: most of a place is static. It is
    proportional to the error that the positions of the photos let expect; places where that is much larger than usual
    are not compared. To it comes what an error of place makes of steps and slopes: the range of heights within a pixel
    and its neighbours; and what is not certain where splats lie in two layers. Where the differences still have more
    large values than that lets expect, limits are raised. Broad changes are told by medians of differences, which have
    less noise. The colors of the later survey are matched to those of the earlier by a robust affine map. Other light
    also changes the shading of slopes: if colors differ more there, their limit is larger. Borders of labels may differ
    by the error of places.

    Where both surveys have photos, these check each other height: they have to be more alike at the height of their own
    survey than at that of the other. Limits are lower then: errors of single places and of layers need not be allowed
    for. A change that photos cannot check must exceed the limits of surveys without photos. Other labels must be larger
    where photos do not show that the surfaces are right: labels of half transparent places may be those behind them.

    Args:
        before: The earlier survey.
        after: The later one, aligned.
        grid: Its pixels.
        residual: Residual of the alignment, the unit of heights.
        photos: Of both surveys; None where they are not there.

    Attributes:
        errors_found: Number of differences that were errors of one survey, by its photos.
    """

    def __init__(
        self,
        before: Survey,
        after: Survey,
        grid: MapGrid,
        residual: float,
        photos: Sequence[SurveyPhotos | None] = (None, None),
    ) -> None:
        self.before, self.after, self.grid, self.residual = before, after, grid, residual
        self.photos, self.errors_found = photos, 0
        self.checked = None not in photos
        self.unchecked: Comparison | None = None
        step = max(1, int(np.ceil(np.sqrt(grid.width * grid.height / SAMPLE))))
        every = slice(None, None, step), slice(None, None, step)
        first, second = before.part(every), after.part(every)
        self._usual = [_usual_error(survey) for survey in (first, second)]
        known, errors = self._comparable(first, second)
        self.overlap = bool(known.any())
        doubt = _doubt(first, second)
        clear = known & (doubt <= np.median(doubt[known])) if self.overlap else known
        self.noise = _noise((second.heights - first.heights)[clear] / errors[clear])
        self.light, self.color_limit = _match_light(first.colors[known] / 255, second.colors[known] / 255)
        self.border = int(np.ceil(TOLD * residual / grid.pixel))
        self.tail, self.color_factors = 1.0, np.ones(len(SLOPES) + 1)  # of the differences that these are found from
        self.tail, self.color_factors = self._raised_limits()
        if self.checked:
            self.unchecked = Comparison(before, after, grid, residual)

    def _raised_limits(self) -> tuple[float, np.ndarray]:
        """Return the factors of the limits of height, and of those of color by slope, from some tiles."""
        every = max(1, self.grid.width * self.grid.height // SAMPLE)
        differences = [self.differences(tile) for tile in [*tiles_of(self.grid)][::every]]
        known = [np.isfinite(part.height) for part in differences]
        ratios, colors, slopes = (
            np.concatenate([values[mask] for values, mask in zip(parts, known, strict=True)])
            for parts in (
                [part.excess[1] + 1 for part in differences],
                [part.color for part in differences],
                [part.slope for part in differences],
            )
        )
        tail = max(1.0, FAR_TAIL * float(np.quantile(ratios, TAIL))) if len(ratios) else 1.0
        return tail, _color_factors(colors, slopes)

    def differences(self, tile: Tile) -> Differences:
        """Compare a tile."""
        (rows, columns), inner = padded(tile, self.grid, max(MARGIN, self.border))
        before, after = self.before.part((rows, columns)), self.after.part((rows, columns))
        pixel = self.grid.pixel
        known, errors = self._comparable(before, after)
        height = np.where(known, after.heights - before.heights, np.nan)
        place = np.hypot(SCATTER * pixel, errors * self.residual)
        slope = np.maximum(_steepness(before.heights, pixel), _steepness(after.heights, pixel))
        doubt = np.zeros_like(errors) if self.checked else _doubt(before, after)
        single = 0.0 if self.checked else self.residual
        limit = TOLD * np.sqrt(errors**2 * (self.noise**2 + single**2) + (slope * place) ** 2 + doubt**2)
        limit *= self.tail
        smooth, broad = _median(height), smoothed(height, BROAD_STEP)
        broad_limit = self._broad_limit(errors, slope, doubt)
        is_broad = np.abs(broad) > broad_limit
        color = np.linalg.norm(_lit(after.colors / 255, self.light) - before.colors / 255, axis=2)
        color = np.where(known, color, np.nan)
        by_height = np.abs(smooth) / np.maximum(limit, 1e-12) - 1
        by_height = np.where(is_broad, np.maximum(by_height, LEAST_EXCESS / BROAD_PIXELS), by_height)
        by_color = _median(color) / (errors * self.color_limit * self.color_factors[np.digitize(slope, SLOPES)]) - 1
        excess = {1: by_height, 2: by_height, 3: by_color}
        told = {
            1: (smooth > limit) | (broad > broad_limit),
            2: (smooth < -limit) | (broad < -broad_limit),
            3: by_color > 0,
        }
        limit = np.where(is_broad, np.minimum(limit, broad_limit), limit)
        if before.labels is not None and after.labels is not None:
            told[4], excess[4] = _other_labels(before.labels, after.labels, self.border), np.ones(known.shape)
        bits = np.zeros(known.shape, np.uint8)
        for flag, mask in told.items():
            bits |= (known & mask).astype(np.uint8) << flag
        excess = {flag: values[inner] for flag, values in excess.items()}
        return Differences(height[inner], limit[inner], color[inner], slope[inner], bits[inner], excess)

    def told(self, tile: Tile, differences: Differences) -> np.ndarray:
        """Return the bits (H, W) uint8 of what is told in a tile, from its differences: with those of BEYOND_PHOTOS."""
        bits = differences.told
        plain = self.unchecked.differences(tile).told if self.unchecked else np.zeros_like(bits)
        for bit, flag in BEYOND_PHOTOS.items():
            bits = bits | np.where(plain >> flag & 1, np.uint8(1 << bit), np.uint8(0))
        return bits

    def _broad_limit(self, errors: np.ndarray, slope: np.ndarray, doubt: np.ndarray) -> np.ndarray:
        """Return the smallest median difference (H, W) of a broad change.

        It does not hold the residual of the alignment: a median has no large errors of single places.
        """
        slope, doubt = (smoothed(values, BROAD_STEP) for values in (slope, doubt))
        variance = (BROAD_NOISE * errors * self.noise) ** 2 + (slope * SCATTER * self.grid.pixel) ** 2 + doubt**2
        return TOLD * np.sqrt(variance)

    def _comparable(self, before: Survey, after: Survey) -> tuple[np.ndarray, np.ndarray]:
        """Return which pixels (H, W) of a part can be compared, and their error relative to the usual one."""
        known = np.isfinite(before.heights) & np.isfinite(after.heights)
        ratios = [survey.errors / usual for survey, usual in zip((before, after), self._usual, strict=True)]
        for ratio in ratios:
            known &= ratio <= MOST_ERROR
        return known, np.where(known, np.sqrt(np.mean(np.square(ratios), axis=0)), 1.0)

    def find_objects(self, told: np.ndarray, flags: np.ndarray, numbers: np.ndarray) -> list[dict[str, Any]]:
        """Find connected changes that are large, thick and certain enough.

        Args:
            told: (H, W), what `told` returns for all tiles.
            flags: (H, W) values of FLAGS, 0 or NO_LABEL before; the objects are written to it.
            numbers: (H, W) int32, scratch.

        Returns:
            A dict for each object.
        """
        objects = []
        for bit in (*HEIGHT_FLAGS, *BEYOND_PHOTOS, *ORDER[2:]) if self.unchecked else ORDER:
            flag = BEYOND_PHOTOS.get(bit, bit)
            source = self.unchecked if self.unchecked and bit in BEYOND_PHOTOS else self
            components = self._components(source, bit, told, flags, numbers)
            found: dict[int, _Object] = {}
            for tile in tiles_of(self.grid):
                place = tile.place
                roots = components.chosen(np.array(numbers[place]))
                if not roots.any():
                    continue
                flags[place] = np.where(roots > 0, flag, flags[place])
                differences, before, after = source.differences(tile), self.before.part(place), self.after.part(place)
                for root in np.unique(roots[roots > 0]).tolist():
                    found.setdefault(root, _Object()).add(roots == root, tile, differences, before, after)
            needed = len(self.photos) if flag in HEIGHT_FLAGS and self.unchecked and source is self else 0
            wrong, unsure = [], []
            for root, item in found.items():
                small_label = flag == LABEL and self.unchecked and item.count < LEAST_UNSURE
                checked = flag in HEIGHT_FLAGS or small_label
                alike = self._alike(item, root, components, numbers) if checked else []
                gains = [own - other for own, other in alike if max(own, other) >= ALIKE]
                if small_label:
                    is_told = len(alike) == len(self.photos) and min(own for own, _ in alike) >= ALIKE
                else:
                    is_told = len(gains) >= needed and all(gain >= GAIN for gain in gains)
                if is_told:
                    objects.append(item.describe(flag, self.grid.pixel))
                elif flag in HEIGHT_FLAGS and any(gain < -GAIN for gain in gains):
                    wrong.append(root)
                else:
                    unsure.append(root)
            self.errors_found += len(wrong)
            for tile in tiles_of(self.grid) if wrong or unsure else ():
                roots = components.chosen(np.array(numbers[tile.place]))
                flags[tile.place] = np.where(np.isin(roots, wrong + unsure), 0, flags[tile.place])
                told[tile.place] = np.where(np.isin(roots, wrong), 0, told[tile.place])
        return objects

    def _alike(
        self, item: "_Object", root: int, components: Components, numbers: np.ndarray
    ) -> list[tuple[float, float]]:
        """Return how much alike photos are at the heights of their own survey and at those of the other.

        Surveys without photos, or with too few that show the object, are left out.
        """
        found: list[list[tuple[float, float]]] = [[] for _ in self.photos]
        for part in item.parts(self.grid) if any(self.photos) else ():
            mask = components.chosen(np.array(numbers[part.place])) == root
            mask = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3))) > 0  # small changes have few pixels
            heights = [np.array(survey.heights[part.place], np.float64) for survey in (self.before, self.after)]
            for photos, own, other, values in zip(self.photos, heights, heights[::-1], found, strict=True):
                alike = photos.alike(self.grid, part, mask, own, other) if photos else None
                values += [] if alike is None else [alike]
        return [(own, other) for own, other in (np.mean(values, axis=0).tolist() for values in found if values)]

    def _components(
        self, source: "Comparison", bit: int, told: np.ndarray, flags: np.ndarray, numbers: np.ndarray
    ) -> Components:
        """Number the connected pixels that have a bit and no flag yet, and choose objects by the limits of `source`."""
        components, flag = Components(), BEYOND_PHOTOS.get(bit, bit)
        for tile in tiles_of(self.grid):
            (rows, columns), inner = padded(tile, self.grid, OPENING)
            mask = (told[rows, columns] >> bit & 1).astype(np.uint8) & (flags[rows, columns] == 0)
            core = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((OPENING, OPENING), np.uint8))
            excess = source.differences(tile).excess[flag] if mask.any() else np.zeros((tile.height, tile.width))
            components.add(numbers, tile, mask[inner], core[inner], np.where(mask[inner], excess, 0))
        components.choose(LEAST_PIXELS, LEAST_PIXELS / 2, LEAST_EXCESS)
        return components

    def label_transitions(self) -> dict[tuple[int, int], float]:
        """Return the area that went from one label to another, by pairs of labels; empty without labels."""
        if self.before.labels is None or self.after.labels is None:
            return {}
        counts = np.zeros((256, 256), np.int64)
        for tile in tiles_of(self.grid):
            pairs = [np.array(labels[tile.place], np.int64) for labels in (self.before.labels, self.after.labels)]
            counts += np.bincount((256 * pairs[0] + pairs[1]).ravel(), minlength=256 * 256).reshape(256, 256)
        counts[NO_LABEL] = counts[:, NO_LABEL] = 0
        return {(int(a), int(b)): float(counts[a, b]) * self.grid.pixel**2 for a, b in np.argwhere(counts)}


class _Object:
    """Sums over the pixels of a changed object."""

    def __init__(self) -> None:
        self.count, self.sums, self.labels = 0, np.zeros(5), np.zeros((2, 256), np.int64)
        self.labelled = False
        self.box = np.array([[np.inf, np.inf], [0, 0]])  # row and column that it begins at, and that it ends before
        self.blocks: Counter[tuple[int, int]] = Counter()

    def add(self, mask: np.ndarray, tile: Tile, differences: Differences, before: Survey, after: Survey) -> None:
        """Add the pixels of a tile."""
        rows, columns = np.nonzero(mask)
        self.count += len(rows)
        at = np.stack([rows + tile.row, columns + tile.column])
        self.box = np.array([np.minimum(self.box[0], at.min(axis=1)), np.maximum(self.box[1], at.max(axis=1) + 1)])
        blocks, counts = np.unique(at // BLOCK, axis=1, return_counts=True)
        self.blocks.update(dict(zip(map(tuple, blocks.T.tolist()), counts.tolist(), strict=True)))
        values = differences.height[mask], differences.limit[mask], differences.color[mask]
        self.sums += [(rows + tile.row).sum(), (columns + tile.column).sum(), *(value.sum() for value in values)]
        if before.labels is not None and after.labels is not None:
            self.labelled = True
            for number, labels in enumerate((before.labels, after.labels)):
                self.labels[number] += np.bincount(labels[mask], minlength=256)

    def parts(self, grid: MapGrid) -> list[Tile]:
        """Return the parts of a map in which the object is checked: around it, or where most of a large one is."""
        (top, left), (bottom, right) = self.box.astype(int).tolist()
        if max(bottom - top, right - left) <= BLOCK:
            return [_around(Tile(left, top, right - left, bottom - top), grid)]
        most = [block for block, _ in self.blocks.most_common(MOST_BLOCKS)]
        return [_around(Tile(BLOCK * column, BLOCK * row, BLOCK, BLOCK), grid) for row, column in most]

    def describe(self, flag: int, pixel: float) -> dict[str, Any]:
        """Describe the object; row and column are of its middle."""
        row, column, height, limit, color = (float(value) / self.count for value in self.sums)
        before, after = (int(counts.argmax()) if self.labelled else None for counts in self.labels)
        return {
            "change": FLAGS[flag],
            "row": row,
            "column": column,
            "pixels": self.count,
            "area": self.count * pixel**2,
            "height_change": height,
            "height_limit": limit,
            "volume_change": height * self.count * pixel**2,
            "color_change": color,
            "label_before": before,
            "label_after": after,
        }


def _around(tile: Tile, grid: MapGrid) -> Tile:
    """Return a tile with the pixels around it that are in the grid."""
    (rows, columns), _ = padded(tile, grid, AROUND)
    return Tile(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)


def padded(tile: Tile, grid: MapGrid, margin: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return rows and columns of a tile with a margin within the grid, and those of the tile among them."""
    top, left = max(tile.row - margin, 0), max(tile.column - margin, 0)
    bottom, right = (
        min(tile.row + tile.height + margin, grid.height),
        min(tile.column + tile.width + margin, grid.width),
    )
    inner = (
        slice(tile.row - top, tile.row - top + tile.height),
        slice(tile.column - left, tile.column - left + tile.width),
    )
    return (slice(top, bottom), slice(left, right)), inner


def _steepness(heights: np.ndarray, pixel: float) -> np.ndarray:
    """Largest slope to a neighbour within two pixels, 0 where it is not known."""
    down, right = gradients(heights, pixel)
    steep = np.nan_to_num(np.hypot(down, right))
    return cv2.dilate(steep, np.ones((3, 3)))


def _doubt(before: Survey, after: Survey) -> np.ndarray:
    """Error (H, W) of differences of height by splats in layers."""
    return DOUBT * np.hypot(*(np.nan_to_num(_median(survey.layers)) for survey in (before, after)))


def _usual_error(survey: Survey) -> float:
    """Median of the predicted errors where something was seen."""
    errors = survey.errors[np.isfinite(survey.heights) & np.isfinite(survey.errors)]
    return float(np.median(errors)) if len(errors) else 1.0


def _noise(values: np.ndarray) -> float:
    """Standard deviation of differences of which most are noise with more large values than a normal distribution has.

    It is found from the quantile TAIL of what is left of the middle, where up to a fifth may be changes.
    """
    return float(np.quantile(np.abs(values - np.median(values)), TAIL)) / TAIL_SIGMA if len(values) else 0.0


def _other_labels(before: np.ndarray, after: np.ndarray, border: int) -> np.ndarray:
    """Find pixels with another label than before.

    Where the later label was within `border` pixels before, and the earlier one is within them still, the border
    between both may have moved by the error of places: that is no change.
    """
    other = (before != after) & ~np.isin(before, (0, NO_LABEL)) & ~np.isin(after, (0, NO_LABEL))
    square = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
    was, remains = np.zeros_like(other), np.zeros_like(other)
    for label in np.unique(before[other]).tolist() + np.unique(after[other]).tolist():
        near = [cv2.dilate((labels == label).astype(np.uint8), square) > 0 for labels in (before, after)]
        was |= (after == label) & near[0]
        remains |= (before == label) & near[1]
    return other & ~(was & remains)


def _spread(values: np.ndarray) -> float:
    """Robust standard deviation about 0 of values of which most are noise."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values)))) if len(values) else 0.0


def _median(values: np.ndarray) -> np.ndarray:
    """Median filter; holes count as 0 for it and stay holes."""
    holes = ~np.isfinite(values)
    filtered = cv2.medianBlur(np.where(holes, 0, values).astype(np.float32), SMOOTHING)
    return np.where(holes, np.nan, filtered)


def _match_light(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit the affine map (4, 3) from later colors (N, 3) to earlier ones, and the smallest change of color."""
    if len(first) < LEAST_PIXELS:
        return np.vstack([np.eye(3), np.zeros(3)]), np.inf
    design = np.concatenate([second, np.ones((len(second), 1))], axis=1)
    weights = np.ones(len(first))
    for _ in range(5):
        solution = np.linalg.lstsq(design * weights[:, None], first * weights[:, None], rcond=None)[0]
        distances = np.linalg.norm(design @ solution - first, axis=1)
        weights = (distances <= max(2 * float(np.median(distances)), LEAST_COLOR)).astype(np.float64)
    return solution, max(float(np.median(distances)) + 3 * TOLD * _spread(distances), LEAST_COLOR)


def _color_factors(distances: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Find how much larger differences of color (N,) are on slopes (N,) than on level ground, by class of SLOPES."""
    classes = np.digitize(slopes, SLOPES)
    level = distances[classes == 0]
    factors = np.ones(len(SLOPES) + 1)
    for number in range(1, len(factors)):
        steep = distances[classes == number]
        if min(len(level), len(steep)) >= LEAST_PIXELS:
            ratio = np.quantile(steep, SLOPE_QUANTILE) / max(float(np.quantile(level, SLOPE_QUANTILE)), 1e-6)
            factors[number] = np.clip(ratio, 1.0, MOST_BY_SLOPE)
    return factors


def _lit(colors: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Apply an affine map (4, 3) to colors (H, W, 3)."""
    return colors @ light[:3] + light[3]
