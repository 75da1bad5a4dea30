"""Label maps: the label that covers most of each pixel, and corrections that go back to the splats."""

import colorsys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..base.errors import InputError
from ..formats.select import LABEL
from ..splats.splats import Splats
from .geotiff import NO_LABEL, Color, create_map, map_size, read_map
from .grid import MapGrid
from .map_frame import MapScene
from .tiles import Progress, Tile, TileRenderer, tiles_of

UNLABELLED = "unlabelled"
"""Name of label 0."""
CHANNELS = 8
"""Labels that are blended at a time."""
TURN = 0.618034
"""Difference of hue between labels, the golden ratio: neighbours differ most."""
LEAST_CHANGED = 0.5
"""Fraction of the visible part of a splat that must lie in corrected pixels for it to get another label."""


def label_colors(labels: Sequence[int]) -> dict[int, Color]:
    """Return a color for each label; grey for none."""
    colors = {}
    for label in labels:
        hue = colorsys.hsv_to_rgb((label * TURN) % 1, 0.65, 0.95) if label else (0.5, 0.5, 0.5)
        red, green, blue = (round(255 * value) for value in hue)
        colors[label] = red, green, blue
    return colors


def splat_labels(splats: Splats) -> np.ndarray:
    """Return the labels (N,) of splats.

    Raises:
        InputError: If they have none, or a number is too large for a palette.
    """
    if LABEL not in splats.extras or not splats.extras[LABEL].any():
        raise InputError("The splats have no labels: make them with the command label, or in Blender.")
    labels = splats.extras[LABEL].astype(np.int64)
    if labels.min() < 0 or labels.max() >= NO_LABEL:
        raise InputError(f"The splats have the label {labels.max()}: a map holds labels from 1 to {NO_LABEL - 1}.")
    return labels


def write_label_map(
    out: Path, scene: MapScene, grid: MapGrid, backend: str = "auto", progress: Progress | None = None
) -> np.ndarray:
    """Render the label map of splats to a GeoTIFF with a palette.

    Args:
        out: The file.
        scene: The splats.
        grid: Its pixels.
        backend: What renders.
        progress: Called before each tile.

    Returns:
        Number of pixels (256,) by value: 0 for no label, NO_LABEL where nothing was seen.
    """
    labels = splat_labels(scene.splats)
    renderer = TileRenderer(scene.splats, grid, backend, scene.seen)
    counts = np.zeros(256, np.int64)
    colors = label_colors([0, *sorted(scene.labels | dict.fromkeys(np.unique(labels).tolist(), ""))])
    names = {f"LABEL_{label}": label_name(scene, label) for label in colors}
    with create_map(out, scene, grid, ("label",), "uint8", NO_LABEL, colors, names) as writer:
        for tile in tiles_of(grid, stage="Rendering labels", progress=progress):
            values = tile_labels(renderer, tile, labels, scene.gains)
            counts += np.bincount(values.ravel(), minlength=256)
            writer.write(tile, values[..., None])
    return counts


def label_name(scene: MapScene, label: int) -> str:
    """Return the name of a label."""
    return scene.labels.get(label, f"label {label}" if label else UNLABELLED)


def tile_labels(renderer: TileRenderer, tile: Tile, labels: np.ndarray, gains: Mapping[int, float]) -> np.ndarray:
    """Return the labels (height, width) of a tile: those with the largest coverage times gain.

    Args:
        renderer: Of the splats.
        tile: The tile.
        labels: (N,) labels of the splats.
        gains: Gains of labels, 1 for others.
    """
    chosen = renderer.inside(tile)
    best = np.zeros((tile.height, tile.width), np.float32)
    found = np.full((tile.height, tile.width), NO_LABEL, np.uint8)
    present = np.unique(labels[chosen])
    for start in range(0, len(present), CHANNELS):
        some = present[start : start + CHANNELS]
        factors = np.array([gains.get(label, 1.0) for label in some.tolist()], np.float32)
        image, alpha = renderer.render(tile, chosen, factors * (labels[chosen][:, None] == some))
        largest = image.max(axis=2)
        better = (largest > best) & (alpha >= renderer.seen)
        found[better] = some[image.argmax(axis=2)][better]
        best = np.maximum(best, largest)
    return found


class CorrectedMap:
    """A corrected label map beside the label map: a palette image, one of label numbers, or one in label colors.

    Args:
        path: PNG or TIFF of the size of the label map.
        labels: The label map.
        grid: Its pixels.
        colors: Colors of the labels.

    Raises:
        InputError: If the image cannot be read or has another size.
    """

    def __init__(self, path: Path, labels: Path, grid: MapGrid, colors: dict[int, Color]) -> None:
        self.path, self.labels, self.grid, self.colors = path, labels, grid, colors
        columns, rows = map_size(path)
        if (rows, columns) != (grid.height, grid.width):
            raise InputError(
                f"{path.name} has {columns} x {rows} pixels and the label map {grid.width} x {grid.height}: "
                "correct the label map without changing its size."
            )

    def tiles(self, stage: str, progress: Progress | None) -> Iterator[tuple[Tile, np.ndarray, np.ndarray]]:
        """Yield each tile with its labels before and after, (height, width) uint8.

        Transparent pixels and those with the value NO_LABEL are NO_LABEL.

        Raises:
            InputError: If the image has a number or color of no label.
        """
        for tile in tiles_of(self.grid, stage=stage, progress=progress):
            before, after = (read_map(path, tile).values for path in (self.labels, self.path))
            yield tile, before, self._labels(after, tile)

    def _labels(self, values: np.ndarray, tile: Tile) -> np.ndarray:
        """Convert a part (height, width) or (height, width, bands) of the corrected image to labels."""
        if values.ndim == 2:
            unknown = set(np.unique(values).tolist()) - {*self.colors, NO_LABEL}
            if unknown:
                raise InputError(f"{self.path.name} has the value {min(unknown)}, which is no label of the run.")
            return values.astype(np.uint8)
        labels = np.full(values.shape[:2], NO_LABEL, np.uint8)
        known = np.zeros(labels.shape, bool) if values.shape[2] < 4 else values[..., 3] == 0
        for label, color in self.colors.items():
            match = (values[..., :3] == color).all(axis=2) & ~known
            labels[match] = label
            known |= match
        if not known.all():
            row, column = np.argwhere(~known)[0]
            color = tuple(values[row, column, :3].tolist())
            raise InputError(
                f"{self.path.name} has the color {color} at column {tile.column + column}, row {tile.row + row}, which "
                "is that of no label: paint in the colors of the label map, without smooth edges."
            )
        return labels


def corrected_splats(
    scene: MapScene, corrected: CorrectedMap, backend: str = "auto", progress: Progress | None = None
) -> np.ndarray:
    """Give splats the labels of corrected pixels.

    A splat gets the label of most of the corrected pixels in which it is visible, weighted by how visible it is, where
    these are at least LEAST_CHANGED of all pixels in which it is visible.

    Args:
        scene: The splats.
        corrected: The corrected label map.
        backend: What renders.
        progress: Called before each tile.

    Returns:
        Labels (N,) of all splats.

    Raises:
        InputError: As `CorrectedMap.tiles` does.
    """
    labels = splat_labels(scene.splats)
    found: set[int] = set()
    for _, before, after in corrected.tiles("Reading corrections", progress):
        found |= set(np.unique(after[(before != after) & (after != NO_LABEL)]).tolist())
    present = np.array(sorted(found), np.int64)
    if not len(present):
        return labels
    renderer = TileRenderer(scene.splats, corrected.grid, backend)
    sums = np.zeros((len(labels), len(present) + 1))
    for tile, before, after in corrected.tiles("Correcting labels", progress):
        chosen = renderer.inside(tile)
        if not len(chosen):
            continue
        changed = ((before != after) & (after != NO_LABEL))[..., None]
        weights = np.concatenate([~changed, changed & (after[..., None] == present)], axis=2)
        sums[chosen] += renderer.visible_weights(tile, chosen, weights)
    moved_weight = sums[:, 1:].sum(axis=1)
    moved = (moved_weight > 0) & (moved_weight >= LEAST_CHANGED * sums.sum(axis=1))
    return np.where(moved, present[sums[:, 1:].argmax(axis=1)], labels)
